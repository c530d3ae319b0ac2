# SPDX-License-Identifier: Apache-2.0
"""Training pairs: one folder per place, with ``camera.json`` and ``NNNNN.jpg`` + ``NNNNN.png`` files.

``camera.json`` holds ``width height fx fy cx cy`` in pixels. Optional keys are ``depth_unit_m``, metres
per unit of the 16-bit depth images (default: 0.001), and ``distortion``, ``[k1, k2, p1, p2, k3]`` in
OpenCV's order, which holds for both images. An optional ``gravity.txt`` gives the direction of gravity:
lines ``NNNNN x y z``, the pair's name and a unit vector in the camera frame (x right, y down, z forward).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_raw, read_image_rgb
from slamdepth.training.data import fingerprint, register_reader
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

GRAVITY_FILE = "gravity.txt"
_IMAGE_ENDINGS = (".jpg", ".jpeg")
_UNIT_TOLERANCE = 0.01
_Direction = tuple[float, float, float]


class _CameraFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    width: int = Field(ge=1)
    height: int = Field(ge=1)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    depth_unit_m: float = Field(0.001, gt=0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PairPlace:
    """Image pairs of one place, taken by one camera.

    Attributes:
        images, depths: file paths, in the same order.
        depth_unit_m: metres per unit of the depth files.
        gravities: unit direction of gravity in the camera frame, one per pair; empty if none is known.
    """

    name: str
    camera: Camera
    images: tuple[Path, ...]
    depths: tuple[Path, ...]
    depth_unit_m: float
    notes: tuple[str, ...] = ()
    benchmark: str | None = None
    gravities: tuple[_Direction | None, ...] = ()

    def __len__(self) -> int:
        return len(self.images)

    @property
    def fingerprint(self) -> str:
        known = (self.gravities,) if self.gravities else ()
        return fingerprint((*self.images, *self.depths), self.camera, self.depth_unit_m, *known)

    def between(self, first: int, last: int) -> PairPlace:
        """The pairs numbered ``first`` to ``last``, both included.

        Raises:
            DatasetError: there are none.
        """
        kept = self.numbered(first, last)
        if not kept:
            raise DatasetError(f"{self.images[0].parent}: no pair is numbered {first} to {last}")
        return self.part(f"{self.name}[{first}-{last}]", kept)

    def numbered(self, first: int, last: int) -> list[int]:
        """Indices of the pairs numbered ``first`` to ``last``, both included."""
        return [
            k for k, path in enumerate(self.images) if path.stem.isdigit() and first <= int(path.stem) <= last
        ]

    def part(self, name: str, indices: Iterable[int]) -> PairPlace:
        """The pairs ``indices``, as a place called ``name``."""
        kept = list(indices)
        return replace(
            self,
            name=name,
            images=tuple(self.images[k] for k in kept),
            depths=tuple(self.depths[k] for k in kept),
            gravities=tuple(self.gravities[k] for k in kept) if self.gravities else (),
        )

    def read(self, index: int) -> Frame:
        """Image and depth of pair ``index``; see :meth:`slamdepth.training.data.Place.read`."""
        try:
            image_rgb = read_image_rgb(self.images[index], upright=False)  # as depth is stored
            raw = read_depth_raw(self.depths[index])
        except ImageDecodeError as error:
            raise DatasetError(str(error)) from error
        expected = (self.camera.height, self.camera.width)
        for path, array in ((self.images[index], image_rgb), (self.depths[index], raw)):
            if array.shape[:2] != expected:
                raise DatasetError(f"{path}: {array.shape[:2]} pixels, camera.json says {expected}")
        depth_m = (raw.astype(np.float32) * self.depth_unit_m).astype(np.float32)
        return Frame(index, float(index), image_rgb, self.camera, depth_m)

    def gravity(self, index: int) -> Floats | None:
        """Unit direction of gravity ``(3,)`` of pair ``index`` from gravity.txt; None if not listed."""
        found = self.gravities[index] if self.gravities else None
        return None if found is None else np.array(found)


@register_reader
class PairReader:
    """Opens folders of pairs."""

    name = "pairs"
    needs = "camera.json, NNNNN.jpg + NNNNN.png"

    def matches(self, folder: Path) -> bool:
        return (folder / "camera.json").is_file()

    def open(self, folder: Path) -> PairPlace:
        camera, unit = read_camera(folder / "camera.json")
        try:
            images = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGE_ENDINGS)
            both = [(path, path.with_suffix(".png")) for path in images]
            pairs = [(image, depth) for image, depth in both if depth.is_file()]
        except OSError as error:
            raise DatasetError(f"{folder}: cannot be read: {error.strerror or error}") from error
        if not pairs:
            raise DatasetError(f"{folder}: no pair of NNNNN.jpg and NNNNN.png here")
        alone = len(images) - len(pairs)
        notes = (f"{alone} of {len(images)} images have no depth image",) if alone else ()
        listed = read_gravity(folder / GRAVITY_FILE) if (folder / GRAVITY_FILE).is_file() else {}
        return PairPlace(
            folder.name, camera, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs), unit, notes,
            gravities=tuple(listed.get(image.stem) for image, _ in pairs) if listed else (),
        )  # fmt: skip


def read_camera(path: Path) -> tuple[Camera, float]:
    """The camera of a ``camera.json`` and the metres per unit of the depth images.

    Raises:
        DatasetError: the file is missing or not readable, or a key is missing, unknown or out of
            range. The message names it.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DatasetError(
            f"{path.parent}: no camera.json here, so this is no folder of training pairs"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not readable: {error}") from error
    try:
        file = _CameraFile.model_validate_json(text)
    except ValidationError as error:
        raise DatasetError(f"{path}: {_problem(error)}") from error
    intrinsics = file.width, file.height, file.fx, file.fy, file.cx, file.cy
    return Camera(*intrinsics, distortion=file.distortion), file.depth_unit_m


def _problem(error: ValidationError) -> str:
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    if name.startswith("distortion"):
        return "distortion: needs five finite numbers [k1, k2, p1, p2, k3]"
    if first["type"] == "missing":
        return f"the key '{name}' is missing"
    if first["type"] == "extra_forbidden":
        return f"unknown key '{name}'; known are {', '.join(_CameraFile.model_fields)}"
    return f"{name}: {first['msg']}, got {first['input']!r:.40}" if name else f"not readable: {first['msg']}"


def read_gravity(path: Path) -> dict[str, _Direction]:
    """Unit directions of gravity in the camera frame, by pair name.

    Raises:
        DatasetError: a line is not a name and a unit direction. The message names it.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not readable: {error}") from error
    directions: dict[str, _Direction] = {}
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
        directions[name] = (x / length, y / length, z / length)
    return directions
