# SPDX-License-Identifier: Apache-2.0
"""When a frame becomes a keyframe."""

from __future__ import annotations

import numpy as np

from slamdepth.config import Config
from slamdepth.geometry import rotation_angle_rad
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.view_change import ViewChange

_START_KEYFRAMES = 8  # until then most landmarks are known by a predicted depth only
_SHOWN_BY_ONE = 0.5  # of an earlier keyframe's landmarks that three keyframes see, seen again
_SHOWN_BY_THREE = 0.7  # of the landmarks a frame sees, seen by three earlier keyframes
_WIDE_CHANGE = 0.05  # between keyframes of a camera that takes large steps
_REGISTERED_STEP_M, _REGISTERED_TURN_RAD = 0.1, 0.15  # between keyframes without features


class KeyframePolicy:
    """Says when the view has moved on from a reference keyframe.

    The reference is the last keyframe, or on known ground an earlier one that shows the same, so that
    going back and forth makes no new keyframes (after ORB-SLAM's reference keyframe).
    """

    def __init__(self, config: Config, map_: MapView, view_change: ViewChange) -> None:
        self._config = config
        self._map = map_
        self._view_change = view_change
        self._reference: MapKeyframe | None = None  # an earlier keyframe that shows the same
        self._overlap = 0.0  # most landmarks of the reference that a frame saw
        self._seen = 0  # those the last frame saw
        self._seen_share = 1.0  # of what the last keyframe saw, when landmarks were last created

    def wants(self, placement: Placement) -> bool:
        """Whether a frame should become a keyframe: it sees much less of the reference than others did."""
        reference = self._reference or self._map.keyframes[-1]
        is_seen = self._map.mask(placement.landmark_ids)
        self._seen = seen = int(np.count_nonzero(is_seen[reference.landmark_ids]))
        self._overlap = max(self._overlap or seen / self._seen_share, seen)
        tracking = self._config.tracking
        if placement.inliers < tracking.min_inliers:
            # registered: worth a keyframe where there are features to go on with, or new surfaces
            many = len(placement.landmark_ids) >= tracking.keyframe_min_inliers
            return many or self._has_moved_on(placement, reference)
        if self._view_change.is_large:
            # what the next frame will see of this one is not known: nothing is left out
            last = self._map.keyframes[-1].T_camera_world
            change = self._view_change.change(last, placement.T_camera_world, placement.landmark_ids)
            return change is not None and change > _WIDE_CHANGE
        if self._overlap < tracking.min_inliers:
            return True  # the last keyframe saw too little to measure by
        starting = len(self._map.keyframes) < _START_KEYFRAMES
        enough = tracking.keyframe_overlap_start if starting else tracking.keyframe_overlap
        if seen < enough * self._overlap:
            return starting or not self._is_known_ground(placement)
        is_weak = placement.inliers < tracking.keyframe_min_inliers or placement.is_loose
        return is_weak and seen < 0.9 * self._overlap

    def _is_known_ground(self, placement: Placement) -> bool:
        """Whether one earlier keyframe, or three together, show what the frame sees.

        The best of them becomes the reference. ORB-SLAM (Mur-Artal et al. 2015) removes such a redundant
        keyframe afterwards; this asks before one is made.
        """
        earlier = len(self._map.keyframes) - self._config.loops.min_gap
        if earlier <= 0 or placement.inliers < self._config.tracking.keyframe_min_inliers:
            return False
        ids = placement.found_ids
        shared = self._map.shared_landmarks(ids)[:earlier]
        best = self._map.keyframes[int(np.argmax(shared))]
        shown = best.landmark_ids[best.landmark_ids >= 0]
        known = int(np.count_nonzero(self._map.landmarks.observations[shown] >= 3))
        if shared[best.id] < _SHOWN_BY_ONE * known:
            by_three = int(np.count_nonzero(self._map.times_seen(ids, earlier) >= 3))
            if by_three < _SHOWN_BY_THREE * len(ids):
                return False
        self._reference, self._overlap = best, float(shared[best.id])
        return True

    def _has_moved_on(self, placement: Placement, reference: MapKeyframe) -> bool:
        D = placement.T_camera_world @ reference.T_world_camera
        turned = float(rotation_angle_rad(D[:3, :3]))
        return float(np.linalg.norm(D[:3, 3])) > _REGISTERED_STEP_M or turned > _REGISTERED_TURN_RAD

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {
            "reference": None if self._reference is None else self._reference.id,
            "overlap": self._overlap,
            "seen": self._seen,
            "seen_share": self._seen_share,
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        reference = state["reference"]
        self._reference = None if reference is None else self._map.keyframes[reference]
        self._overlap, self._seen, self._seen_share = state["overlap"], state["seen"], state["seen_share"]

    def keyframe_made(self) -> None:
        """Measure from the keyframe that was just made."""
        self._reference = None
        self._overlap, self._seen, self._seen_share = 0.0, 0, 1.0

    def landmarks_created(self) -> None:
        """Count again what the last keyframe sees, and remember how much of it was in view until now."""
        if self._overlap > 0:
            self._seen_share = max(self._seen / self._overlap, 0.1)
        self._reference, self._overlap = None, 0.0
