# SPDX-License-Identifier: Apache-2.0
"""The frames of a run: what is asked of a new one, and where the placed ones are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slamdepth.errors import CameraError, TrackingError
from slamdepth.frontend.features import Features
from slamdepth.frontend.pose import refine_pose
from slamdepth.frontend.rolling_shutter import at_middle_row, inverse_depth, row_phase, velocity_between
from slamdepth.geometry import invert
from slamdepth.io.tree import Tree
from slamdepth.mapping.map import Map
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.frame_sights import FEWEST_SIGHTS, FrameSights
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Bools, Floats, Floats32, Ints

_MAX_GAP_S = 0.2  # frames farther apart say little of the velocity between them
_PRUNE_AT = 256  # frames, then always twice as many
_REMEMBERED = 18_000  # latest frames, ten minutes, whose matches are kept: 5.5 KiB each
_MAX_SHIFT_SHARE = 0.1  # of the scene's distance: a refinement is no relocation


def check_frame(frame: Frame, camera: Camera, last_time_s: float, finished: bool) -> None:
    """Refuse a frame that breaks the contract of ``Tracker.step``.

    Raises:
        TrackingError: the tracker has finished, or time does not increase.
        CameraError: the frame was taken by another camera.
    """
    if finished:
        raise TrackingError("this tracker has finished; make a new one for another sequence")
    if not frame.timestamp_s > last_time_s:
        raise TrackingError(
            f"frame {frame.index}: time must increase, got {frame.timestamp_s} s after {last_time_s} s"
        )
    if frame.camera != camera:
        raise CameraError(f"frame {frame.index} was taken by another camera than the tracker's")


@dataclass(slots=True)
class _Placed:
    timestamp_s: float
    is_keyframe: bool
    follows_motion: bool
    quality: float
    pose: AnchoredPose
    landmark_ids: NDArray[np.int32]
    px: Floats32
    phase: Floats32
    sigma_px: Floats32
    is_settled: bool = False

    @property
    def keyframe(self) -> int:
        return self.pose.keyframe.id


class FrameLog:
    """Placed frames, relative to a keyframe each, with what they saw (kiss-slam's local frames).

    Whatever moves a keyframe moves its frames. Pixels are kept as the shutter took them, of the latest
    frames: older ones have been refined in the map around them, and move with their keyframe only.

    Attributes:
        withdrawn: number of frames that were placed and have no pose any more.
    """

    def __init__(self, camera: Camera, map_: Map) -> None:
        self._raw_camera = camera
        self._camera = camera.without_distortion()
        self._map = map_
        self._placed: list[_Placed] = []
        self._repeats: dict[float, list[float]] = {}  # times of images that repeat a placed one, by its time
        self.withdrawn = 0
        self._settled = 0  # so many of the first frames are settled, or more
        # ids are remembered as they were then, offset by all ids that compactions have renumbered
        self._ids_now = np.zeros(0, dtype=np.int32)
        self._prune_at = _PRUNE_AT

    def __len__(self) -> int:
        return len(self._placed)

    @property
    def size_bytes(self) -> int:
        """Memory of the arrays."""
        of_frames = (
            (p.pose.T_camera_keyframe, p.landmark_ids, p.px, p.phase, p.sigma_px) for p in self._placed
        )
        return self._ids_now.nbytes + sum(array.nbytes for arrays in of_frames for array in arrays)

    def add(
        self,
        timestamp_s: float,
        raw: Features,
        placement: Placement,
        is_keyframe: bool,
        *,
        follows_motion: bool = True,
        quality: float = 1.0,
    ) -> None:
        """Remember where a frame is, relative to a keyframe that sees the same.

        Args:
            raw: features as extracted, not corrected for a rolling shutter.
            follows_motion: a motion leads to it from the frame before.
            quality: of the pose, see :class:`~slamdepth.types.StepResult`.
        """
        reference = self._map.keyframes[-1]
        seen = placement.landmark_ids
        shared = np.count_nonzero(np.isin(reference.landmark_ids, placement.found_ids))
        if not is_keyframe and shared < FEWEST_SIGHTS:
            best = self._map.covisible(seen, 1)
            reference = self._map.keyframes[best[0]] if best else reference
        # a keyframe's pose is the map's own, whatever it saw
        at = np.flatnonzero((seen >= 0) & (not is_keyframe))
        self._placed.append(
            _Placed(
                timestamp_s,
                is_keyframe,
                follows_motion,
                quality,
                AnchoredPose.of(placement.T_camera_world, reference),
                (seen[at] + len(self._ids_now)).astype(np.int32),
                raw.px[at].astype(np.float32),
                row_phase(raw.raw_px[at], self._raw_camera).astype(np.float32),
                raw.sigma_px[at].astype(np.float32),
            )
        )

    @property
    def last_time_s(self) -> float | None:
        """Time of the frame that was placed last."""
        return self._placed[-1].timestamp_s if self._placed else None

    @property
    def last_T_world_camera(self) -> Floats:
        """Pose ``(4, 4)`` of the frame that was placed last, in the map as it is now."""
        return invert(self._placed[-1].pose.T_camera_world)

    def repeat(self, timestamp_s: float) -> None:
        """Remember an image that repeats that of the frame placed last: it has that one's pose."""
        self._repeats.setdefault(self._placed[-1].timestamp_s, []).append(timestamp_s)

    @property
    def repeated(self) -> int:
        """Number of images that repeat that of a frame with a pose."""
        return sum(map(len, self._repeats.values()))

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        placed = self._placed
        counts = [len(p.landmark_ids) for p in placed]
        none = np.zeros(0, dtype=np.float32)
        return {
            "timestamp_s": np.array([p.timestamp_s for p in placed], dtype=np.float64),
            "flags": np.array([(p.is_keyframe, p.follows_motion, p.is_settled) for p in placed], np.bool_),
            "quality": np.array([p.quality for p in placed], dtype=np.float64),
            **AnchoredPose.arrays([p.pose for p in placed]),
            "first": np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            "landmark": np.concatenate([none.astype(np.int32), *(p.landmark_ids for p in placed)]),
            "px": np.concatenate([none.reshape(0, 2), *(p.px for p in placed)]),
            "phase": np.concatenate([none, *(p.phase for p in placed)]),
            "sigma_px": np.concatenate([none, *(p.sigma_px for p in placed)]),
            "ids_now": self._ids_now,
            "repeats": np.array(self._repeat_pairs(), dtype=np.float64).reshape(-1, 2),
            "counts": [self.withdrawn, self._settled, self._prune_at],
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        first = state["first"].tolist()
        poses = AnchoredPose.of_arrays(state, self._map.keyframes)
        self._placed = []
        for n, (is_keyframe, follows_motion, is_settled) in enumerate(state["flags"].tolist()):
            at = slice(first[n], first[n + 1])
            self._placed.append(
                _Placed(
                    float(state["timestamp_s"][n]),
                    is_keyframe,
                    follows_motion,
                    float(state["quality"][n]),
                    poses[n],
                    np.array(state["landmark"][at]),
                    np.array(state["px"][at]),
                    np.array(state["phase"][at]),
                    np.array(state["sigma_px"][at]),
                    is_settled,
                )
            )
        self._ids_now = np.array(state["ids_now"])
        self._repeats = {}
        for of_s, timestamp_s in state["repeats"].tolist():
            self._repeats.setdefault(of_s, []).append(timestamp_s)
        self.withdrawn, self._settled, self._prune_at = state["counts"]

    @property
    def poses(self) -> list[tuple[float, AnchoredPose]]:
        """Time and pose of each frame, in order; those whose image repeats a placed one among them."""
        return [
            (timestamp_s, placed.pose)
            for placed in self._placed
            for timestamp_s in (placed.timestamp_s, *self._repeats.get(placed.timestamp_s, ()))
        ]

    def _repeat_pairs(self) -> list[tuple[float, float]]:
        """Time of a placed frame and of an image that repeats it, for each such image."""
        return [(of_s, timestamp_s) for of_s, times_s in self._repeats.items() for timestamp_s in times_s]

    def withdraw(self, times_s: Sequence[float]) -> None:
        """Forget the poses of frames of these times; keyframes keep theirs."""
        if times_s:
            before = len(self._placed)
            kept = [p for p in self._placed if p.is_keyframe or p.timestamp_s not in times_s]
            self._settled = 0
            self._placed, self.withdrawn = kept, self.withdrawn + before - len(kept)
            kept_s = {p.timestamp_s for p in kept}
            for of_s in [of_s for of_s in self._repeats if of_s not in kept_s]:
                self.withdrawn += len(self._repeats.pop(of_s))

    def renumber(self, ids_now: Ints) -> None:
        """Follow new landmark ids ``(size + 1,)``, see :meth:`Map.compact`."""
        self._ids_now = np.concatenate([ids_now[self._ids_now], ids_now[:-1]]).astype(np.int32)
        if len(self._placed) >= self._prune_at:
            self._prune()
            self._prune_at = 2 * len(self._placed)

    def absorb(self, other: FrameLog, first_landmark: int) -> None:
        """Take over the frames of a map that this map has absorbed.

        Args:
            first_landmark: id that the other map's first landmark has in this map.
        """
        other._ids_now = np.concatenate([other._ids_now, np.arange(other._map.size)]).astype(np.int32)
        other._prune()
        for placed in other._placed:
            placed.landmark_ids = placed.landmark_ids + np.int32(first_landmark + len(self._ids_now))
        self.withdrawn += other.withdrawn
        self._repeats.update(other._repeats)
        self._placed = sorted(self._placed + other._placed, key=lambda placed: placed.timestamp_s)
        self._settled = 0

    def settle(self, readout_s: float) -> None:
        """Refine frames that were placed long ago in the map as it is, and forget what they saw.

        Args:
            readout_s: see :meth:`refine`.
        """
        while self._settled < len(self._placed) - _REMEMBERED:
            n, placed = self._settled, self._placed[self._settled]
            self._settled += 1
            if placed.is_settled:
                continue
            placed.is_settled = True
            if not placed.is_keyframe:
                velocity = self._velocity(n) if readout_s else None
                self._refine(placed, self._map.resolve(self._now(placed.landmark_ids)), velocity, readout_s)
            none = np.zeros(0, dtype=np.float32)
            placed.landmark_ids, placed.px = np.zeros(0, dtype=np.int32), np.zeros((0, 2), dtype=np.float32)
            placed.phase = placed.sigma_px = none

    def _now(self, ids: NDArray[np.int32]) -> Ints:
        """The present ids of landmarks that were remembered, -1 where they are gone."""
        count = len(self._ids_now)
        if count == 0:
            return ids.astype(np.int64)
        was_before = ids < count
        return np.where(was_before, self._ids_now[np.where(was_before, ids, 0)], ids - count)

    def _prune(self) -> None:
        """Forget what was seen of landmarks that are gone."""
        for placed in self._placed:
            ids = self._ids_now[placed.landmark_ids]
            kept = ids >= 0
            placed.landmark_ids, placed.px = ids[kept], placed.px[kept]
            placed.phase, placed.sigma_px = placed.phase[kept], placed.sigma_px[kept]
        self._ids_now = np.zeros(0, dtype=np.int32)

    def velocity_at(self, keyframe: int) -> Floats | None:
        """Velocity ``(6,)`` of a keyframe from the frames before and after it; None if it is not there."""
        for n in range(len(self._placed) - 1, -1, -1):
            if self._placed[n].is_keyframe and self._placed[n].keyframe == keyframe:
                return self._velocity(n)
        return None

    def _velocity(self, n: int) -> Floats:
        """Central difference over the frames before and after the ``n``-th, where the camera moved on.

        A frame that no motion leads to was placed before it had a velocity, so the two frames after it
        say more.
        """
        if not self._placed[n].follows_motion and self._moved_to(n + 1) and self._moved_to(n + 2):
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
            first.pose.T_camera_world, last.pose.T_camera_world, last.timestamp_s - first.timestamp_s
        )

    def _moved_to(self, n: int) -> bool:
        """Whether the camera moved to the ``n``-th frame from the one before, and not long before."""
        if not 0 < n < len(self._placed) or not self._placed[n].follows_motion:
            return False
        return self._placed[n].timestamp_s - self._placed[n - 1].timestamp_s < _MAX_GAP_S

    def refresh_velocities(self) -> None:
        """Give every keyframe its velocity by the trajectory as it is now."""
        for n, placed in enumerate(self._placed):
            if placed.is_keyframe:
                self._map.set_velocity(placed.pose.keyframe, self._velocity(n))

    def refine(self, readout_s: float) -> None:
        """Optimise every ordinary frame's pose in the final map (motion-only bundle adjustment).

        A frame was placed when half of its landmarks were new; by the end they are known better.

        Args:
            readout_s: of the rolling shutter, 0 for a global one.
        """
        velocities = [self._velocity(n) for n in range(len(self._placed))] if readout_s else []
        for n, placed in enumerate(self._placed):
            if placed.is_keyframe:
                placed.pose = AnchoredPose(placed.pose.keyframe, np.eye(4), placed.pose.keyframe.unit)
                continue
            if placed.is_settled:
                continue
            velocity = velocities[n] if readout_s else None
            self._refine(placed, self._map.resolve(self._now(placed.landmark_ids)), velocity, readout_s)

    def sights(self, n: int, readout_s: float) -> FrameSights:
        """What the ``n``-th frame sees of the landmarks that are there still.

        Args:
            readout_s: see :meth:`refine`.
        """
        placed = self._placed[n]
        ids = self._map.resolve(self._now(placed.landmark_ids))
        velocity = self._velocity(n) if readout_s else None
        return self._sights(placed, ids, np.flatnonzero(ids >= 0), velocity, readout_s)

    def _sights(
        self, placed: _Placed, ids: Ints, at: Ints, velocity: Floats | None, readout_s: float
    ) -> FrameSights:
        """What a frame sees, of the landmarks ``ids`` those ``at``."""
        points_w = self._map.landmarks.position_w[ids[at]]
        T_camera_world = placed.pose.T_camera_world
        px = placed.px[at].astype(np.float64)
        if velocity is not None:
            inverse = inverse_depth(T_camera_world, points_w)
            phase = placed.phase[at].astype(np.float64)
            px = at_middle_row(self._camera, px, phase, inverse, velocity, readout_s)
        return FrameSights(T_camera_world, ids[at], points_w, px, placed.sigma_px[at].astype(np.float64))

    def _refine(self, placed: _Placed, ids: Ints, velocity: Floats | None, readout_s: float) -> None:
        landmarks = self._map.landmarks
        good = np.flatnonzero(ids >= 0)
        good = good[landmarks.observations[ids[good]] >= 2]
        if len(good) < FEWEST_SIGHTS:
            return
        sights = self._sights(placed, ids, good, velocity, readout_s)
        estimate = refine_pose(
            self._camera,
            sights.T_camera_world,
            sights.points_w,
            landmarks.covariance_w[ids[good]],
            sights.px,
            sights.sigma_px,
            rounds=2,
            iterations=2,
        )
        if np.count_nonzero(estimate.inliers) >= 0.5 * len(good):
            self._move(placed, estimate.T_camera_world, sights)

    def move(self, n: int, T_camera_world: Floats, sights: FrameSights) -> None:
        """Give the ``n``-th frame a better pose ``(4, 4)``, unless it is nowhere near the one before.

        Args:
            sights: of the frame.
        """
        self._move(self._placed[n], T_camera_world, sights)

    def _move(self, placed: _Placed, T_camera_world: Floats, sights: FrameSights) -> None:
        center_w = invert(sights.T_camera_world)[:3, 3]
        distance = float(np.median(np.linalg.norm(sights.points_w - center_w, axis=1)))
        moved = np.linalg.norm(invert(T_camera_world)[:3, 3] - center_w)
        if moved < _MAX_SHIFT_SHARE * distance:
            placed.pose = AnchoredPose.of(T_camera_world, placed.pose.keyframe)

    @property
    def quality(self) -> Floats:
        """Of each placed frame's pose when it was placed, ``(N,)``."""
        return np.array([p.quality for p in self._placed])

    @property
    def follows_motion(self) -> Bools:
        """Whether a motion led to each placed frame from the one before, ``(N,)``."""
        return np.array([p.follows_motion for p in self._placed], dtype=np.bool_)

    def trajectory(self) -> Trajectory:
        """All placed frames in the world frame, without those whose image repeats another."""
        times = np.array([p.timestamp_s for p in self._placed])
        T_camera_world = np.array([p.pose.T_camera_world for p in self._placed]).reshape(-1, 4, 4)
        return Trajectory(times, invert(T_camera_world))

    def with_repeats(self, trajectory: Trajectory) -> Trajectory:
        """``trajectory`` with the frames whose image repeats one of its frames."""
        row = {timestamp_s: n for n, timestamp_s in enumerate(trajectory.timestamps_s.tolist())}
        pairs = [(of_s, timestamp_s) for of_s, timestamp_s in self._repeat_pairs() if of_s in row]
        if not pairs:
            return trajectory
        times = np.concatenate([trajectory.timestamps_s, [timestamp_s for _, timestamp_s in pairs]])
        rows = np.concatenate([np.arange(len(trajectory)), [row[of_s] for of_s, _ in pairs]]).astype(np.int64)
        order = np.argsort(times)
        return replace(
            trajectory, timestamps_s=times[order], T_world_camera=trajectory.T_world_camera[rows[order]]
        )
