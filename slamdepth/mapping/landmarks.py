# SPDX-License-Identifier: Apache-2.0
"""The arrays of a map's landmarks: one that the map writes, and a read-only one for everybody else."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth.typing import Bools, Floats, Ints


@dataclass(frozen=True)
class Landmarks:
    """Landmarks as arrays ``(N, ...)``; a landmark's id is its index.

    Attributes:
        position_w: ``(N, 3)`` metres, world frame.
        covariance_w: ``(N, 3, 3)`` m^2, world frame.
        descriptor: ``(N, D)`` of the feature that created the landmark.
        anchor_keyframe: ``(N,)`` keyframe that created it; it moves with that keyframe.
        octave: ``(N,)`` pyramid level it was created at.
        distance_m: ``(N,)`` from the anchor keyframe's camera centre.
        direction_w: ``(N, 3)`` unit vector from that centre, world frame.
        expected: ``(N,)`` how often a placed camera should have seen it.
        found: ``(N,)`` how often a placed camera did.
        observations: ``(N,)`` number of keyframes that see it.
        alive: ``(N,)`` False once it was culled or fused into another.
        alias: ``(N,)`` landmark it was fused into, else its own id.
    """

    position_w: Floats
    covariance_w: Floats
    descriptor: NDArray[Any]
    anchor_keyframe: Ints
    octave: Ints
    distance_m: Floats
    direction_w: Floats
    expected: Ints
    found: Ints
    observations: Ints
    alive: Bools
    alias: Ints

    @staticmethod
    def empty(capacity: int, descriptors: NDArray[Any] | None = None) -> Landmarks:
        """Arrays of zeros for ``capacity`` landmarks, with descriptors shaped like ``descriptors (N, D)``."""

        def integers() -> Ints:
            return np.zeros(capacity, dtype=np.int64)

        like = np.zeros((0, 0), np.uint8) if descriptors is None else descriptors
        return Landmarks(
            position_w=np.zeros((capacity, 3)),
            covariance_w=np.zeros((capacity, 3, 3)),
            descriptor=np.zeros((capacity, *like.shape[1:]), like.dtype),
            anchor_keyframe=integers(),
            octave=integers(),
            distance_m=np.zeros(capacity),
            direction_w=np.zeros((capacity, 3)),
            expected=integers(),
            found=integers(),
            observations=integers(),
            alive=np.zeros(capacity, dtype=np.bool_),
            alias=integers(),
        )

    def __len__(self) -> int:
        return len(self.alive)

    def moved(self, kept: Ints, capacity: int) -> Landmarks:
        """Copies with room for ``capacity`` landmarks, the landmarks ``kept`` as the first ones."""
        grown = Landmarks.empty(capacity, self.descriptor)
        for field in fields(self):
            getattr(grown, field.name)[: len(kept)] = getattr(self, field.name)[kept]
        return grown

    def joined(self, size: int, other: Landmarks, first_keyframe: int) -> Landmarks:
        """Copies of the first ``size`` landmarks and of all ``other`` ones behind them.

        Args:
            first_keyframe: number that the other map's first keyframe has from now on.
        """
        count = len(other)
        grown = self.moved(np.arange(size), size + count)
        for field in fields(self):
            getattr(grown, field.name)[size:] = getattr(other, field.name)
        grown.anchor_keyframe[size:] += first_keyframe
        grown.alias[size:] += size
        return grown

    def read_only(self, size: int) -> Landmarks:
        """Views of the first ``size`` landmarks that follow every change and cannot be written."""
        views = {field.name: getattr(self, field.name)[:size] for field in fields(self)}
        for view in views.values():
            view.flags.writeable = False
        return Landmarks(**views)


@dataclass(frozen=True)
class AdjustedLandmarks:
    """Landmarks ``ids (N,)`` at ``position_w (N, 3)`` metres with ``covariance_w (N, 3, 3)`` m^2."""

    ids: Ints
    position_w: Floats
    covariance_w: Floats
