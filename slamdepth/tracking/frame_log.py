# SPDX-License-Identifier: Apache-2.0
"""Every placed frame, kept so that it follows the map wherever that moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.frontend.pose import refine_pose
from slamdepth.frontend.rolling_shutter import at_middle_row, inverse_depth, row_phase, velocity_between
from slamdepth.geometry import invert
from slamdepth.mapping.landmarks import LandmarkMap
from slamdepth.tracking.localiser import Placement
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MIN_MATCHES = 30
_MAX_GAP_S = 0.2  # frames farther apart say little of the velocity between them
_PRUNE_AT = 256  # frames, then always twice as many
_MAX_SHIFT_SHARE = 0.1  # of the scene's distance: a refinement is no relocation


@dataclass(slots=True)
class _Placed:
    timestamp_s: float
    keyframe: int
    is_keyframe: bool
    is_found_anew: bool
    T_camera_keyframe: NDArray[np.float64]
    rows: NDArray[np.int32]
    px: NDArray[np.float32]
    phase: NDArray[np.float32]
    sigma_px: NDArray[np.float32]


class FrameLog:
    """Frames relative to their keyframe, with what they saw (kiss-slam's local frames).

    Pixels are kept as the shutter took them.
    """

    def __init__(self, camera: Camera, landmarks: LandmarkMap) -> None:
        self._raw_camera = camera
        self._camera = camera.without_distortion()
        self._map = landmarks
        self._placed: list[_Placed] = []
        # rows are remembered as they were numbered then, behind all numbers given away before
        self._row_now = np.zeros(0, dtype=np.int32)
        self._prune_at = _PRUNE_AT

    def __len__(self) -> int:
        return len(self._placed)

    @property
    def held_bytes(self) -> int:
        """Of the arrays."""
        of_frames = ((p.T_camera_keyframe, p.rows, p.px, p.phase, p.sigma_px) for p in self._placed)
        return self._row_now.nbytes + sum(array.nbytes for arrays in of_frames for array in arrays)

    def add(
        self,
        timestamp_s: float,
        features: Features,
        placement: Placement,
        is_keyframe: bool,
        *,
        is_found_anew: bool = False,
    ) -> None:
        """Remember where a frame is, relative to a keyframe that sees the same.

        Args:
            features: as extracted, not yet corrected for a rolling shutter.
            is_found_anew: that no motion leads to it from the frame before.
        """
        reference = self._map.keyframes[-1]
        if (
            not is_keyframe
            and np.count_nonzero(np.isin(reference.point_ids, placement.point_ids)) < _MIN_MATCHES
        ):
            best = self._map.covisible(placement.point_ids, 1)
            reference = self._map.keyframes[best[0]] if best else reference
        # a keyframe's place is the map's own, whatever it saw
        at = np.flatnonzero((placement.point_ids >= 0) & (not is_keyframe))
        self._placed.append(
            _Placed(
                timestamp_s,
                reference.id,
                is_keyframe,
                is_found_anew,
                placement.T_camera_world @ reference.T_world_camera,
                (placement.point_ids[at] + len(self._row_now)).astype(np.int32),
                features.px[at].astype(np.float32),
                row_phase(features.raw_px[at], self._raw_camera).astype(np.float32),
                features.sigma_px[at].astype(np.float32),
            )
        )

    def renumber(self, now: NDArray[np.int64]) -> None:
        """Follow the map when it gave its rows away.

        Args:
            now: as ``LandmarkMap.compact`` returns it.
        """
        self._row_now = np.concatenate([now[self._row_now], now[:-1]]).astype(np.int32)
        if len(self._placed) >= self._prune_at:
            self._prune()
            self._prune_at = 2 * len(self._placed)

    def _prune(self) -> None:
        """Forget what was seen of points that are gone."""
        for placed in self._placed:
            rows = self._row_now[placed.rows]
            kept = rows >= 0
            placed.rows, placed.px = rows[kept], placed.px[kept]
            placed.phase, placed.sigma_px = placed.phase[kept], placed.sigma_px[kept]
        self._row_now = np.zeros(0, dtype=np.int32)

    def rescale(self, scales: Floats) -> None:
        """Multiply the metres of each keyframe ``(K,)`` in the frames that hang on it."""
        for placed in self._placed:
            placed.T_camera_keyframe[:3, 3] *= scales[placed.keyframe]

    def T_camera_world(self, placed: _Placed) -> Floats:
        return placed.T_camera_keyframe @ self._map.keyframes[placed.keyframe].T_camera_world

    def velocity_at(self, keyframe: int) -> Floats | None:
        """Velocity ``(6,)`` of a keyframe, by the frames before and after it; None if it is not there."""
        for n in range(len(self._placed) - 1, -1, -1):
            if self._placed[n].is_keyframe and self._placed[n].keyframe == keyframe:
                return self._velocity(n)
        return None

    def _velocity(self, n: int) -> Floats:
        """Central difference over the frames before and after the ``n``-th, where the camera moved on.

        A frame found anew was placed before it had a velocity, so the two frames after it tell more.
        """
        if self._placed[n].is_found_anew and self._moved_to(n + 1) and self._moved_to(n + 2):
            return self._between(n + 1, n + 2)
        ends = [n]
        if self._moved_to(n):
            ends.insert(0, n - 1)
        if self._moved_to(n + 1):
            ends.append(n + 1)
        return self._between(ends[0], ends[-1]) if len(ends) > 1 else np.zeros(6)

    def _between(self, m: int, n: int) -> Floats:
        """Velocity ``(6,)`` that leads from the ``m``-th frame to the ``n``-th."""
        first, last = self._placed[m], self._placed[n]
        return velocity_between(
            self.T_camera_world(first), self.T_camera_world(last), last.timestamp_s - first.timestamp_s
        )

    def _moved_to(self, n: int) -> bool:
        """Whether the camera moved to the ``n``-th frame from the one before, and not long before."""
        if not 0 < n < len(self._placed) or self._placed[n].is_found_anew:
            return False
        return self._placed[n].timestamp_s - self._placed[n - 1].timestamp_s < _MAX_GAP_S

    def refresh_velocities(self) -> None:
        """Tell every keyframe how it moved."""
        for n, placed in enumerate(self._placed):
            if placed.is_keyframe:
                self._map.keyframes[placed.keyframe].velocity = self._velocity(n)

    def refine(self, readout_s: float) -> None:
        """Place every ordinary frame anew in the final map, by what it saw.

        A frame was placed when half of its points were young; by the end they are known
        better, and the frame with them (motion-only bundle adjustment).
        """
        landmarks = self._map
        row_now = np.concatenate([self._row_now, np.arange(landmarks.size)])
        velocities = [self._velocity(n) for n in range(len(self._placed))] if readout_s else []
        for n, placed in enumerate(self._placed):
            keyframe = landmarks.keyframes[placed.keyframe]
            if placed.is_keyframe:
                placed.T_camera_keyframe = np.eye(4)
                continue
            rows = landmarks.resolve(row_now[placed.rows])
            good = np.flatnonzero(rows >= 0)
            good = good[landmarks.observations[rows[good]] >= 2]
            if len(good) < _MIN_MATCHES:
                continue
            rows = rows[good]
            start = self.T_camera_world(placed)
            px = placed.px[good].astype(np.float64)
            if readout_s:
                inverse = inverse_depth(start, landmarks.position_w[rows])
                phase = placed.phase[good].astype(np.float64)
                px = at_middle_row(self._camera, px, phase, inverse, velocities[n], readout_s)
            estimate = refine_pose(
                self._camera,
                start,
                landmarks.position_w[rows],
                landmarks.covariance_w[rows],
                px,
                placed.sigma_px[good].astype(np.float64),
                rounds=2,
                iterations=2,
            )
            if np.count_nonzero(estimate.inliers) < 0.5 * len(good):
                continue
            distance = float(
                np.median(np.linalg.norm(landmarks.position_w[rows] - invert(start)[:3, 3], axis=1))
            )
            moved = np.linalg.norm(invert(estimate.T_camera_world)[:3, 3] - invert(start)[:3, 3])
            if moved < _MAX_SHIFT_SHARE * distance:
                placed.T_camera_keyframe = estimate.T_camera_world @ keyframe.T_world_camera

    def trajectory(self) -> Trajectory:
        """All placed frames in the world; the first one is its origin."""
        times = np.array([p.timestamp_s for p in self._placed])
        T_camera_world = np.array([self.T_camera_world(p) for p in self._placed]).reshape(-1, 4, 4)
        return Trajectory(times, invert(T_camera_world))
