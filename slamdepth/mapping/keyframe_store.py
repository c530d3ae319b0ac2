# SPDX-License-Identifier: Apache-2.0
"""Images and depth maps of keyframes within a memory budget.

Tracking needs those of the newest keyframes only; mesh and report need all of them, one keyframe after
the other. Beyond the budget, the oldest are spilled to a temporary file and read back on ``load()``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from slamdepth.errors import DatasetError, TrackingError
from slamdepth.mapping.codec import (
    Encoded,
    decode_image,
    encode_half_precision,
    encode_image,
    encode_sensor_depth,
    rounded_to_half_precision,
)
from slamdepth.mapping.spill_file import SpilledArray, SpillFile
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NEWEST = 8  # never spilled: tracking still reads them


class StoredFrame:
    """Handle of a frame whose images are in memory or spilled to a file.

    Attributes:
        index, timestamp_s, camera, gravity: as for :class:`slamdepth.Frame`; always in memory.
    """

    def __init__(self, frame: Frame) -> None:
        self.index, self.timestamp_s = frame.index, frame.timestamp_s
        self.camera, self.gravity = frame.camera, frame.gravity
        self._resident: Frame | None = frame
        self._image: SpilledArray | None = None
        self._depth: SpilledArray | None = None
        self._jpeg: Encoded | None = None  # of a saved map, or of a resident image once it was asked for
        self._read: Callable[[], Frame] | None = None
        self._is_read_as_jpeg = False

    @classmethod
    def of_saved(
        cls,
        index: int,
        timestamp_s: float,
        camera: Camera,
        gravity: NDArray[np.float64] | None = None,
        read: Callable[[], Frame] | None = None,
        jpeg: bytes | None = None,
    ) -> StoredFrame:
        """Handle of a frame of a saved map or of an earlier process.

        Args:
            read: reads the frame of an earlier process.
            jpeg: the image that a saved map has of it; None where it was not kept.
        """
        stored = cls.__new__(cls)
        stored.index, stored.timestamp_s, stored.camera, stored.gravity = index, timestamp_s, camera, gravity
        stored._resident = stored._image = stored._depth = None
        stored._read, stored._is_read_as_jpeg = read, False
        stored._jpeg = None if jpeg is None else Encoded(jpeg, stored._decoded)
        return stored

    @property
    def is_spilled(self) -> bool:
        return self._resident is None

    @property
    def is_kept(self) -> bool:
        """Whether :meth:`load` can give the frame."""
        kept = (self._resident, self._image, self._jpeg, self._read)
        return any(one is not None for one in kept)

    def load(self) -> Frame:
        """The frame; where it was spilled, read from the file each time.

        Depth is what it was to the bit. The colours of a spilled frame are those of a JPEG of quality 95.

        Raises:
            TrackingError: it belongs to a map that was saved without images.
            DatasetError: the image that the map has is damaged.
        """
        if (frame := self._resident) is not None:
            return frame
        if self._read is not None:
            frame = self._read()
            if not self._is_read_as_jpeg:
                return frame
            return replace(frame, image_rgb=np.asarray(encode_image(frame.image_rgb).array()))
        if self._jpeg is not None:
            image_rgb = self._jpeg.array()
            return Frame(self.index, self.timestamp_s, image_rgb, self.camera, gravity=self.gravity)
        if self._image is None:
            raise TrackingError(f"the image of frame {self.index} was not saved with the map")
        depth_m = None if self._depth is None else self._depth.load()
        return Frame(
            self.index, self.timestamp_s, self._image.load(), self.camera, depth_m, gravity=self.gravity
        )

    def image_bytes(self) -> bytes:
        """The JPEG that a spilled image is kept as, whether it was spilled or not. Raises as :meth:`load`."""
        return self._encoded().data

    def load_as_spilled(self) -> NDArray[np.uint8]:
        """The image ``(H, W, 3)`` as a spilled one is read back, whether it was spilled or not.

        What it decides does not depend on how much memory there is. Raises as :meth:`load`.
        """
        return np.asarray(self._encoded().array())

    def _encoded(self) -> Encoded:
        if self._jpeg is not None:
            return self._jpeg
        if self._resident is None and self._image is not None:
            return self._image.encoded()
        frame = self.load() if self._read is None else self._read()
        jpeg = encode_image(frame.image_rgb)
        if self._resident is not None:
            self._jpeg = jpeg
        return jpeg

    def _decoded(self, jpeg: bytes) -> NDArray[np.uint8]:
        """The image that a saved map has; raises DatasetError where it is damaged."""
        try:
            image_rgb = decode_image(jpeg)
        except ValueError as error:
            raise DatasetError(f"the map's image of frame {self.index} is damaged: {error}") from error
        if image_rgb.shape[:2] != (self.camera.height, self.camera.width):
            raise DatasetError(f"the map's image of frame {self.index} is damaged: it has another size")
        return image_rgb

    def _spill(self, file: SpillFile) -> None:
        """Move the images to ``file``; those that the sequence has stay there, and lose as much."""
        if (frame := self._resident) is None:
            self._is_read_as_jpeg = self._read is not None
            return
        if frame.depth_m is not None:
            self._depth = file.spill(encode_sensor_depth(frame.depth_m, frame.camera.depth_factor))
        self._image = file.spill(self._encoded())
        self._resident = self._jpeg = None


class StoredPrediction:
    """Handle of a prediction whose maps are in memory or spilled to a file.

    A network's maps are rounded to half precision at once, so that what they decide depends neither on how
    much memory there is nor on a run that was killed and went on.

    Attributes:
        kind, is_sensor, gravity, gravity_share, scale_sigma_log: as for :class:`slamdepth.DepthPrediction`;
            always in memory.
    """

    def __init__(self, prediction: DepthPrediction) -> None:
        self.kind, self.is_sensor = prediction.kind, prediction.is_sensor
        self.gravity, self.gravity_share = prediction.gravity, prediction.gravity_share
        self.scale_sigma_log = prediction.scale_sigma_log
        self._resident: DepthPrediction | None = prediction if prediction.is_sensor else _rounded(prediction)
        self._values: SpilledArray | None = None
        self._sigma_log: SpilledArray | None = None
        self._read: Callable[[], DepthPrediction] | None = None

    @classmethod
    def of_saved(
        cls,
        kind: DepthKind,
        *,
        is_sensor: bool,
        gravity: NDArray[np.float64] | None = None,
        gravity_share: float = 0.0,
        scale_sigma_log: float | None = None,
        read: Callable[[], DepthPrediction] | None = None,
    ) -> StoredPrediction:
        """Handle of a prediction of a saved map or of an earlier process.

        Args:
            read: reads the prediction; None where its maps were not kept.
        """
        stored = cls.__new__(cls)
        stored.kind, stored.is_sensor = kind, is_sensor
        stored.gravity, stored.gravity_share = gravity, gravity_share
        stored.scale_sigma_log = scale_sigma_log
        stored._resident = stored._values = stored._sigma_log = None
        stored._read = read
        return stored

    @property
    def is_spilled(self) -> bool:
        return self._resident is None

    @property
    def is_kept(self) -> bool:
        """Whether :meth:`load` can give the prediction."""
        return not (self._resident is None and self._values is None and self._read is None)

    def load(self) -> DepthPrediction:
        """The prediction; where it was spilled, read from the file each time.

        A sensor's map is what it was to the bit, a network's is rounded to half precision.

        Raises:
            TrackingError: it belongs to a map that was saved without images.
        """
        if (prediction := self._resident) is not None:
            return prediction
        if self._read is not None:
            return self._read()
        if self._values is None:
            raise TrackingError("the depth of this keyframe was not saved with the map")
        return DepthPrediction(
            self._values.load(),
            self.kind,
            None if self._sigma_log is None else self._sigma_log.load(),
            is_sensor=self.is_sensor,
            gravity=self.gravity,
            gravity_share=self.gravity_share,
            scale_sigma_log=self.scale_sigma_log,
        )

    def _spill(self, file: SpillFile, frame: StoredFrame) -> None:
        """Move the maps to ``file``.

        Args:
            frame: what the prediction was made for. Values that are its sensor depth are written once.
        """
        if (prediction := self._resident) is None:
            return
        if not prediction.is_sensor:
            self._values = file.spill(encode_half_precision(prediction.values))
        elif prediction.values is frame.load().depth_m:
            frame._spill(file)
            self._values = frame._depth
        else:
            self._values = file.spill(encode_sensor_depth(prediction.values, frame.camera.depth_factor))
        if prediction.sigma_log is not None:
            self._sigma_log = file.spill(encode_half_precision(prediction.sigma_log))
        self._resident = None


def _rounded(prediction: DepthPrediction) -> DepthPrediction:
    """A prediction whose maps have half precision; their types stay."""
    sigma = prediction.sigma_log
    return replace(
        prediction,
        values=rounded_to_half_precision(prediction.values),
        sigma_log=None if sigma is None else rounded_to_half_precision(sigma),
    )


class HasImages(Protocol):
    """A keyframe of the map or of a tracker."""

    @property
    def frame(self) -> StoredFrame: ...

    @property
    def prediction(self) -> StoredPrediction | None: ...


class KeyframeStore:
    """Keeps images and depth maps of keyframes within a memory budget.

    Args:
        budget_mib: bytes that images and maps may take in memory, decoded; the newest eight keyframes stay
            whatever the budget.
    """

    def __init__(self, budget_mib: float) -> None:
        self._budget_bytes = budget_mib * 2**20
        self._file = SpillFile()
        self._sizes: list[int] = []
        self._spilled = 0

    @property
    def resident_bytes(self) -> int:
        """Bytes of images and depth maps in memory."""
        return sum(self._sizes[self._spilled :])

    @property
    def spilled_bytes(self) -> int:
        """Size of the temporary file."""
        return self._file.size

    def state(self) -> list[Any]:
        """Everything it remembers, for a checkpoint."""
        return [list(self._sizes), self._spilled]

    def restore(self, state: Sequence[Any], keyframes: Sequence[HasImages]) -> None:
        """Remember what :meth:`state` gave, so that the same images are kept as JPEGs as would have been.

        Args:
            keyframes: read from their sequence.
        """
        self._sizes, self._spilled = list(state[0]), state[1]
        for keyframe in keyframes[: self._spilled]:
            keyframe.frame._spill(self._file)

    def tidy(self, keyframes: Sequence[HasImages], budget_bytes: float | None = None) -> None:
        """Spill the oldest of ``keyframes`` until the rest is within the budget.

        Args:
            keyframes: all so far, in the same order each time, each with its prediction.
            budget_bytes: for this time; None takes the store's own.
        """
        budget = self._budget_bytes if budget_bytes is None else budget_bytes
        self._sizes += [_size(keyframe) for keyframe in keyframes[len(self._sizes) :]]
        while self.resident_bytes > budget and self._spilled < len(keyframes) - _NEWEST:
            keyframe = keyframes[self._spilled]
            if keyframe.prediction is not None:
                keyframe.prediction._spill(self._file, keyframe.frame)
            keyframe.frame._spill(self._file)
            self._spilled += 1


def _size(keyframe: HasImages) -> int:
    if keyframe.frame.is_spilled:  # by the map that it was taken over from
        return 0
    frame = keyframe.frame.load()
    arrays: list[NDArray[Any] | None] = [frame.image_rgb, frame.depth_m]
    if keyframe.prediction is not None:
        prediction = keyframe.prediction.load()
        arrays += [prediction.values, prediction.sigma_log]
    return sum({id(array): array.nbytes for array in arrays if array is not None}.values())
