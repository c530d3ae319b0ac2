# SPDX-License-Identifier: Apache-2.0
"""Recordings of the iOS app Record3D: a ``.r3d`` file (a zip archive), the same unpacked, or its EXR export.

``metadata`` (JSON) holds w, h, fps, K (by columns) and poses ``qx qy qz qw x y z`` of ARKit: camera to world,
with x right, y up, z backward. Frames are ``rgbd/N.jpg`` with ``rgbd/N.depth`` (float32 metres, compressed by
LZFSE) and ``rgbd/N.conf``; in the export, ``rgb/N.jpg`` and ``depth/N.exr``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.members import LARGEST_MEMBER, Members
from slamdepth.datasets.poses import OPENCV_OF_OPENGL, pose_of, trajectory_of
from slamdepth.datasets.recording import Recording, camera_for, counted_times, name_truth
from slamdepth.datasets.registry import register_reader
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError
from slamdepth.io import decode_image_rgb, metres_of_raw, read_depth_m
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Bytes, Floats, Floats32

ARKIT = "poses of ARKit, not measured by a second system"

_METADATA = ("metadata", "metadata.json")
_IMAGE = re.compile(r"(?:rgbd|rgb)/(\d{1,9})\.(?:jpg|png)")
_LARGEST_DEPTH = 16 * 1024 * 1024
_MOST_PIXELS = 4096 * 4096
_LZFSE = b"bvx"


@register_reader
class Record3dReader:
    """Opens recordings of Record3D."""

    name = "record3d"
    needs = "a .r3d file, or a folder with metadata and rgbd/N.jpg or rgb/N.jpg"

    def matches(self, path: Path) -> bool:
        if path.is_dir():
            has_images = (path / "rgbd").is_dir() or (path / "rgb").is_dir()
            return has_images and any((path / name).is_file() for name in _METADATA)
        return path.suffix.lower() == ".r3d" and path.is_file()

    def open(self, path: Path, camera: Camera | None) -> Recording:
        members = Members(path)
        meta = _metadata(members)
        notes: list[str] = []
        matched = {name: _IMAGE.fullmatch(name) for name in sorted(members.names)}
        frames = {int(found[1]): name for name, found in matched.items() if found}
        if not frames:
            raise DatasetError(f"{path}: no images rgbd/N.jpg or rgb/N.jpg")
        numbers = sorted(frames)
        names = [frames[number] for number in numbers]

        def image(index: int) -> Bytes:
            return decode_image_rgb(_read(members, names[index]), f"{path}: {names[index]}")

        shape = _first_shape(path, image, len(names))
        taken_by, source = camera_for(
            path, shape, camera, lambda: meta.camera(path, shape, notes), "metadata of Record3D"
        )
        times_s = meta.times_s(numbers, notes)
        recording = Recording(
            path.stem if path.is_file() else path.resolve().name,
            path,
            taken_by,
            times_s,
            image,
            depth=_depths(members, numbers, shape, meta, notes),
            truth=meta.trajectory(numbers, times_s, notes),
            notes=notes,
            source=source,
            files=[path / name for name in names] if path.is_dir() else (),
        )
        name_truth(recording, ARKIT)
        return recording


@dataclass(frozen=True)
class _Metadata:
    path: Path
    values: dict[str, Any]

    def numbers(self, name: str, columns: int) -> Floats | None:
        """``(N, columns)``; None where the key is absent.

        Raises:
            DatasetError: it does not hold rows of so many numbers.
        """
        value = self.values.get(name)
        if value is None:
            return None
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            array = np.zeros(0)
        if array.size == 0 or array.size % columns:
            raise DatasetError(f"{self.path}: '{name}' of the metadata must be rows of {columns} numbers")
        return array.reshape(-1, columns)

    def number(self, name: str) -> float | None:
        value = self.values.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return None
        return float(value) if 0 < value < 1e9 else None

    def camera(self, path: Path, shape: tuple[int, ...], notes: list[str]) -> Camera | None:
        K = self.numbers("K", 9)
        if K is None:
            return None
        fx, _, _, _, fy, _, cx, cy, _ = K[0].tolist()  # by columns
        width, height = self.number("w") or shape[1], self.number("h") or shape[0]
        try:
            camera = Camera(round(width), round(height), fx, fy, cx, cy, fps=self.number("fps") or 30.0)
        except CameraError as error:
            raise CameraError(f"{path}: 'K' of the metadata: {error}") from error
        if shape[:2] == (camera.height, camera.width):
            return camera
        if shape[1::-1] == (camera.height, camera.width):
            raise CameraError(
                f"{path}: images are {shape[1]}x{shape[0]}, the metadata says {width:g}x{height:g}"
            )
        notes.append(f"intrinsics of {width:g}x{height:g} are scaled to images of {shape[1]}x{shape[0]}")
        return camera.scaled(shape[1], shape[0])

    def times_s(self, numbers: list[int], notes: list[str]) -> Floats:
        stamps = self.numbers("frameTimestamps", 1)
        if stamps is not None and len(stamps) > max(numbers):
            times_s = stamps[numbers, 0]
            if np.isfinite(times_s).all() and (np.diff(times_s) > 0).all():
                return times_s
        fps = self.number("fps")
        if fps is None:
            return counted_times(len(numbers), 30.0, notes)
        return np.array(numbers, dtype=np.float64) / fps

    def trajectory(self, numbers: list[int], times_s: Floats, notes: list[str]) -> Trajectory | None:
        rows = self.numbers("poses", 7)
        if rows is None:
            return None
        poses = [pose_of(rows[n, 4:], rows[n, :4]) if n < len(rows) else None for n in numbers]
        return trajectory_of(times_s, [None if T is None else T @ OPENCV_OF_OPENGL for T in poses], notes)


def _metadata(members: Members) -> _Metadata:
    name = next((one for one in _METADATA if one in members.names), None)
    if name is None:
        raise DatasetError(f"{members.path}: has no metadata; is it of Record3D?")
    try:
        values = json.loads(members.read(name).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{members.path}: {name} is not valid JSON: {error}") from error
    if not isinstance(values, dict):
        raise DatasetError(f"{members.path}: {name} must be a mapping of keys to values")
    return _Metadata(members.path, values)


def _first_shape(path: Path, image: Callable[[int], Bytes], count: int) -> tuple[int, ...]:
    trouble: ImageDecodeError | None = None
    for index in range(count):
        try:
            return image(index).shape
        except ImageDecodeError as error:
            trouble = trouble or error
    raise DatasetError(f"{path}: none of the {count} images decodes; the first: {trouble}")


def _read(members: Members, name: str, largest: int = LARGEST_MEMBER) -> bytes:
    try:
        return members.read(name, largest)
    except DatasetError as error:  # one damaged member costs its frame, not the run
        raise ImageDecodeError(str(error)) from error


def _depths(
    members: Members, numbers: list[int], shape: tuple[int, ...], meta: _Metadata, notes: list[str]
) -> Callable[[int], Floats32 | None] | None:
    if any(f"rgbd/{number}.depth" in members.names for number in numbers):
        try:
            import lzfse  # noqa: F401 - asked here whether it is there
        except ImportError:
            notes.append(
                "depth is compressed by LZFSE and is left out; to read it: pip install 'slamdepth[record3d]'"
            )
            return None
        return lambda index: _packed_depth(members, numbers[index], shape, meta)
    if any(f"depth/{number}.exr" in members.names for number in numbers) and members.path.is_dir():
        files = [f"depth/{number}.exr" for number in numbers]
        return lambda index: (
            read_depth_m(members.path / files[index], 1.0) if files[index] in members.names else None
        )
    return None


def _packed_depth(members: Members, number: int, shape: tuple[int, ...], meta: _Metadata) -> Floats32 | None:
    name = f"rgbd/{number}.depth"
    if name not in members.names:
        return None
    data = _unpacked(members, name)
    if len(data) % 4:
        raise ImageDecodeError(f"{members.path}: {name} holds {len(data)} bytes, no float32 values")
    values = np.frombuffer(data, np.float32)
    width, height = meta.number("dw"), meta.number("dh")
    if width is None or height is None or width * height != values.size:
        # The view is that of the colour image, so its shape is too.
        width = math.sqrt(values.size * shape[1] / shape[0])
        height = values.size / max(width, 1.0)
    size = (round(height), round(width))
    if size[0] * size[1] != values.size or not values.size:
        raise ImageDecodeError(f"{members.path}: {name} holds {values.size} values, not of the image's shape")
    depth_m = metres_of_raw(values.reshape(size))
    conf = f"rgbd/{number}.conf"
    if conf in members.names:
        confidence = np.frombuffer(_unpacked(members, conf), np.uint8)
        if confidence.size == depth_m.size:
            depth_m[confidence.reshape(size) == 0] = 0.0
    return depth_m


def _unpacked(members: Members, name: str) -> bytes:
    data = _read(members, name, _LARGEST_DEPTH)
    if not data.startswith(_LZFSE):
        return data
    import lzfse

    try:
        unpacked = bytes(lzfse.decompress(data))
    except (lzfse.error, ValueError, MemoryError) as error:
        raise ImageDecodeError(f"{members.path}: {name} is damaged: {error}") from error
    if len(unpacked) > 4 * _MOST_PIXELS:
        raise ImageDecodeError(f"{members.path}: {name} unpacks to {len(unpacked)} bytes")
    return unpacked
