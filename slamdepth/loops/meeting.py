# SPDX-License-Identifier: Apache-2.0
"""Where two maps of one run show the same place, and the similarity between them that this gives.

After ORB-SLAM3 (Campos et al., "ORB-SLAM3: An Accurate Open-Source Library for Visual, Visual-Inertial and
Multi-Map SLAM", 2021, section VI): a place is recognised by several keyframes, not by one. Two maps that are
joined wrongly cannot be told apart again, so keyframes must agree on the whole similarity, scale included.
Where places look alike that is not enough: along one of two rows of equal desks all keyframes agree on the
other row. No odometry between the maps contradicts them, but there the maps look like themselves, too. So a
place counts only if it is unique: nothing else in either map looks like it by the same verification.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.backend.pose_graph import Edge
from slamdepth.geometry import Similarity, invert, rotation_angle_rad
from slamdepth.io.tree import Tree
from slamdepth.loops.look_alikes import FEWEST_DEPTHS, Place, View, depths_in_both, fits_elsewhere
from slamdepth.mapping.map_keyframe import AnchoredPose, MapKeyframe
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import Placement
from slamdepth.typing import Floats32, Ints

_CANDIDATES = 2
_MIN_SCORE_SHARE = 0.6  # of the similarity of two neighbours in time
_AGREEING = 3  # keyframes that must say the same
_REMEMBERED = 12  # keyframes a meeting is kept for
_MAX_TURN_RAD = 0.1
_MAX_SHIFT = 0.1  # of the distance of what the keyframe sees
_MAX_LOG_SCALE = 0.2  # between meetings; a network's scale differs by as much from image to image
_MAX_LOG_SCALE_MEASURED = 0.05  # of the similarity itself, where a sensor made both maps
_MAX_LOG_SCALE_PREDICTED = 1.1  # a network errs by a factor of three hardly ever


@dataclass(frozen=True)
class Meeting:
    """A keyframe that sees a place of another map.

    Attributes:
        keyframe: of the map that the camera is in.
        unit: of the keyframe at that time, see :class:`MapKeyframe`.
        pose: where it is in the other map, relative to the keyframe whose place it sees.
        landmark_ids: ``(N,)`` landmark of the other map that each feature sees, -1 for none.
        scale: metres of the other map that one of the keyframe's was at that time.
        distance_m: median distance of what was seen, in metres of the other map at that time.
    """

    keyframe: MapKeyframe
    unit: float
    pose: AnchoredPose
    landmark_ids: Ints
    scale: float
    distance_m: float

    def state(self) -> Tree:
        """The meeting as plain values, for a checkpoint."""
        return {
            "keyframe": self.keyframe.id,
            "unit": self.unit,
            "pose": self.pose.state(),
            "landmark_ids": self.landmark_ids,
            "scale": self.scale,
            "distance_m": self.distance_m,
        }

    @staticmethod
    def restored(state: Tree, home: MapView, other: MapView) -> Meeting:
        """What :meth:`state` gave, of a keyframe of ``home``."""
        return Meeting(
            home.keyframes[state["keyframe"]],
            state["unit"],
            AnchoredPose.restored(state["pose"], other.keyframes),
            np.array(state["landmark_ids"]),
            state["scale"],
            state["distance_m"],
        )

    @property
    def inliers(self) -> int:
        """Number of landmarks of the other map that agree."""
        return int(np.count_nonzero(self.landmark_ids >= 0))

    @property
    def _growth(self) -> float:
        """What a metre of the other map was multiplied by since."""
        return self.pose.keyframe.unit / self.pose.unit

    @property
    def similarity(self) -> Similarity:
        """From the keyframe's map to the other one, as both are now."""
        scale = self.scale * self._growth * self.unit / self.keyframe.unit
        T_other_camera = invert(self.pose.T_camera_world)
        return Similarity.of_camera(T_other_camera, self.keyframe.T_world_camera, scale)

    def edge(self, sigmas: tuple[float, float, float]) -> Edge:
        """The meeting as a loop, once the maps are one."""
        i, j = self.pose.keyframe, self.keyframe
        T_i_j = i.T_camera_world @ invert(self.pose.T_camera_world)
        return Edge(i.id, j.id, T_i_j, self.similarity.scale, sigmas, is_loop=True)

    def agrees(self, other: Meeting) -> bool:
        """Whether another meeting says the same of this keyframe's pose and of the scale."""
        mine, said = self.similarity, other.similarity
        D = self.pose.T_camera_world @ said.camera(self.keyframe.T_world_camera)
        return (
            float(rotation_angle_rad(D[:3, :3])) < _MAX_TURN_RAD
            and float(np.linalg.norm(D[:3, 3])) < _MAX_SHIFT * self.distance_m * self._growth
            and abs(np.log(mine.scale / said.scale)) < _MAX_LOG_SCALE
        )


