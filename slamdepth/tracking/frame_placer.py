# SPDX-License-Identifier: Apache-2.0
"""How a frame is placed in a map: every way, the cheapest first."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.geometry import orthonormalised
from slamdepth.loops.look_alikes import Reach
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.map_parts import MapParts, RunParts
from slamdepth.tracking.pose_check import Verdict
from slamdepth.types import Frame
from slamdepth.typing import Floats

log = logging.getLogger(__name__)

_SAME_MOTION = 0.8  # of a frame's landmarks agree still; of consecutive frames 0.92 and more


@dataclass(frozen=True)
class Found:
    """Where a frame was found.

    Attributes:
        raw, features: of the frame, as extracted, or aligned to the map's images, and as extracted and
            corrected for a rolling shutter.
        placement: its pose.
        placed_by: how it was found first.
    """

    raw: Features
    features: Features
    placement: Placement
    placed_by: PlacedBy


class FramePlacer:
    """Places frames in one map.

    Args:
        parts: of the map.
        run: what it shares with other maps.
    """

    def __init__(self, parts: MapParts, run: RunParts) -> None:
        self._parts = parts
        self._watch = run.watch
        self._wide_features = run.wide_features
        self._counts_views = run.grows_maps

    def place(self, frame: Frame, raw: Features) -> Found | None:
        """Place a frame in the map; None where the camera is lost, and its motion forgotten."""
        parts = self._parts
        if parts.view_change.is_large:
            raw = self._wide_features(frame)
        with self._watch.timed("tracking"):
            features = parts.shutter.correct_by_motion(raw, parts.motion, frame.timestamp_s)
            placement = self._place(frame, features)
            if placement is None and parts.view_change.count_lost():
                raw, features, placement = self._place_wide(frame, raw)
            placement = placement or self._register(frame, features)
            if placement is None:
                self._lose()
                return None
            placed_by = placement.placed_by
            features, placement = self._correct_by_pose(frame, raw, features, placement)
            self._measure_step(placement)
            return self._aligned(frame, Found(raw, features, placement, placed_by))

    def find(self, frame: Frame, raw: Features) -> Found | None:
        """Place a frame by what it looks like, where the camera was in another map."""
        with self._watch.timed("tracking"):
            placement = self._parts.relocaliser.by_place(raw)
            placement = self._count(frame, raw, placement)
            if placement is None:
                return None
            return self._aligned(frame, Found(raw, raw, placement, placement.placed_by))

    def _place(self, frame: Frame, features: Features) -> Placement | None:
        """Every usual way to place a frame by its features, the cheapest first; None where it is lost."""
        parts, placement, newest = self._parts, None, None
        if parts.motion.is_known:
            newest = len(parts.map.keyframes) - 1
            if parts.view_change.is_large:
                placement = parts.localiser.from_keyframe(features, newest)
            placement = placement or self._track_motion(frame, features)
            # landmarks of waiting keyframes may be what is missing
            if placement is None and parts.integration.run_all():
                parts.motion.follow_map()
                placement = self._track_motion(frame, features)
            placement = placement or parts.localiser.from_keyframe(features, newest)
        else:
            parts.relocaliser.schedule.count_frame()
        placement = placement or parts.relocaliser.by_place(features, without=newest, reach=self._reach())
        return self._count(frame, features, placement)

    def _place_wide(self, frame: Frame, raw: Features) -> tuple[Features, Features, Placement | None]:
        """Place a frame that the usual ways did not place by more features and over a wide baseline.

        Returns:
            Its features, raw and to go on with, and the placement; those given where it is still lost.
        """
        parts = self._parts
        was_large = parts.view_change.is_large
        wide = raw if was_large else self._wide_features(frame)
        parts.integration.run_all()
        parts.motion.follow_map()
        parts.view_change.is_large = True
        is_lost = not parts.motion.is_known
        found = parts.relocaliser.by_recent(wide, is_lost=is_lost, reach=self._reach())
        placement = self._count(frame, wide, found)
        if placement is None:
            parts.view_change.is_large = was_large
            return raw, raw, None
        parts.view_change.found_wide()
        return wide, wide, placement

    def _register(self, frame: Frame, features: Features) -> Placement | None:
        """Place a frame by registering its depth; the last and dearest way."""
        found = self._parts.relocaliser.by_registration(frame, features, self._guess(frame))
        return self._count(frame, features, found)

    def _aligned(self, frame: Frame, found: Found) -> Found:
        """Align what a frame sees in the map's images, where it has any, and place the frame by that.

        Landmarks and their deviations stay those of the detected keypoints, which say how sure the pose is.
        """
        if self._parts.aligner is None:
            return found
        placement = found.placement
        raw = self._parts.aligner(frame, found.raw, placement)
        corrected = self._parts.shutter.correct_by_pose(raw, self._parts.motion, frame.timestamp_s, placement)
        refined = self._parts.localiser.reoptimise(corrected or raw, placement)
        placement = replace(placement, T_camera_world=refined.T_camera_world)
        return replace(found, raw=raw, placement=placement)

    def _count(self, frame: Frame, features: Features, placement: Placement | None) -> Placement | None:
        """Count what a found placement saw; None where there is none, or it is not earned."""
        if placement is None or not self._is_earned(frame, features, placement):
            return None
        self._parts.placed_by[placement.placed_by] += 1
        if self._counts_views:
            self._parts.map.count_views(placement.expected_ids, placement.found_ids)
        was_cut = placement.placed_by is PlacedBy.LAST_KEYFRAME and not self._parts.view_change.is_large
        if was_cut or placement.placed_by is PlacedBy.PLACE:
            self._parts.motion.forget()  # found by its view alone: the recording may have been cut
        return placement

    def _measure_step(self, placement: Placement) -> None:
        """Learn from a placed frame whether the camera takes large steps."""
        self._parts.view_change.count_placed()
        if self._parts.motion.is_known:
            self._parts.view_change.measure(
                self._parts.motion.T_camera_world, placement.T_camera_world, placement.landmark_ids
            )
        self._parts.shutter.trusts_motion = not self._parts.view_change.is_large

    def _is_earned(self, frame: Frame, features: Features, placement: Placement) -> bool:
        """Judge a pose; provisional ones before it that it contradicts are withdrawn."""
        judgement = self._parts.check.judge(frame.timestamp_s, features, placement, self._guess(frame))
        self._parts.frames.withdraw(judgement.withdrawn_s)
        if judgement.why:
            log.debug("frame %d: pose is %s: %s", frame.index, judgement.verdict.value, judgement.why)
        return judgement.verdict is not Verdict.LOST

    def _guess(self, frame: Frame) -> Floats | None:
        """``T_camera_world (4, 4)`` by the motion model; None where no motion is known."""
        motion = self._parts.motion
        return motion.predict(frame.timestamp_s) if motion.is_known else None

    def _reach(self) -> Reach | None:
        """Where the camera can have got to since it was placed last."""
        motion = self._parts.motion
        return self._parts.relocaliser.reach(motion.T_camera_world if motion.is_known else None, motion.step)

    def _track_motion(self, frame: Frame, features: Features) -> Placement | None:
        recent = self._parts.map.resolve(self._parts.motion.landmark_ids)
        T_guess = self._parts.motion.predict(frame.timestamp_s)
        return self._parts.localiser.track(features, T_guess, np.unique(recent[recent >= 0]))

    def _lose(self) -> None:
        """Forget the motion; where it led to last is tried again for some frames."""
        self._parts.frames.withdraw(self._parts.check.lose())
        if self._parts.motion.is_known:
            self._parts.relocaliser.schedule.start(self._parts.motion.T_camera_world, self._parts.motion.step)
        self._parts.motion.forget()

    def _correct_by_pose(
        self, frame: Frame, raw: Features, features: Features, placement: Placement
    ) -> tuple[Features, Placement]:
        """Correct the rolling shutter by the velocity of this very frame, and place the frame by that.

        Where its landmarks contradict that velocity, the recording was cut and the camera did not move there.
        """
        corrected = self._parts.shutter.correct_by_pose(raw, self._parts.motion, frame.timestamp_s, placement)
        if corrected is None:
            return features, placement
        refined = self._parts.localiser.reoptimise(corrected, placement)
        if refined.inliers >= _SAME_MOTION * placement.inliers:
            return corrected, refined
        self._parts.motion.forget()
        return raw, self._parts.localiser.reoptimise(raw, placement)

    def place_in_adjusted_map(self, features: Features, placement: Placement) -> Placement:
        """Place a frame again, once the landmarks that a keyframe got from earlier ones are adjusted."""
        return self._place_again(features, placement, self._parts.integration.run_until_adjusted)

    def place_in_grown_map(self, features: Features, placement: Placement) -> Placement:
        """Place a frame again, once the keyframe that waits longest has its own depth."""
        return self._place_again(features, placement, self._parts.integration.run_until_landmarks)

    def _place_again(self, features: Features, placement: Placement, grow: Callable[[], None]) -> Placement:
        pose = AnchoredPose.of(placement.T_camera_world, self._parts.map.keyframes[-1])
        grow()
        self._parts.motion.follow_map()
        carried = replace(
            placement,
            T_camera_world=orthonormalised(pose.T_camera_world),
            landmark_ids=self._parts.map.resolve(placement.landmark_ids),
        )
        with self._watch.timed("tracking"):
            refined = self._parts.localiser.refine_in_local_map(features, carried)
        if refined is None:
            return carried
        self._parts.map.count_views(refined.expected_ids, refined.found_ids)
        return refined
