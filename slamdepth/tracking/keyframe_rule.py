# SPDX-License-Identifier: Apache-2.0
"""When a frame becomes a keyframe."""

from __future__ import annotations

import numpy as np

from slamdepth.config import Config
from slamdepth.geometry import rotation_angle_rad
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.localiser import Placement

_START_KEYFRAMES = 8  # until so many, most points are known by a predicted depth only
_SHOWN_BY_ONE = 0.5  # of the points of an earlier keyframe that three see, seen again
_SHOWN_BY_THREE = 0.7  # of the points a frame sees, seen by three earlier keyframes
_RESCUE_STEP_M, _RESCUE_TURN_RAD = 0.1, 0.15  # between keyframes without features


class KeyframeRule:
    """Says when the view has moved on from the reference: the last keyframe, or on known ground an
    earlier one that shows the same."""

    def __init__(self, config: Config, landmarks: LandmarkMap) -> None:
        self._config = config
        self._map = landmarks
        self._reference: MapKeyframe | None = None  # an earlier keyframe that shows the same
        self._overlap = 0.0  # most points of the reference that a frame saw
        self._still = 0  # those the last frame saw
        self._seen_share = 1.0  # of what the last keyframe knew, when points were last born

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
        self._overlap = max(self._overlap or still / self._seen_share, still)
        tracking = self._config.tracking
        if placement.inliers < tracking.min_inliers:
            # rescued: worth a keyframe where there are features to go on with, or new surfaces
            many = len(placement.point_ids) >= tracking.keyframe_min_inliers
            return many or self._has_moved_on(placement, reference)
        if self._overlap < tracking.min_inliers:
            return True  # the last keyframe saw too little to measure by
        starting = len(self._map.keyframes) < _START_KEYFRAMES
        enough = tracking.keyframe_overlap_start if starting else tracking.keyframe_overlap
        if still < enough * self._overlap:
            return starting or not self._is_known_ground(placement)
        return placement.inliers < tracking.keyframe_min_inliers and still < 0.9 * self._overlap

    def _is_known_ground(self, placement: Placement) -> bool:
        """Whether one earlier keyframe, or three together, show what the frame sees; the best of them is the
        reference then.

        ORB-SLAM (Mur-Artal et al. 2015) calls such a keyframe redundant and removes it; this asks before.
        """
        earlier = len(self._map.keyframes) - self._config.loops.min_gap
        if earlier <= 0 or placement.inliers < self._config.tracking.keyframe_min_inliers:
            return False
        rows = placement.point_ids[placement.point_ids >= 0]
        shared = self._map.shared_points(rows)[:earlier]
        best = self._map.keyframes[int(np.argmax(shared))]
        shown = best.point_ids[best.point_ids >= 0]
        known = int(np.count_nonzero(self._map.observations[shown] >= 3))
        if shared[best.id] < _SHOWN_BY_ONE * known:
            by_three = int(np.count_nonzero(self._map.times_seen(rows, earlier) >= 3))
            if by_three < _SHOWN_BY_THREE * len(rows):
                return False
        self._reference, self._overlap = best, float(shared[best.id])
        return True

    def _has_moved_on(self, placement: Placement, reference: MapKeyframe) -> bool:
        D = placement.T_camera_world @ reference.T_world_camera
        turned = float(rotation_angle_rad(D[:3, :3]))
        return float(np.linalg.norm(D[:3, 3])) > _RESCUE_STEP_M or turned > _RESCUE_TURN_RAD

    def keyframe_made(self) -> None:
        """Measure from the keyframe that was just made."""
        self._reference = None
        self._overlap, self._still, self._seen_share = 0.0, 0, 1.0

    def points_born(self) -> None:
        """Count anew what the last keyframe sees, and remember how much of it was in view until now."""
        if self._overlap > 0:
            self._seen_share = max(self._still / self._overlap, 0.1)
        self._reference, self._overlap = None, 0.0