def find_meeting(keyframe: MapKeyframe, home: Place, other: Place, min_inliers: int) -> Meeting | None:
    """Look for a keyframe in another map.

    Args:
        keyframe: of ``home``, not its first one.
        min_inliers: landmarks that must agree.
    """
    words = home.places.vector(keyframe.id)
    least = _MIN_SCORE_SHARE * home.places.score(keyframe.id, keyframe.id - 1)
    for candidate, score in other.places.query_vector(words, top_k=_CANDIDATES):
        if score < least:
            return None
        placement = other.place_view(keyframe.features, candidate)
        if placement is None or placement.inliers < min_inliers:
            continue
        meeting = _meeting(keyframe, home.map, other.map, candidate, placement)
        if meeting is not None and _is_unique(meeting, home, other, words, min_inliers):
            return meeting
    return None


def _is_unique(meeting: Meeting, home: Place, other: Place, words: Floats32, min_inliers: int) -> bool:
    """Whether the keyframe looks like one place of either map only, and so does the one it is placed by."""
    keyframe, candidate = meeting.keyframe, meeting.pose.keyframe
    there_m, here_m = meeting.distance_m, meeting.distance_m / meeting.scale
    views = (
        (View(keyframe.features, words, meeting.pose.T_camera_world), other, there_m),
        (View.of(candidate, other.places.vector(candidate.id)), other, there_m),
        (View.of(keyframe, words), home, here_m),
    )
    return not any(fits_elsewhere(*view, min_inliers) for view in views)


def _meeting(
    keyframe: MapKeyframe, home: MapView, there: MapView, candidate: int, placement: Placement
) -> Meeting | None:
    """The meeting with its scale; None where too little tells the scale, or no such scale can be."""
    at = np.flatnonzero((placement.landmark_ids >= 0) & (keyframe.landmark_ids >= 0))
    z_there, z_home = depths_in_both(
        (there, placement.T_camera_world, placement.landmark_ids[at]),
        (home, keyframe.T_camera_world, keyframe.landmark_ids[at]),
    )
    if len(z_there) < FEWEST_DEPTHS:
        return None
    log_scale = float(np.median(np.log(z_there / z_home)))
    is_measured = there.is_measured and home.is_measured
    if abs(log_scale) > (_MAX_LOG_SCALE_MEASURED if is_measured else _MAX_LOG_SCALE_PREDICTED):
        return None
    scale = 1.0 if is_measured else float(np.exp(log_scale))
    pose = AnchoredPose.of(placement.T_camera_world, there.keyframes[candidate])
    distance_m = float(np.median(z_there))
    return Meeting(keyframe, keyframe.unit, pose, placement.landmark_ids, scale, distance_m)


class Meetings:
    """What the latest keyframes of the map in use have seen of one other map."""

    def __init__(self) -> None:
        self._found: list[Meeting] = []

    def state(self) -> list[Tree]:
        """All that are remembered, for a checkpoint."""
        return [meeting.state() for meeting in self._found]

    def restore(self, states: list[Tree], home: MapView, other: MapView) -> None:
        """Remember what :meth:`state` gave."""
        self._found = [Meeting.restored(state, home, other) for state in states]

    def add(self, meeting: Meeting) -> list[Meeting]:
        """Remember a meeting.

        Returns:
            Those that agree with it, itself last; empty as long as they are too few.
        """
        newest = meeting.keyframe.id
        self._found = [m for m in self._found if m.keyframe.id > newest - _REMEMBERED]
        agreeing = [m for m in self._found if m.agrees(meeting) and meeting.agrees(m)]
        self._found.append(meeting)
        return [*agreeing, meeting] if len(agreeing) + 1 >= _AGREEING else []
