# SPDX-License-Identifier: Apache-2.0
"""Place a frame by matching its features with the local map; nothing here changes the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.pose import (
    PoseEstimate,
    corner_deviation_px,
    pose_from_scratch,
    refine_pose,
)
from slamdepth.frontend.ray_pose import RaySighting, pose_with_depths
from slamdepth.frontend.ray_start import pose_from_rays
from slamdepth.frontend.wide_pose import directional_pose, pose_from_reference
from slamdepth.geometry import CHI2_2DOF_99
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.landmark_search import SearchWindow, Visible, match_landmarks, visible_landmarks
from slamdepth.tracking.view_change import ViewChange
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_FEWEST_SURE = 40
_LEAST_SURE_SHARE = 0.07
POSE_PX, FARTHEST_PX = 4.0, 30.0
"""What a pose errs by at most where the local map is searched, and how far any search there goes."""


class Localiser:
    """Places frames in a map.

    Args:
        levels: of the extractor whose features it is given; None takes ORB's.

    Attributes:
        levels: of the features.
        view_change: whether the camera takes large steps, which decides how poses are estimated.
    """

    def __init__(
        self, camera: Camera, config: Config, map_: MapView, levels: ScaleLevels | None = None
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = map_
        self.levels = levels or ScaleLevels(config.features.scale_factor, config.features.levels)
        self.view_change = ViewChange(map_)

    def expected(self, T_camera_world: Floats, ids: Ints) -> Visible:
        """Which of the landmarks ``ids (N,)`` a camera at ``T_camera_world (4, 4)`` should see, and where."""
        return visible_landmarks(self._camera, self.levels, self._map.landmarks, T_camera_world, ids)

    def search(
        self,
        visible: Visible,
        features: Features,
        radius_px: float,
        max_px: float,
        *,
        is_strict: bool = False,
        ratio: float = 0.85,
        sigmas: float = 3.0,
    ) -> tuple[Ints, Ints, Ints]:
        """Match expected landmarks to features; the search area follows each landmark's uncertainty.

        Args:
            radius_px: error of the pose alone, in pixels of the finest level.
            max_px: no search goes farther.
            is_strict: ask for nearer descriptors, where a wrong match would stay in the map.
            ratio: best over second best descriptor distance, at most (Lowe 2004).
            sigmas: deviations of a landmark's own position to search.

        Returns:
            ``(landmark ids, feature indices, descriptor distances)``, one to one.
        """
        metric = features.metric
        return match_landmarks(
            visible,
            self._map.landmarks,
            features,
            self.levels,
            SearchWindow(radius_px, max_px, sigmas),
            max_distance=metric.strict_distance if is_strict else metric.max_distance,
            ratio=ratio,
        )

    def track(self, features: Features, T_guess: Floats, recent_ids: Ints) -> Placement | None:
        """Place a frame near a guess.

        Args:
            T_guess: ``(4, 4)`` camera from world, by the motion model.
            recent_ids: landmarks that the last frame saw, each once.

        Returns:
            None where too few landmarks agree.
        """
        start = self._near(features, T_guess, recent_ids)
        return None if start is None else self.refine_in_local_map(features, start)

    def _near(self, features: Features, T_guess: Floats, ids: Ints) -> Placement | None:
        visible = self.expected(T_guess, ids)
        need = self._config.tracking.min_inliers
        for radius in (12.0, 30.0, 70.0):
            found, at, _ = self.search(visible, features, radius, max(40.0, 1.5 * radius))
            if len(found) < need:
                continue
            placement = self._solve(features, T_guess, found, at, rounds=2)
            if placement.inliers >= max(need, 0.4 * len(found)):
                return placement
        return None

    def refine_in_local_map(
        self, features: Features, start: Placement, *, is_lost: bool = False
    ) -> Placement | None:
        """Search the whole neighbourhood of a first placement and place the frame by all of it.

        Args:
            is_lost: no motion leads there. In a wrong place few landmarks agree, and few of those in view.

        Returns:
            With :attr:`Placement.expected_ids`; None where too few landmarks agree.
        """
        ids = self.local_ids(start.landmark_ids)
        visible = self.expected(start.T_camera_world, ids)
        found, at, _ = self.search(visible, features, POSE_PX, FARTHEST_PX)
        if len(found) < self._config.tracking.min_inliers:
            return None
        placement = self._solve(features, start.T_camera_world, found, at, is_judged=True)
        if placement.inliers < self._config.tracking.min_inliers:
            return None
        share = placement.inliers / len(visible.ids)
        if is_lost and placement.inliers < _FEWEST_SURE and share < _LEAST_SURE_SHARE:
            return None
        return replace(placement, expected_ids=visible.ids)

    def reoptimise(self, features: Features, placement: Placement) -> Placement:
        """Optimise a pose over the landmarks it agreed with, after the pixels were corrected."""
        at = np.flatnonzero(placement.landmark_ids >= 0)
        if len(at) < self._config.tracking.min_inliers:
            return placement
        ids = placement.landmark_ids[at]
        refined = self._solve(features, placement.T_camera_world, ids, at, rounds=2, is_judged=True)
        if refined.inliers < self._config.tracking.min_inliers:
            return placement
        return replace(refined, placed_by=placement.placed_by)

    def attach(self, features: Features, T_camera_world: Floats, ids: Ints) -> Placement:
        """Which of the landmarks ``ids`` a frame of known pose ``(4, 4)`` sees; the pose is not changed."""
        visible = self.expected(T_camera_world, ids)
        found, at, _ = self.search(visible, features, 6.0, 30.0)
        landmark_ids = np.full(len(features), -1, dtype=np.int64)
        landmark_ids[at] = found
        return Placement(T_camera_world, landmark_ids)

    def local_ids(self, landmark_ids: Ints) -> Ints:
        """Landmarks of the keyframes that see most of ``landmark_ids``, -1 for none."""
        seeds = landmark_ids[landmark_ids >= 0]
        return self._map.seen_from(self._map.covisible(seeds, self._config.tracking.local_keyframes))

    def _solve(
        self,
        features: Features,
        T_start: Floats,
        ids: Ints,
        at: Ints,
        rounds: int = 4,
        *,
        is_judged: bool = False,
    ) -> Placement:
        estimate: PoseEstimate
        if self.view_change.doubts_depth:
            estimate = pose_with_depths(
                self._camera, T_start, self._sighting(features, ids, at), rounds=rounds
            )
        elif self.view_change.is_large:
            estimate, _ = directional_pose(self._camera, T_start, self._sighting(features, ids, at))
        else:
            estimate = refine_pose(
                self._camera,
                T_start,
                self._map.landmarks.position_w[ids],
                self._covariance_w(ids),
                features.px[at],
                features.sigma_px[at],
                rounds=rounds,
            )
        landmark_ids = np.full(len(features), -1, dtype=np.int64)
        landmark_ids[at[estimate.inliers]] = ids[estimate.inliers]
        placement = Placement(estimate.T_camera_world, landmark_ids)
        return replace(placement, is_loose=self._is_loose(placement, estimate)) if is_judged else placement

    def _covariance_w(self, ids: Ints) -> Floats:
        """Covariance ``(N, 3, 3)`` of landmarks by which a pose may weigh them, m^2.

        Landmarks that only one keyframe sees share the error of its pose and of its predicted depth, where a
        tilted wall passes for a turned camera. Hundreds of them are no hundred measurements. So they count
        for less, as predicted depths do in bundle adjustment.
        """
        landmarks = self._map.landmarks
        covariance = landmarks.covariance_w[ids]
        if self._map.is_measured:
            return covariance
        covariance[landmarks.observations[ids] < 2] *= self._config.bundle.prior_inflation**2
        return covariance

    def _is_loose(self, placement: Placement, estimate: PoseEstimate) -> bool:
        found_w = self._map.landmarks.position_w[placement.found_ids]
        errs_px = corner_deviation_px(self._camera, placement.T_camera_world, found_w, estimate.information)
        return bool(errs_px * np.sqrt(CHI2_2DOF_99) > POSE_PX)

    def _sighting(self, features: Features, ids: Ints, at: Ints) -> RaySighting:
        landmarks = self._map.landmarks
        points_w = landmarks.position_w[ids]
        is_predicted = landmarks.observations[ids] < 2
        return RaySighting(
            points_w=points_w,
            covariance_w=landmarks.covariance_w[ids],
            px=features.px[at],
            sigma_px=features.sigma_px[at],
            origin_w=points_w - landmarks.distance_m[ids, None] * landmarks.direction_w[ids],
            inflation=np.where(is_predicted, self._config.bundle.prior_inflation, 1.0),
        )

    def from_keyframe(
        self, features: Features, keyframe_id: int, *, minimum: int | None = None, is_lost: bool = False
    ) -> Placement | None:
        """Place a frame by matching it with one keyframe, without a guess of where it is.

        Args:
            minimum: matches that are needed; default: what tracking needs.
            is_lost: no motion leads there, see :meth:`refine_in_local_map`.
        """
        need = self._config.tracking.min_inliers if minimum is None else minimum
        keyframe = self._map.keyframes[keyframe_id]
        has = np.flatnonzero(keyframe.landmark_ids >= 0)
        if len(has) < need:
            return None
        a, b = keyframe.features.match(features, has, ratio=0.85)
        ids = keyframe.landmark_ids[has[a]]
        if self.view_change.is_large:
            pose_from = pose_from_rays if self.view_change.doubts_depth else pose_from_reference
            solution = pose_from(
                self._camera,
                keyframe.T_camera_world,
                keyframe.features.px[has[a]],
                self._sighting(features, ids, b),
                seed=self._config.seed,
                minimum=max(8, need // 2),
            )
        else:
            solution = pose_from_scratch(
                self._camera,
                self._map.landmarks.position_w[ids],
                features.px[b],
                seed=self._config.seed,
                minimum=max(8, need // 2),
            )
        if solution is None:
            return None
        T, inliers = solution
        start = self._solve(features, T, ids[inliers], b[inliers])
        if start.inliers < max(8, need // 2):
            return None
        placement = self.refine_in_local_map(features, start, is_lost=is_lost)
        if placement is None:
            return None
        if self.view_change.is_large:  # directions are not where the map has them: the search missed them
            placement = replace(placement, landmark_ids=_united(placement.landmark_ids, start.landmark_ids))
        return replace(placement, placed_by=PlacedBy.LAST_KEYFRAME)


def _united(first: Ints, second: Ints) -> Ints:
    """Landmarks ``(N,)`` of ``first``, and those of ``second`` where it has none and that it has nowhere."""
    both: Ints = np.array(first)
    more = (first < 0) & (second >= 0) & ~np.isin(second, first[first >= 0])
    both[more] = second[more]
    return both
