# SPDX-License-Identifier: Apache-2.0
"""One map that grows, and goes on in the place of another."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.geometry import Similarity
from slamdepth.loops.meeting import Meeting
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.frame_placer import Found, FramePlacer
from slamdepth.tracking.map_parts import MapParts, RunParts
from slamdepth.types import Frame
from slamdepth.typing import Floats

log = logging.getLogger(__name__)

FEWEST_FRAMES = 10
"""A smaller map is not kept: nothing has confirmed its poses."""


@dataclass(frozen=True)
class Placed:
    """A frame that was placed.

    Attributes:
        placement: its pose in the map as it is now.
        placed_by: how it was found.
        is_keyframe: True where it became a keyframe.
        covariance, quality, moving_share: see :class:`StepResult`.
    """

    placement: Placement
    placed_by: PlacedBy
    is_keyframe: bool
    covariance: Floats | None
    quality: float
    moving_share: float | None


class MapTracker(MapParts):
    """Tracks the camera in one map, and grows the map.

    Args:
        id_: number of the map in its run.
        run: what it shares with other maps.
    """

    def __init__(self, id_: int, run: RunParts) -> None:
        super().__init__(id_, run)
        self._placer = FramePlacer(self, run)

    def start(self, frame: Frame, features: Features) -> Placed | None:
        """Start the map with a frame; None where its depth does not create enough landmarks."""
        if self.view_change.is_large:
            features = self._run.wide_features(frame)
        need = self._run.config.tracking.min_inliers
        depth = self._run.workers.depth
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
        if self._run.grows_maps:
            self._compact()
        found = self._placer.place(frame, raw)
        return None if found is None else self._add(frame, found)

    def find(self, frame: Frame, raw: Features) -> Placed | None:
        """Place a frame by what it looks like, in a map that the camera was not in."""
        found = self._placer.find(frame, raw)
        return None if found is None else self._add(frame, found)

    @property
    def is_worth_keeping(self) -> bool:
        """Whether enough frames confirm the map, or an earlier recording made it."""
        return self.is_loaded or len(self.frames) >= FEWEST_FRAMES

    def place_alone(self, frame: Frame, raw: Features) -> Placed | None:
        """Place an image by itself: no motion leads to it, and none from it.

        Returns:
            None also where other images would have to confirm its pose.
        """
        self.forget_motion()
        found = self._placer.find(frame, raw)
        is_sure = not self.check.is_provisional
        placed = None
        if found is not None and is_sure:
            placed = self._placed(frame, found.features, found.placement, found.placed_by, is_keyframe=False)
        self.forget_motion()
        return placed

    def forget_motion(self) -> None:
        """The next image may have been taken anywhere."""
        self.motion.forget()
        self.check.lose()
        self.check.forget_motion()

    def leave(self) -> None:
        """The camera is in another map from now on."""
        self.integration.run_all()
        self.motion.forget()
        self.map.spill_all_images()

    @property
    def places(self) -> PlaceRecogniser:
        """Index of the map's keyframes by what they look like."""
        return self.integration.loops.places

    def place_view(self, features: Features, candidate: int) -> Placement | None:
        """Place an image by matching its features with the keyframe ``candidate``."""
        return self.localiser.from_keyframe(features, candidate, is_lost=True)

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
        self.past.absorb(other.past)
        self.is_loaded |= other.is_loaded
        self.shutter.adopt(other.shutter)
        self.integration.join(other.integration, first_keyframe, meetings)
        self.motion.follow_map()

    def _add(self, frame: Frame, found: Found) -> Placed:
        """Add a placed frame to the log, and to the map where the view has moved on."""
        features, placement = found.features, found.placement
        follows_motion = self.motion.is_known
        if placement.is_loose and self.integration.awaits_adjustment:
            placement = self._placer.place_in_adjusted_map(features, placement)
        if placement.is_loose and self.integration.awaits_landmarks:
            placement = self._placer.place_in_grown_map(features, placement)
        is_keyframe = self._run.grows_maps and self.integration.wants(placement)
        is_keyframe = is_keyframe and self._run.workers.depth.has_depth(frame)
        is_keyframe &= not self.check.is_provisional
        if is_keyframe and self.integration.is_full:
            placement = self._placer.place_in_grown_map(features, placement)
            is_keyframe = self.integration.wants(placement)
        if is_keyframe:
            placement = self._add_keyframe(frame, features, placement)
        else:
            self.motion.advance(frame.timestamp_s, placement.T_camera_world)
            self.motion.anchor(placement, self.map.keyframes[-1])
        placed = self._placed(frame, features, placement, found.placed_by, is_keyframe=is_keyframe)
        self.frames.add(
            frame.timestamp_s,
            found.raw,
            placement,
            is_keyframe,
            follows_motion=follows_motion,
            quality=placed.quality,
        )
        self.frames.settle(self.shutter.readout_s)
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
        with self._run.watch.timed("uncertainty"):
            covariance, quality = self.check.uncertainty(frame.timestamp_s, features, placement)
        with self._run.watch.timed("moving"):
            is_near = not self.view_change.is_large
            moving = self.check.moving(frame.timestamp_s, features, placement, is_judged=is_near)
        return Placed(placement, placed_by, is_keyframe, covariance, quality, moving)

    def run_stage(self) -> None:
        """Go on with the integration of keyframes before the next frame."""
        self.integration.run_stage()
        self.motion.follow_map()

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
            self.check.moving.renumber(ids_now)
