# SPDX-License-Identifier: Apache-2.0
"""When a frame becomes a keyframe, and what happens then: at once, and when its depth is there.

A network takes several frames' time for one depth map. So the keyframe joins the map at
once with the points it already knows, its depth is predicted in a thread of its own, and
a fixed number of frames later, or earlier where tracking needs it, new points are born
and the window is adjusted. When that is depends on the frames alone and not on how fast
the network was, so the trajectory is the same on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import orthonormalised, rotation_angle_rad
from slamdepth.mapping.keyframe_store import KeyframeStore
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracker.adaptation import MapTeaching
from slamdepth.tracker.depth_thread import DepthThread
from slamdepth.tracker.frame_log import FrameLog
from slamdepth.tracker.local_mapper import LocalMapper
from slamdepth.tracker.localiser import Placement
from slamdepth.tracker.loop_closer import LoopCloser
from slamdepth.tracker.map_adjuster import MapAdjuster
from slamdepth.tracker.shutter import Shutter
from slamdepth.tracker.stopwatch import Stopwatch
from slamdepth.types import Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_START_KEYFRAMES = 8  # until so many, most points are known by a predicted depth only
_KNOWN_GROUND = 0.5  # of the points of a keyframe that three see, seen again
_RESCUE_STEP_M, _RESCUE_TURN_RAD = 0.1, 0.15  # between keyframes without features


@dataclass
class _Waiting:
    keyframe: MapKeyframe
    frames_left: int


@dataclass
class Moved:
    """How the map moved around a keyframe."""

    keyframe: MapKeyframe
    T_world_keyframe_before: Floats
    scale: float = 1.0

    def carry(self, T_camera_world: Floats) -> Floats:
        """A pose ``(4, 4)`` measured before, in the map as it is now."""
        T_camera_keyframe = T_camera_world @ self.T_world_keyframe_before
        T_camera_keyframe[:3, 3] *= self.scale
        # a keyframe's pose comes from a carried one: left alone, rounding would double with each
        return orthonormalised(T_camera_keyframe @ self.keyframe.T_camera_world)


class Keyframes:
    """Chooses keyframes and grows the map with them.

    Args:
        watch: measures the stages.
        teaching: told of every keyframe that has joined; None where the depth model learns nothing.

    Attributes:
        store: where their images lie.
    """

    def __init__(
        self,
        config: Config,
        landmarks: LandmarkMap,
        mapper: LocalMapper,
        adjuster: MapAdjuster,
        loops: LoopCloser,
        frames: FrameLog,
        depth: DepthThread,
        shutter: Shutter,
        watch: Stopwatch,
        teaching: MapTeaching | None = None,
    ) -> None:
        self._config = config
        self._map = landmarks
        self._mapper = mapper
        self._adjuster = adjuster
        self._loops = loops
        self._log = frames
        self._depth = depth
        self._shutter = shutter
        self._timed = watch.timed
        self.store = KeyframeStore(config.map.keyframe_memory_mib)
        self._reference: MapKeyframe | None = None  # an earlier keyframe that shows the same
        self._teaching = teaching
        self._reference_overlap = 0.0
        self._still = 0
        self._seen_share = 1.0  # of what the last keyframe knew, when its own points were born
        self._waiting: _Waiting | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether the last keyframe still waits for its depth."""
        return self._waiting is not None

    def wants(self, placement: Placement) -> bool:
        """The view has moved on when much of what the reference saw is seen no more.

        The reference is the last keyframe, or on known ground an earlier one that shows the same:
        going back and forth makes no new ones (after ORB-SLAM's reference keyframe).
        """
        reference = self._reference or self._map.keyframes[-1]
        seen = np.zeros(self._map.size + 1, dtype=bool)
        seen[placement.point_ids] = True
        seen[-1] = False
        self._still = still = int(np.count_nonzero(seen[reference.point_ids]))
        self._reference_overlap = max(self._reference_overlap or still / self._seen_share, still)
        tracking = self._config.tracking
        if placement.inliers < tracking.min_inliers:
            # rescued: worth a keyframe where there are features to go on with, or new surfaces
            many = len(placement.point_ids) >= tracking.keyframe_min_inliers
            return many or self._has_moved_on(placement, reference)
        if self._reference_overlap < tracking.min_inliers:
            return True  # the last keyframe saw too little to measure by
        starting = len(self._map.keyframes) < _START_KEYFRAMES
        enough = tracking.keyframe_overlap_start if starting else tracking.keyframe_overlap
        if still < enough * self._reference_overlap:
            return starting or not self._is_known_ground(placement)
        return placement.inliers < tracking.keyframe_min_inliers and still < 0.9 * self._reference_overlap

    def _is_known_ground(self, placement: Placement) -> bool:
        """Whether an earlier keyframe shows what the frame sees; the best such one is the reference then."""
        earlier = len(self._map.keyframes) - self._config.loops.min_gap
        if earlier <= 0 or placement.inliers < self._config.tracking.keyframe_min_inliers:
            return False
        shared = self._map.shared_points(placement.point_ids)[:earlier]
        best = self._map.keyframes[int(np.argmax(shared))]
        rows = best.point_ids[best.point_ids >= 0]
        known = int(np.count_nonzero(self._map.observations[rows] >= 3))
        if shared[best.id] < _KNOWN_GROUND * known:
            return False
        self._reference, self._reference_overlap = best, float(shared[best.id])
        return True

    def _has_moved_on(self, placement: Placement, reference: MapKeyframe) -> bool:
        D = placement.T_camera_world @ reference.T_world_camera
        turned = float(rotation_angle_rad(D[:3, :3]))
        return float(np.linalg.norm(D[:3, 3])) > _RESCUE_STEP_M or turned > _RESCUE_TURN_RAD

    def make(self, frame: Frame, features: Features, placement: Placement, velocity: Floats) -> MapKeyframe:
        """Put a frame into the map; its depth follows ``tracking.depth_delay`` frames later."""
        self._depth.ask(frame)
        with self._timed("mapping"):
            keyframe = self._mapper.insert(
                frame, features, placement.T_camera_world, placement.point_ids, velocity
            )
        self._reference = None
        self._reference_overlap, self._still, self._seen_share = 0.0, 0, 1.0
        # the first few are waited for: all that follows stands on the points born there
        at_once = self._depth.is_instant(frame) or len(self._map.keyframes) <= _START_KEYFRAMES
        delay = 0 if at_once else self._config.tracking.depth_delay
        self._waiting = _Waiting(keyframe, delay)
        return keyframe

    def _follow_motion(self, keyframe: MapKeyframe) -> None:
        """Use that the frames after the keyframe tell how it moved."""
        velocity = self._log.velocity_at(keyframe.id)
        if velocity is not None:
            keyframe.velocity = velocity
        if self._shutter.rolls:
            self._shutter.correct_keyframe(keyframe)

    @property
    def is_due(self) -> bool:
        """Whether the waiting keyframe's time has come."""
        return self._waiting is not None and self._waiting.frames_left <= 0

    def count_frame(self) -> None:
        """Tell that another frame has come."""
        if self._waiting is not None:
            self._waiting.frames_left -= 1

    def join(self) -> Moved | None:
        """Give the waiting keyframe its depth: points are born, searched for and adjusted.

        Returns:
            How the map moved around it; None where no keyframe waits.
        """
        if self._waiting is None:
            return None
        keyframe = self._waiting.keyframe
        self._waiting = None
        moved = Moved(keyframe, keyframe.T_world_camera)
        with self._timed("depth"):
            prediction = self._depth.take(keyframe.frame)
        with self._timed("mapping"):
            self._follow_motion(keyframe)
            self._mapper.give_birth(keyframe, prediction)
            self._mapper.search_neighbours(keyframe)
        with self._timed("bundle"):
            self._mapper.adjust_window(keyframe)
            if self._shutter.is_due(len(self._map.keyframes)) and self._adjuster.find_readout():
                self._shutter.correct_keyframes()
        with self._timed("loops"):
            self._loops.add(keyframe)
            correction = self._loops.close(keyframe)
        if correction is not None:
            self._log.rescale(correction.scales)
            moved.scale = float(correction.scales[keyframe.id])
            with self._timed("bundle"):
                self._mapper.search_neighbours(keyframe)
                self._mapper.adjust_window(keyframe)
        with self._timed("mapping"):
            self._mapper.cull(keyframe)
            self.store.tidy(self._map.keyframes)
        if self._teaching is not None:
            with self._timed("teaching"):
                self._teaching.keyframe_joined()
        if self._reference_overlap > 0:
            self._seen_share = max(self._still / self._reference_overlap, 0.1)
        self._reference, self._reference_overlap = None, 0.0
        return moved
