# SPDX-License-Identifier: Apache-2.0
"""A ``.sens`` file of ScanNet, version 4: images, depth, poses and intrinsics in one file.

Frames are found by their sizes in one pass and read where they are.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from slamdepth.datasets.poses import trajectory_of
from slamdepth.datasets.readers.scannet import FPS, TRUTH, camera_of
from slamdepth.datasets.recording import Recording, camera_for, name_truth
from slamdepth.datasets.registry import register_reader
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import decode_image_rgb, metres_of_raw
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats, Floats32

_VERSION = 4
_LONGEST_NAME = 4096
_LARGEST = 256 * 1024 * 1024
_MATRICES = struct.Struct("<64f")
_SETTINGS = struct.Struct("<iiIIIIfQ")
_FRAME = struct.Struct("<16fQQQQ")
_RAW, _PNG, _JPEG = 0, 1, 2
_ZLIB = 1
_MICROSECONDS = 1e-6


@register_reader
class ScanNetSensReader:
    """Opens ``.sens`` files."""

    name = "scannet-sens"
    needs = "a .sens file"

    def matches(self, path: Path) -> bool:
        return path.suffix.lower() == ".sens" and path.is_file()

    def open(self, path: Path, camera: Camera | None) -> Recording:
        notes: list[str] = []
        file = _Sens(path, notes)
        shape = (file.color_size[1], file.color_size[0], 3)
        taken_by, source = camera_for(
            path, shape, camera, lambda: camera_of(path, file.K, shape), "the .sens file"
        )
        times_s = file.times_s()
        truth = trajectory_of(times_s, [frame.pose for frame in file.frames], notes)
        recording = Recording(
            path.stem,
            path,
            taken_by,
            times_s,
            file.image,
            depth=file.depth,
            truth=truth,
            notes=notes,
            source=source,
        )
        name_truth(recording, TRUTH)
        return recording


@dataclass(frozen=True)
class _Frame:
    """Where a frame's images are in the file, and the rest of it."""

    pose: Floats
    time_us: int
    color_at: int
    color_bytes: int
    depth_bytes: int


class _Sens:
    def __init__(self, path: Path, notes: list[str]) -> None:
        self.path = path
        self.frames: list[_Frame] = []
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            (version,) = struct.unpack("<I", self._take(file, 4))
            if version != _VERSION:
                raise DatasetError(f"{path}: a .sens file of version {version}; read is {_VERSION}")
            (length,) = struct.unpack("<Q", self._take(file, 8))
            if length > _LONGEST_NAME:
                raise DatasetError(f"{path}: this .sens file is damaged: a name of {length} bytes")
            self._take(file, length)
            matrices = np.array(_MATRICES.unpack(self._take(file, _MATRICES.size))).reshape(4, 4, 4)
            self.K = matrices[0]
            settings = _SETTINGS.unpack(self._take(file, _SETTINGS.size))
            self._color_kind, self._depth_kind, *sizes, self._shift, count = settings
            self.color_size, self.depth_size = (sizes[0], sizes[1]), (sizes[2], sizes[3])
            if self._color_kind not in (_PNG, _JPEG) or self._depth_kind not in (_RAW, _ZLIB):
                raise DatasetError(
                    f"{path}: colour of kind {self._color_kind} and depth of kind {self._depth_kind} are not "
                    "read; export it with SensReader"
                )
            if not (min(sizes) > 0 and max(sizes) < 1 << 15 and self._shift > 0):
                raise DatasetError(f"{path}: this .sens file is damaged: images of {sizes}")
            self._index(file, size)
        if not self.frames:
            raise DatasetError(f"{path}: holds no frame (of {count} that it promises)")
        if len(self.frames) < count:
            notes.append(f"the file promises {count} frames, {len(self.frames)} are there: it was cut short")

    def times_s(self) -> Floats:
        """Times ``(N,)`` in seconds; counted where the file has none that increase."""
        times_us = np.array([frame.time_us for frame in self.frames], dtype=np.float64)
        if times_us[0] >= 0 and (np.diff(times_us) > 0).all():
            return np.asarray(times_us * _MICROSECONDS)
        return np.asarray(np.arange(len(self.frames)) / FPS)

    def image(self, index: int) -> Bytes:
        frame = self.frames[index]
        return decode_image_rgb(self._bytes(frame.color_at, frame.color_bytes), f"{self.path}: frame {index}")

    def depth(self, index: int) -> Floats32 | None:
        frame = self.frames[index]
        if not frame.depth_bytes:
            return None
        what = f"{self.path}: depth of frame {index}"
        data = self._bytes(frame.color_at + frame.color_bytes, frame.depth_bytes)
        width, height = self.depth_size
        if self._depth_kind == _ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, 2 * width * height)
            except zlib.error as error:
                raise ImageDecodeError(f"{what}: {error}") from error
        if len(data) != 2 * width * height:
            raise ImageDecodeError(f"{what}: {len(data)} bytes, expected {2 * width * height}")
        raw = np.frombuffer(data, "<u2").reshape(height, width)
        return metres_of_raw(raw, self._shift)

    def _index(self, file: BinaryIO, size: int) -> None:
        at = file.tell()
        while at + _FRAME.size <= size:
            file.seek(at)
            *pose, time_us, _, color_bytes, depth_bytes = _FRAME.unpack(self._take(file, _FRAME.size))
            at += _FRAME.size
            if max(color_bytes, depth_bytes) > _LARGEST or at + color_bytes + depth_bytes > size:
                return
            T = np.array(pose, dtype=np.float64).reshape(4, 4)
            self.frames.append(_Frame(T, time_us, at, color_bytes, depth_bytes))
            at += color_bytes + depth_bytes

    def _take(self, file: BinaryIO, count: int) -> bytes:
        data = file.read(count)
        if len(data) != count:
            raise DatasetError(f"{self.path}: this .sens file is cut short")
        return data

    def _bytes(self, at: int, count: int) -> bytes:
        try:
            with self.path.open("rb") as file:
                file.seek(at)
                return file.read(count)
        except OSError as error:
            raise ImageDecodeError(f"{self.path}: cannot be read: {error.strerror or error}") from error
