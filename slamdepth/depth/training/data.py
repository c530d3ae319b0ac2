# SPDX-License-Identifier: Apache-2.0
"""Readers of training pairs: a folder a place, with ``camera.json`` and image + depth files."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.types import Camera, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

_IMAGE_ENDINGS = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Place:
    """Pairs of one place taken by one camera.

    Attributes:
        images, depths: file paths, in the same order.
        depth_unit_m: metres per unit of the depth files.
    """

    name: str
    camera: Camera
    images: tuple[Path, ...]
    depths: tuple[Path, ...]
    depth_unit_m: float

    def __len__(self) -> int:
        return len(self.images)

    def read(self, index: int) -> Frame:
        """The pair ``index`` as a frame with depth.

        Raises:
            DatasetError: a file does not decode or has another size than the camera's.
        """
        image_rgb = _decode(self.images[index], colour=True)
        raw = _decode(self.depths[index], colour=False)
        expected = (self.camera.height, self.camera.width)
        for path, array in ((self.images[index], image_rgb), (self.depths[index], raw)):
            if array.shape[:2] != expected:
                raise DatasetError(f"{path}: {array.shape[:2]} pixels, camera.json says {expected}")
        depth_m = (raw.astype(np.float32) * self.depth_unit_m).astype(np.float32)
        return Frame(index, float(index), image_rgb, self.camera, depth_m)


def data_folder(named: str) -> Path:
    """An absolute folder as it is; another one below ``$SLAMDEPTH_DATA`` where that is
    set, else relative to the current folder.

    Raises:
        DatasetError: it does not exist.
    """
    path = Path(named).expanduser()
    root = os.environ.get("SLAMDEPTH_DATA")
    if not path.is_absolute() and root and not path.is_dir():
        path = Path(root) / path
    if not path.is_dir():
        raise DatasetError(f"{path}: no such folder of training pairs (is SLAMDEPTH_DATA set?)")
    return path


def open_place(folder: Path) -> Place:
    """Open a folder of ``NNNNN.jpg`` + ``NNNNN.png`` pairs.

    Raises:
        DatasetError: the folder, ``camera.json`` or one of its keys is missing, or there
            is no complete pair.
    """
    about = folder / "camera.json"
    if not about.is_file():
        raise DatasetError(f"{folder}: no camera.json here, so this is no folder of training pairs")
    try:
        values = json.loads(about.read_text(encoding="utf-8"))
        camera = Camera(
            int(values["width"]), int(values["height"]),
            float(values["fx"]), float(values["fy"]), float(values["cx"]), float(values["cy"]),
        )  # fmt: skip
        unit = float(values.get("depth_unit_m", 0.001))
    except KeyError as error:
        raise DatasetError(f"{about}: the key {error} is missing") from error
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{about}: not readable: {error}") from error
    images = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGE_ENDINGS)
    pairs = [(path, path.with_suffix(".png")) for path in images if path.with_suffix(".png").is_file()]
    if not pairs:
        raise DatasetError(f"{folder}: no pair of NNNNN.jpg and NNNNN.png here")
    return Place(folder.name, camera, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs), unit)


def _decode(path: Path, *, colour: bool) -> NDArray[Any]:
    import cv2

    array = cv2.imread(str(path), cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED)
    if array is None:
        raise DatasetError(f"{path}: does not decode")
    if colour:
        return np.ascontiguousarray(array[:, :, ::-1])
    if array.ndim != 2:
        raise DatasetError(f"{path}: a depth image needs one channel, this has {array.shape[-1]}")
    return array
