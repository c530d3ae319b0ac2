# SPDX-License-Identifier: Apache-2.0
"""Training pairs: a folder a place, with ``camera.json`` and ``NNNNN.jpg`` + ``NNNNN.png`` files.

``camera.json`` has ``width height fx fy cx cy`` in pixels and, where the depth is not in
millimetres, ``depth_unit_m``: metres per unit of the 16-bit depth images. ``gravity.txt`` may say where
down is: lines ``NNNNN x y z``, the pair's name and the unit direction of gravity in the camera's frame
(x right, y down, z forward).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.training.data import fingerprint, register_reader
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_raw, read_image_rgb
from slamdepth.types import Camera, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

GRAVITY_FILE = "gravity.txt"
_IMAGE_ENDINGS = (".jpg", ".jpeg")
_UNIT_TOLERANCE = 0.01
_Direction = tuple[float, float, float]


@dataclass(frozen=True)
class PairPlace:
    """Pairs of one place taken by one camera.

    Attributes:
        images, depths: file paths, in the same order.
        depth_unit_m: metres per unit of the depth files.
        downs: unit direction of gravity in the camera's frame, of each pair; empty where none is known.
    """

    name: str
    camera: Camera
    images: tuple[Path, ...]
    depths: tuple[Path, ...]
    depth_unit_m: float
    notes: tuple[str, ...] = ()
    benchmark: str | None = None
    downs: tuple[_Direction | None, ...] = ()

    def __len__(self) -> int:
        return len(self.images)

    @property
    def fingerprint(self) -> str:
        told = (self.downs,) if self.downs else ()
        return fingerprint((*self.images, *self.depths), self.camera, self.depth_unit_m, *told)

    def read(self, index: int) -> Frame:
        """The pair ``index``; see :meth:`slamdepth.depth.training.data.Place.read`."""
        try:
            image_rgb, raw = read_image_rgb(self.images[index]), read_depth_raw(self.depths[index])
        except ImageDecodeError as error:
            raise DatasetError(str(error)) from error
        expected = (self.camera.height, self.camera.width)
        for path, array in ((self.images[index], image_rgb), (self.depths[index], raw)):
            if array.shape[:2] != expected:
                raise DatasetError(f"{path}: {array.shape[:2]} pixels, camera.json says {expected}")
        depth_m = (raw.astype(np.float32) * self.depth_unit_m).astype(np.float32)
        return Frame(index, float(index), image_rgb, self.camera, depth_m)

    def down(self, index: int) -> NDArray[np.float64] | None:
        """What gravity.txt says of the pair ``index``, ``(3,)``; None where it says nothing."""
        found = self.downs[index] if self.downs else None
        return None if found is None else np.array(found)


@register_reader
class PairReader:
    """Opens folders of pairs."""

    name = "pairs"
    needs = "camera.json, NNNNN.jpg + NNNNN.png"

    def matches(self, folder: Path) -> bool:
        return (folder / "camera.json").is_file()

    def open(self, folder: Path) -> PairPlace:
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
        alone = len(images) - len(pairs)
        notes = (f"{alone} of {len(images)} images have no depth image",) if alone else ()
        told = read_gravity(folder / GRAVITY_FILE) if (folder / GRAVITY_FILE).is_file() else {}
        return PairPlace(
            folder.name, camera, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs), unit, notes,
            downs=tuple(told.get(image.stem) for image, _ in pairs) if told else (),
        )  # fmt: skip


def read_gravity(path: Path) -> dict[str, _Direction]:
    """Unit directions of gravity in the camera's frame, by the names of their pairs.

    Raises:
        DatasetError: a line is not a name and a unit direction; names it.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not readable: {error}") from error
    told: dict[str, _Direction] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        name, *numbers = line.split()
        try:
            x, y, z = map(float, numbers)
        except ValueError:
            x = y = z = np.nan
        length = float(np.sqrt(x * x + y * y + z * z))
        if not abs(length - 1.0) < _UNIT_TOLERANCE:
            raise DatasetError(f"{path}: line {number}: expected a name and a unit direction x y z: {line!r}")
        told[name] = (x / length, y / length, z / length)
    return told
