# SPDX-License-Identifier: Apache-2.0
"""Cameras and images of a COLMAP model, binary or text (``src/colmap/scene/reconstruction_io``).

Pixels have their corners at whole numbers there and their centres here. Poses are world to camera,
quaternions w x y z.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.poses import pose_of
from slamdepth.errors import CameraError, DatasetError
from slamdepth.geometry import invert
from slamdepth.io import parse_float, read_lines
from slamdepth.typing import Floats

_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("plumb_bob", ("f", "cx", "cy")),
    "PINHOLE": ("plumb_bob", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": ("plumb_bob", ("f", "cx", "cy", "k1")),
    "RADIAL": ("plumb_bob", ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": ("plumb_bob", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": ("equidistant", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (
        "rational_polynomial", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "FOV": ("fov", ("fx", "fy", "cx", "cy", "omega")),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": ("equidistant", ("f", "cx", "cy", "k1", "k2")),
    "THIN_PRISM_FISHEYE": (
        "thin_prism_fisheye",
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
}  # fmt: skip
"""Models in the order of their numbers: their name in ROS, and what their numbers mean."""
_ORDER = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
_CAMERA, _IMAGE = struct.Struct("<IiQQ"), struct.Struct("<I7dI")
_POINT_BYTES = 24
_LONGEST_NAME = 4096


@dataclass(frozen=True)
class ColmapCamera:
    """A camera as COLMAP has it; ``parameters`` by their names."""

    model: str
    width: int
    height: int
    parameters: dict[str, float]

    def calibration(self, where: Path) -> dict[str, Any]:
        """The same under the keys of a ROS calibration.

        Raises:
            CameraError: its model has no counterpart.
        """
        model, _ = _MODELS[self.model]
        if model not in _ORDER:
            raise CameraError(f"{where}: a lens of the model {self.model} is not supported")
        of = self.parameters
        fx, fy = of.get("fx", of.get("f", 0.0)), of.get("fy", of.get("f", 0.0))
        cx, cy = of["cx"] - 0.5, of["cy"] - 0.5
        return {
            "image_width": self.width,
            "image_height": self.height,
            "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "distortion_model": model,
            "distortion_coefficients": [of.get(name, 0.0) for name in _ORDER[model]],
        }


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: its name below the image folder, its camera, its pose (None where it is none)."""

    name: str
    camera_id: int
    T_world_camera: Floats | None


def is_model(folder: Path) -> bool:
    """True for a folder with ``cameras`` and ``images``, both binary or both text."""
    return any(
        all((folder / f"{name}.{ending}").is_file() for name in ("cameras", "images"))
        for ending in ("bin", "txt")
    )


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Cameras by their ids, and images, of a folder for which :func:`is_model` is True.

    Raises:
        DatasetError: a file cannot be read or is malformed; names it, and the line of a text.
    """
    if all((folder / f"{name}.bin").is_file() for name in ("cameras", "images")):
        return _cameras_binary(folder / "cameras.bin"), _images_binary(folder / "images.bin")
    return _cameras_text(folder / "cameras.txt"), _images_text(folder / "images.txt")


class _Bytes:
    """The bytes of a file, taken from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        self.need(form.size)
        values = form.unpack_from(self.data, self.at)
        self.at += form.size
        return values

    def need(self, count: int) -> None:
        if self.at + count > len(self.data):
            raise DatasetError(f"{self.path}: this file is cut short or damaged ({len(self.data)} bytes)")

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise DatasetError(f"{self.path}: this file is damaged: a name without an end")
        name = self.data[self.at : end].decode("utf-8", errors="replace")
        self.at = end + 1
        return name

    def skip(self, count: int) -> None:
        self.need(count)
        self.at += count


def _cameras_binary(path: Path) -> dict[int, ColmapCamera]:
    file = _Bytes(path)
    (count,) = file.take(struct.Struct("<Q"))
    found: dict[int, ColmapCamera] = {}
    names = list(_MODELS)
    for _ in range(count):
        camera_id, model, width, height = file.take(_CAMERA)
        if not 0 <= model < len(names):
            raise DatasetError(f"{path}: camera {camera_id} is of the unknown model {model}")
        numbers = file.take(struct.Struct(f"<{len(_MODELS[names[model]][1])}d"))
        found[camera_id] = _camera(path, names[model], width, height, list(numbers))
    return found


def _images_binary(path: Path) -> list[ColmapImage]:
    file = _Bytes(path)
    (count,) = file.take(struct.Struct("<Q"))
    found: list[ColmapImage] = []
    for _ in range(count):
        _, *pose, camera_id = file.take(_IMAGE)
        name = file.text()
        (points,) = file.take(struct.Struct("<Q"))
        file.skip(points * _POINT_BYTES)
        found.append(ColmapImage(name, camera_id, _pose(pose)))
    return found


def _cameras_text(path: Path) -> dict[int, ColmapCamera]:
    found: dict[int, ColmapCamera] = {}
    for number, line in read_lines(path):
        fields = line.split()
        try:
            camera_id, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            numbers = [parse_float(text) for text in fields[4:]]
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}:{number}: expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS', found {line[:80]!r}"
            ) from error
        if model not in _MODELS or len(numbers) != len(_MODELS[model][1]):
            raise DatasetError(
                f"{path}:{number}: no camera model {model[:40]!r} of {len(numbers)} parameters"
            )
        found[camera_id] = _camera(path, model, width, height, numbers)
    return found


def _images_text(path: Path) -> list[ColmapImage]:
    """Every other line is an image; those between, which may be empty, list its points."""
    try:
        lines = path.read_bytes().decode("utf-8-sig", errors="replace").split("\n")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    rows = [
        (number, line.strip()) for number, line in enumerate(lines, 1) if not line.lstrip().startswith("#")
    ]
    while rows and not rows[0][1]:
        rows.pop(0)
    found: list[ColmapImage] = []
    for number, line in rows[::2]:
        if not line:
            continue
        fields = line.split(maxsplit=9)
        try:
            pose = [parse_float(text) for text in fields[1:8]]
            camera_id, name = int(fields[8]), fields[9]
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}:{number}: expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME', "
                f"found {line[:80]!r}"
            ) from error
        found.append(ColmapImage(name, camera_id, _pose(pose)))
    return found


def _camera(path: Path, model: str, width: int, height: int, numbers: list[float]) -> ColmapCamera:
    if not (0 < width < 1 << 20 and 0 < height < 1 << 20 and np.isfinite(numbers).all()):
        raise DatasetError(f"{path}: a camera of {width}x{height} pixels with the parameters {numbers[:4]}")
    return ColmapCamera(model, width, height, dict(zip(_MODELS[model][1], numbers, strict=True)))


def _pose(values: list[float]) -> Floats | None:
    qw, qx, qy, qz, *position = values
    T_camera_world = pose_of(np.array(position), np.array([qx, qy, qz, qw]))
    return None if T_camera_world is None else invert(T_camera_world)
