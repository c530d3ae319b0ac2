# SPDX-License-Identifier: Apache-2.0
"""How much memory a tracker's arrays take, by what they are for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.frontend.matching import PixelGrid
from slamdepth.mapping.keyframe_store import KeyframeStore
from slamdepth.mapping.landmarks import LandmarkMap
from slamdepth.tracking.frame_log import FrameLog

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class HeldBytes:
    """Bytes of arrays.

    Attributes:
        images: images and depth maps of keyframes in memory; bounded by
            ``map.keyframe_memory_mib`` or by eight keyframes, whichever is more.
        features: keypoints, descriptors and depth priors of keyframes.
        points: map points.
        frames: what every frame saw.
        on_disk: images and depth maps in the temporary file.
    """

    images: int
    features: int
    points: int
    frames: int
    on_disk: int


def held_bytes(landmarks: LandmarkMap, frames: FrameLog, store: KeyframeStore) -> HeldBytes:
    """What map, frames and images take."""
    return HeldBytes(
        images=store.resident_bytes,
        features=sum(array.nbytes for keyframe in landmarks.keyframes for array in _arrays(keyframe)),
        points=sum(array.nbytes for array in _arrays(landmarks)),
        frames=frames.held_bytes,
        on_disk=store.spilled_bytes,
    )


def _arrays(holder: object) -> Iterator[NDArray[Any]]:
    for value in vars(holder).values():
        if isinstance(value, np.ndarray):
            yield value
        elif isinstance(value, Features | PixelGrid):
            yield from _arrays(value)
