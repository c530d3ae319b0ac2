# SPDX-License-Identifier: Apache-2.0
"""Where the images and depth maps of old keyframes lie until the end of a run.

Tracking needs them of the newest keyframes only, the mesh and the report those of all, one
after the other. So beyond a budget they are packed and put away in a temporary file, and
read again when they are asked for.
"""

from __future__ import annotations

import logging
import tempfile
import threading
import weakref
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from slamdepth.mapping.packing import PackedMap, pack_image, pack_measured, pack_predicted, unpack_image
from slamdepth.types import DepthPrediction, Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

Place = tuple[int, int] | bytes
"""Where in a file bytes lie, from where on and how many; the bytes themselves where it took none."""

_NEWEST = 8  # never put away: tracking still looks at them


class HasImages(Protocol):
    """A keyframe while it may change."""

    frame: Frame
    prediction: DepthPrediction | None


class KeyframeStore:
    """Keeps the images and depth maps of keyframes within a budget of memory.

    Args:
        budget_mib: what may lie in memory, unpacked, beside the newest keyframes'.
    """

    def __init__(self, budget_mib: float) -> None:
        self._budget_bytes = budget_mib * 2**20
        self._file = NamelessFile()
        self._sizes: list[int] = []
        self._away = 0

    @property
    def held_bytes(self) -> int:
        """Of images and depth maps in memory."""
        return sum(self._sizes[self._away :])

    @property
    def away_bytes(self) -> int:
        """Of the temporary file."""
        return self._file.size

    def tidy(self, keyframes: Sequence[HasImages]) -> None:
        """Put the oldest of ``keyframes`` away until the rest is within the budget.

        Args:
            keyframes: all so far, in the same order each time, each with its prediction.
        """
        self._sizes += [_size(keyframe) for keyframe in keyframes[len(self._sizes) :]]
        while self.held_bytes > self._budget_bytes and self._away < len(keyframes) - _NEWEST:
            self._put_away(keyframes[self._away])
            self._away += 1

    def _put_away(self, keyframe: HasImages) -> None:
        frame = StoredFrame.of(keyframe.frame, self._file)
        if keyframe.prediction is not None:
            is_frames = keyframe.prediction.values is keyframe.frame.depth_m
            keyframe.prediction = StoredPrediction.of(
                keyframe.prediction, self._file, frame if is_frames else None, frame.camera.depth_factor
            )
        keyframe.frame = frame


def _size(keyframe: HasImages) -> int:
    arrays = [keyframe.frame.image_rgb, keyframe.frame.depth_m]
    if keyframe.prediction is not None:
        arrays += [keyframe.prediction.values, keyframe.prediction.sigma_log]
    return sum({id(array): array.nbytes for array in arrays if array is not None}.values())


class NamelessFile:
    """A temporary file without a name, so that nothing is left of it however the process ends.

    Where the disk takes no more, bytes stay in memory. Any thread may use it.
    """

    def __init__(self) -> None:
        self._file: Any = None
        self._lock = threading.Lock()
        self._has_failed = False
        self.size = 0

    def put(self, data: bytes) -> Place:
        """Put bytes away; returns what :meth:`get` takes."""
        with self._lock:
            try:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(prefix="slamdepth-", buffering=0)  # noqa: SIM115
                    weakref.finalize(self, self._file.close)
                self._file.seek(self.size)
                if self._file.write(data) != len(data):
                    raise OSError("the disk is full")
            except OSError as error:
                level = logging.DEBUG if self._has_failed else logging.WARNING
                log.log(level, "keyframes stay in memory: no temporary file can be written: %s", error)
                self._has_failed = True
                return data
            place = (self.size, len(data))
            self.size += len(data)
            return place

    def get(self, place: Place) -> bytes:
        """The bytes that were put there."""
        if isinstance(place, bytes):
            return place
        start, length = place
        with self._lock:
            self._file.seek(start)
            return bytes(self._file.read(length))


class _DepthAway:
    """A packed depth map whose bytes lie in a file."""

    def __init__(self, packed: PackedMap, file: NamelessFile) -> None:
        self._about, self._file = replace(packed, data=b""), file
        self._place = file.put(packed.data)

    def get(self) -> NDArray[Any]:
        return replace(self._about, data=self._file.get(self._place)).unpacked()


class StoredFrame(Frame):
    """A frame whose images are read and unpacked each time they are asked for.

    The colours are those of a good JPEG, depth is what it was to the bit.
    """

    _file: NamelessFile
    _image: Place
    _depth: _DepthAway | None

    def __new__(cls, *args: Any, **fields: Any) -> Any:
        """A plain frame: what ``dataclasses.replace`` makes of a stored one."""
        return Frame(*args, **fields)

    @classmethod
    def of(cls, frame: Frame, file: NamelessFile) -> StoredFrame:
        """Put the images of ``frame`` away in ``file``."""
        stored = object.__new__(cls)
        measured = frame.depth_m
        depth = None
        if measured is not None:
            depth = _DepthAway(pack_measured(measured, frame.camera.depth_factor), file)
        vars(stored).update(
            index=frame.index, timestamp_s=frame.timestamp_s, camera=frame.camera,
            _file=file, _image=file.put(pack_image(frame.image_rgb)), _depth=depth,
        )  # fmt: skip
        return stored

    @property
    def image_rgb(self) -> NDArray[np.uint8]:
        return unpack_image(self._file.get(self._image))

    @property
    def depth_m(self) -> NDArray[np.float32] | None:
        return None if self._depth is None else self._depth.get()


class StoredPrediction(DepthPrediction):
    """A prediction whose maps are read and unpacked each time they are asked for.

    A sensor's is what it was to the bit; a network's has been rounded to half precision.
    """

    _values: _DepthAway
    _sigma: _DepthAway | None

    def __new__(cls, *args: Any, **fields: Any) -> Any:
        """A plain prediction: what ``dataclasses.replace`` makes of a stored one."""
        return DepthPrediction(*args, **fields)

    @classmethod
    def of(
        cls, prediction: DepthPrediction, file: NamelessFile, frame: StoredFrame | None, per_m: float
    ) -> StoredPrediction:
        """Put the maps of ``prediction`` away in ``file``.

        Args:
            frame: whose sensor depth the values are; None where they are none's.
            per_m: units of a sensor per metre.
        """
        stored = object.__new__(cls)
        if frame is not None:
            values = frame._depth
        elif prediction.is_sensor:
            values = _DepthAway(pack_measured(prediction.values, per_m), file)
        else:
            values = _DepthAway(pack_predicted(prediction.values), file)
        sigma = prediction.sigma_log
        vars(stored).update(
            kind=prediction.kind, is_sensor=prediction.is_sensor,
            _values=values, _sigma=None if sigma is None else _DepthAway(pack_predicted(sigma), file),
        )  # fmt: skip
        return stored

    @property
    def values(self) -> NDArray[np.float32]:
        return self._values.get()

    @property
    def sigma_log(self) -> NDArray[np.float32] | None:
        return None if self._sigma is None else self._sigma.get()
