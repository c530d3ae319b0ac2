# SPDX-License-Identifier: Apache-2.0
"""One map: the parts that grow it, and how a frame is placed in it."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.geometry import Similarity, orthonormalised
from slamdepth.loops.meeting import Meeting
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.map import Map
from slamdepth.mapping.map_keyframe import AnchoredPose, MapKeyframe
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.integration import KeyframeIntegration
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.motion import MotionModel
from slamdepth.tracking.pose_check import PoseCheck, Verdict
from slamdepth.tracking.relocaliser import Relocaliser
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import Workers
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

log = logging.getLogger(__name__)

_SAME_MOTION = 0.8  # of a frame's landmarks agree still; of consecutive frames 0.92 and more


@dataclass(frozen=True)
class Placed:
    """A frame that was placed.

    Attributes:
        placement: its pose in the map as it is now.
        placed_by: how it was found.
        is_keyframe: True where it became a keyframe.
        covariance, quality: of the pose, see :class:`StepResult`.
    """

    placement: Placement
    placed_by: PlacedBy
    is_keyframe: bool
    covariance: Floats | None
    quality: float


class MapTracker:
    """Tracks the camera in one map, and grows the map.

    Args:
        id_: number of the map in its run.
        levels: pyramid levels of the extractor.
        workers, watch: shared by the maps of a run.
        wide_features: finds more features of a frame, for a search over a wide baseline.

    Attributes:
        id: number of the map, from 0 in the order of their start.
        map, frames, motion, shutter, localiser, check, integration, relocaliser: the parts, of this map.
        placed_by: how many frames were placed by what.
    """

    def __init__(
        self,
        id_: int,
        camera: Camera,
        config: Config,
        levels: ScaleLevels,
        workers: Workers,
        watch: Stopwatch,
        wide_features: Callable[[Frame], Features],
    ) -> None:
        self.id = id_
        self._config = config
        self._workers = workers
        self._watch = watch
        self._wide_features = wide_features
        self.map = Map(config.map.keyframe_memory_mib)
        self.frames = FrameLog(camera, self.map)
        self.motion = MotionModel()
        self.shutter = RollingShutter(camera, config.shutter, self.map)
        self.localiser = Localiser(camera, config, self.map, levels)
        self.check = PoseCheck(camera, self.map, self.localiser)
        self.view_change = self.localiser.view_change
        self.integration = KeyframeIntegration(
            camera,
            config,
            self.map,
            self.localiser,
            self.frames,
            self.shutter,
            workers,
            watch,
        )
        self.relocaliser = Relocaliser(
            camera,
            config,
            self.map,
            self.localiser,
            self.integration.loops.places,
            workers.depth,
        )
        self.placed_by: Counter[PlacedBy] = Counter()

    def start(self, frame: Frame, features: Features) -> Placed | None:
        """Start the map with a frame; None where its depth does not create enough landmarks."""
        if self.view_change.is_large:
            features = self._wide_features(frame)
        need = self._config.tracking.min_inliers
        depth = self._workers.depth
        if len(features) < need or not depth.has_depth(frame):
            return None
        if self.integration.mapper.count_creatable(features, depth.take(frame)) < need:
            return None
        origin = Placement(np.eye(4), np.full(len(features), -1, dtype=np.int64))
        placement = self._add_keyframe(frame, features, origin)
        self.frames.add(frame.timestamp_s, features, placement, is_keyframe=True)
        return self._placed(frame, features, placement, PlacedBy.MOTION, is_keyframe=True)

    def track(self, frame: Frame, raw: Features) -> Placed | None:
        """Place a frame in the map, and make it a keyframe where the view has moved on.

        Returns:
            None where the camera is lost.
        """
        self._compact()
        if self.view_change.is_large:
            raw = self._wide_features(frame)
        with self._watch.timed("tracking"):
            features = self.shutter.correct_by_motion(raw, self.motion, frame.timestamp_s)
            placement = self._place(frame, features)
            if placement is None and self.view_change.count_lost():
                raw, features, placement = self._place_wide(frame, raw)
            placement = placement or self._register(frame, features)
            if placement is None:
                self._lose()
                return None
            placed_by = placement.placed_by
            features, placement = self._correct_by_pose(frame, raw, features, placement)
            self._measure_step(placement)
        return self._add(frame, raw, features, placement, placed_by)

    def find(self, frame: Frame, raw: Features) -> Placed | None:
        """Place a frame by what it looks like, in a map that the camera was not in."""
        with self._watch.timed("tracking"):
            placement = self.relocaliser.by_place(raw)
        if placement is None or not self._is_earned(frame, raw, placement):
            return None
        self.placed_by[placement.placed_by] += 1
        self.map.count_views(placement.expected_ids, placement.found_ids)
        return self._add(frame, raw, raw, placement, placement.placed_by)

    def leave(self) -> None:
        """The camera is in another map from now on."""
        self.integration.run_all()
        self.motion.forget()
        self.map.spill_all_images()

    @property
    def places(self) -> PlaceRecogniser:
        """Index of the map's keyframes by what they look like."""
        return self.integration.loops.places

    def place_keyframe(self, keyframe: MapKeyframe, candidate: int) -> Placement | None:
        """Place a keyframe of any map by matching it with the keyframe ``candidate`` of this map."""
        return self.localiser.from_keyframe(keyframe.features, candidate, is_lost=True)

    def move(self, similarity: Similarity) -> None:
        """Express everything in another world frame, and in its metres; no keyframe waits."""
        self.map.move(similarity)
        self.motion.rescale(similarity.scale)
        self.check.forget_motion()
        self.integration.gravity.turn(similarity.T_a_b[:3, :3])

    def absorb(self, other: MapTracker, meetings: Sequence[Meeting]) -> None:
        """Go on in the place of another map in the same world frame, which must not be used any more.

        Args:
            meetings: what the two maps were joined by.
        """
        first_keyframe, first_landmark = self.map.absorb(other.map)
        self.frames.absorb(other.frames, first_landmark)
        self.motion = other.motion
        self.check.forget_motion()
        self.view_change.is_large = other.view_change.is_large
        ids = self.motion.landmark_ids
        self.motion.landmark_ids = np.where(ids >= 0, ids + first_landmark, -1)
        self.placed_by += other.placed_by
        self.shutter.adopt(other.shutter)
        self.integration.join(other.integration, first_keyframe, meetings)
        self.motion.follow_map()

    def _add(
        self, frame: Frame, raw: Features, features: Features, placement: Placement, placed_by: PlacedBy
    ) -> Placed:
        """Add a placed frame to the log, and to the map where the view has moved on."""
        follows_motion = self.motion.is_known
        if placement.is_loose and self.integration.awaits_landmarks:
            placement = self._place_in_grown_map(features, placement)
        is_keyframe = self.integration.wants(placement) and self._workers.depth.has_depth(frame)
        is_keyframe &= not self.check.is_provisional
        if is_keyframe and self.integration.is_full:
            placement = self._place_in_grown_map(features, placement)
            is_keyframe = self.integration.wants(placement)
        if is_keyframe:
            placement = self._add_keyframe(frame, features, placement)
        else:
            self.motion.advance(frame.timestamp_s, placement.T_camera_world)
            self.motion.anchor(placement, self.map.keyframes[-1])
        placed = self._placed(frame, features, placement, placed_by, is_keyframe=is_keyframe)
        self.frames.add(
            frame.timestamp_s,
            raw,
            placement,
            is_keyframe,
            follows_motion=follows_motion,
            quality=placed.quality,
        )
        return placed

    def _placed(
        self,
        frame: Frame,
        features: Features,
        placement: Placement,
        placed_by: PlacedBy,
        *,
        is_keyframe: bool,
    ) -> Placed:
        with self._watch.timed("uncertainty"):
            covariance, quality = self.check.uncertainty(frame.timestamp_s, features, placement)
        return Placed(placement, placed_by, is_keyframe, covariance, quality)

    def run_stage(self) -> None:
        """Go on with the integration of keyframes before the next frame."""
        self.integration.run_stage()
        self.motion.follow_map()

    def _place(self, frame: Frame, features: Features) -> Placement | None:
        """Every usual way to place a frame by its features, the cheapest first; None where it is lost."""
        placement = None
        newest = None
        if self.motion.is_known:
            newest = len(self.map.keyframes) - 1
            if self.view_change.is_large:
                placement = self.localiser.from_keyframe(features, newest)
            placement = placement or self._track_motion(frame, features)
            if placement is None and self.integration.run_all():  # their landmarks may be what is missing
                self.motion.follow_map()
                placement = self._track_motion(frame, features)
            placement = placement or self.localiser.from_keyframe(features, newest)
        else:
            self.relocaliser.schedule.count_frame()
        placement = placement or self.relocaliser.by_place(features, without=newest)
        return self._count(frame, features, placement)

    def _place_wide(self, frame: Frame, raw: Features) -> tuple[Features, Features, Placement | None]:
        """Place a frame that the usual ways did not place by more features and over a wide baseline.

        Returns:
            Its features, raw and to go on with, and the placement; those given where it is still lost.
        """
        was_large = self.view_change.is_large
        wide = raw if was_large else self._wide_features(frame)
        self.integration.run_all()
        self.motion.follow_map()
        self.view_change.is_large = True
        found = self.relocaliser.by_recent(wide, is_lost=not self.motion.is_known)
        placement = self._count(frame, wide, found)
        if placement is None:
            self.view_change.is_large = was_large
            return raw, raw, None
        self.view_change.found_wide()
        return wide, wide, placement

    def _register(self, frame: Frame, features: Features) -> Placement | None:
        """Place a frame by registering its depth; the last and dearest way."""
        T_guess = self.motion.predict(frame.timestamp_s) if self.motion.is_known else None
        found = self.relocaliser.by_registration(frame, features, T_guess)
        return self._count(frame, features, found)

    def _count(self, frame: Frame, features: Features, placement: Placement | None) -> Placement | None:
        """Count what a found placement saw; None where there is none, or it is not earned."""
        if placement is None or not self._is_earned(frame, features, placement):
            return None
        self.placed_by[placement.placed_by] += 1
        self.map.count_views(placement.expected_ids, placement.found_ids)
        was_cut = placement.placed_by is PlacedBy.LAST_KEYFRAME and not self.view_change.is_large
        if was_cut or placement.placed_by is PlacedBy.PLACE:
            self.motion.forget()  # found by its view alone: the recording may have been cut
        return placement

    def _measure_step(self, placement: Placement) -> None:
        """Learn from a placed frame whether the camera takes large steps."""
        self.view_change.count_placed()
        if self.motion.is_known:
            self.view_change.measure(
                self.motion.T_camera_world, placement.T_camera_world, placement.landmark_ids
            )
        self.shutter.trusts_motion = not self.view_change.is_large

    def _is_earned(self, frame: Frame, features: Features, placement: Placement) -> bool:
        """Judge a pose; provisional ones before it that it contradicts are withdrawn."""
        T_guess = self.motion.predict(frame.timestamp_s) if self.motion.is_known else None
        judgement = self.check.judge(frame.timestamp_s, features, placement, T_guess)
        self.frames.withdraw(judgement.withdrawn_s)
        if judgement.why:
            log.debug("frame %d: pose is %s: %s", frame.index, judgement.verdict.value, judgement.why)
        return judgement.verdict is not Verdict.LOST

    def _track_motion(self, frame: Frame, features: Features) -> Placement | None:
        recent = self.map.resolve(self.motion.landmark_ids)
        T_guess = self.motion.predict(frame.timestamp_s)
        return self.localiser.track(features, T_guess, np.unique(recent[recent >= 0]))

    def _lose(self) -> None:
        """Forget the motion; where it led to last is tried again for some frames."""
        self.frames.withdraw(self.check.lose())
        if self.motion.is_known:
            self.relocaliser.schedule.start(self.motion.T_camera_world, self.motion.step)
        self.motion.forget()

    def _correct_by_pose(
        self, frame: Frame, raw: Features, features: Features, placement: Placement
    ) -> tuple[Features, Placement]:
        """Correct the rolling shutter by the velocity of this very frame, and place the frame by that.

        Where its landmarks contradict that velocity, the recording was cut and the camera did not move there.
        """
        corrected = self.shutter.correct_by_pose(raw, self.motion, frame.timestamp_s, placement)
        if corrected is None:
            return features, placement
        refined = self.localiser.reoptimise(corrected, placement)
        if refined.inliers >= _SAME_MOTION * placement.inliers:
            return corrected, refined
        self.motion.forget()
        return raw, self.localiser.reoptimise(raw, placement)

    def _place_in_grown_map(self, features: Features, placement: Placement) -> Placement:
        """Place a frame again, once the keyframe that waits longest has created its landmarks."""
        pose = AnchoredPose.of(placement.T_camera_world, self.map.keyframes[-1])
        self.integration.run_until_landmarks()
        self.motion.follow_map()
        carried = replace(
            placement,
            T_camera_world=orthonormalised(pose.T_camera_world),
            landmark_ids=self.map.resolve(placement.landmark_ids),
        )
        with self._watch.timed("tracking"):
            refined = self.localiser.refine_in_local_map(features, carried)
        if refined is None:
            return carried
        self.map.count_views(refined.expected_ids, refined.found_ids)
        return refined

    def _add_keyframe(self, frame: Frame, features: Features, measured: Placement) -> Placement:
        """Make a frame a keyframe; returns its placement in the map, which may have moved."""
        velocity = self.motion.velocity(frame.timestamp_s, measured.T_camera_world)
        self.motion.advance(frame.timestamp_s, measured.T_camera_world)
        keyframe = self.integration.add_keyframe(frame, features, measured, velocity)
        placement = Placement(keyframe.T_camera_world, keyframe.landmark_ids.copy())
        self.motion.anchor(placement, keyframe)
        return placement

    def _compact(self) -> None:
        """Let the map give away ids of landmarks that are gone, unless an adjustment remembers ids."""
        ids_now = None if self.integration.is_adjusting else self.map.compact()
        if ids_now is not None:
            self.frames.renumber(ids_now)
            self.motion.renumber(ids_now)
