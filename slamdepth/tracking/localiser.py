# SPDX-License-Identifier: Apache-2.0
"""Where is this frame? Matching a frame's features into the local map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.matching import best_matches
from slamdepth.frontend.pose import pixel_covariance, pose_from_scratch, refine_pose
from slamdepth.geometry import project, transform
from slamdepth.mapping.landmarks import NEAREST_M, LandmarkMap
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

MAHALANOBIS_GATE = 9.21  # chi-square, 2 degrees of freedom, 99 %
_FEWEST_SURE = 40
_LEAST_SURE_SHARE = 0.07


@dataclass(frozen=True)
class Placement:
    """A frame placed in the map.

    Attributes:
        T_camera_world: ``(4, 4)``.
        point_ids: ``(N,)`` map point each feature agrees with, -1 for none.
    """

    T_camera_world: Floats
    point_ids: Ints

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.point_ids >= 0))


@dataclass(frozen=True)
class Visible:
    """Map points expected in an image: rows, pixels ``(N, 2)``, pixel covariances, octaves."""

    rows: Ints
    px: Floats
    covariance_px: Floats
    octave: Ints


class Localiser:
    """Places frames in a :class:`LandmarkMap`.

    Args:
        levels: of the extractor whose features it is given; None takes ORB's.
    """

    def __init__(
        self, camera: Camera, config: Config, landmarks: LandmarkMap, levels: ScaleLevels | None = None
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = landmarks
        self._levels = levels or ScaleLevels(config.features.scale_factor, config.features.levels)

    def expected(self, T_camera_world: Floats, rows: Ints) -> Visible:
        """Which of the points ``rows`` a camera at ``T_camera_world`` should see, and where."""
        camera, landmarks = self._camera, self._map
        points_w = landmarks.position_w[rows]
        points_c = transform(T_camera_world, points_w)
        px, z = project(camera, points_c)
        margin = 8.0
        ok = (
            (z > NEAREST_M)
            & (px[:, 0] > -margin)
            & (px[:, 0] < camera.width + margin)
            & (px[:, 1] > -margin)
            & (px[:, 1] < camera.height + margin)
        )
        center_w = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
        offset = points_w - center_w
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        ok &= np.einsum("ni,ni->n", offset, landmarks.direction_w[rows]) > 0.5 * distance
        step = np.log(landmarks.distance_m[rows] / distance) / np.log(self._levels.factor)
        octave = np.rint(landmarks.octave[rows] + step).astype(np.int64)
        ok &= (octave >= -1) & (octave <= self._levels.count)
        at = np.flatnonzero(ok)
        covariance = pixel_covariance(
            camera, T_camera_world, points_c[at], landmarks.covariance_w[rows[at]], np.zeros(len(at))
        )
        octave = np.clip(octave[at], 0, self._levels.count - 1)
        return Visible(rows[at], px[at], covariance, octave)

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
        """Match expected points to features; the search area follows each point's uncertainty.

        Args:
            radius_px: error of the pose alone, in pixels of the finest level.
            max_px: no search goes farther.
            is_strict: ask for nearer descriptors, where a wrong match would stay in the map.

        Returns:
            ``(map rows, feature indices, descriptor distances)``, one to one.
        """
        pose_px = radius_px * self._levels.sigma_px(visible.octave)
        S00, S01, S11 = (visible.covariance_px[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        half_trace = 0.5 * (S00 + S11)
        largest = half_trace + np.sqrt(np.maximum(half_trace**2 - (S00 * S11 - S01**2), 0.0))
        reach = np.minimum(pose_px + sigmas * np.sqrt(largest), max_px)
        # the ellipse of the pose's error plus the point's own, a du^2 + b du dv + c dv^2 < 1
        along_u, along_v = S00 + pose_px**2 / MAHALANOBIS_GATE, S11 + pose_px**2 / MAHALANOBIS_GATE
        a, b, c = np.stack([along_v, -2.0 * S01, along_u]) / (
            MAHALANOBIS_GATE * (along_u * along_v - S01 * S01)
        )
        box = np.sqrt(MAHALANOBIS_GATE * np.column_stack([along_u, along_v]))
        q, t = features.grid.pairs_within(visible.px, reach, box)
        step = features.octave[t] - visible.octave[q]
        ok = (step >= -1) & (step <= 1)
        q, t = q[ok], t[ok]
        du = features.px[:, 0][t] - visible.px[:, 0][q]
        dv = features.px[:, 1][t] - visible.px[:, 1][q]
        ok = (a[q] * du + b[q] * dv) * du + c[q] * dv * dv < 1.0
        q, t = q[ok], t[ok]
        metric = features.metric
        distance = metric.between(self._map.descriptor[visible.rows[q]], features.descriptors[t])
        limit = metric.strict_distance if is_strict else metric.max_distance
        q, t, distance = best_matches(q, t, distance, max_distance=limit, ratio=ratio)
        return visible.rows[q], t, distance

    def track(
        self,
        features: Features,
        T_guess: Floats,
        recent_rows: Ints,
    ) -> Placement | None:
        """Place a frame near ``T_guess`` (camera from world); None where it does not hold."""
        start = self._near(features, T_guess, recent_rows)
        if start is None:
            return None
        return self.refine_in_local_map(features, start)

    def _near(
        self,
        features: Features,
        T_guess: Floats,
        rows: Ints,
    ) -> Placement | None:
        visible = self.expected(T_guess, rows)
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
        self,
        features: Features,
        start: Placement,
        *,
        is_lost: bool = False,
    ) -> Placement | None:
        """Search the whole neighbourhood of a first placement and place the frame by all of it.

        Args:
            is_lost: nothing else says that the camera is there. In a wrong place few points agree, and few of
                those that lie in the view.
        """
        rows = self.local_rows(start.point_ids)
        visible = self.expected(start.T_camera_world, rows)
        found, at, _ = self.search(visible, features, 4.0, 30.0)
        if len(found) < self._config.tracking.min_inliers:
            return None
        placement = self._solve(features, start.T_camera_world, found, at)
        if placement.inliers < self._config.tracking.min_inliers:
            return None
        share = placement.inliers / len(visible.rows)
        if is_lost and placement.inliers < _FEWEST_SURE and share < _LEAST_SURE_SHARE:
            return None
        self._map.visible[visible.rows] += 1
        self._map.found[placement.point_ids[placement.point_ids >= 0]] += 1
        return placement

    def settle(self, features: Features, placement: Placement) -> Placement:
        """Place a frame anew by the points it agreed with, after its pixels were corrected."""
        at = np.flatnonzero(placement.point_ids >= 0)
        if len(at) < self._config.tracking.min_inliers:
            return placement
        rows = placement.point_ids[at]
        settled = self._solve(features, placement.T_camera_world, rows, at, rounds=2)
        return settled if settled.inliers >= self._config.tracking.min_inliers else placement

    def attach(self, features: Features, placement: Placement, rows: Ints) -> Placement:
        """Find what a frame whose pose is known otherwise sees of the points ``rows``; the pose stays."""
        visible = self.expected(placement.T_camera_world, rows)
        found, at, _ = self.search(visible, features, 6.0, 30.0)
        point_ids = np.full(len(features), -1, dtype=np.int64)
        point_ids[at] = found
        return Placement(placement.T_camera_world, point_ids)

    def local_rows(self, point_ids: Ints) -> Ints:
        """Points of the keyframes that see what the frame sees."""
        seeds = point_ids[point_ids >= 0]
        return self._map.points_of(self._map.covisible(seeds, self._config.tracking.local_keyframes))

    def _solve(
        self,
        features: Features,
        T_start: Floats,
        rows: Ints,
        at: Ints,
        rounds: int = 4,
    ) -> Placement:
        estimate = refine_pose(
            self._camera,
            T_start,
            self._map.position_w[rows],
            self._map.covariance_w[rows],
            features.px[at],
            features.sigma_px[at],
            rounds=rounds,
        )
        point_ids = np.full(len(features), -1, dtype=np.int64)
        point_ids[at[estimate.inliers]] = rows[estimate.inliers]
        return Placement(estimate.T_camera_world, point_ids)

    def from_keyframe(
        self, features: Features, keyframe_id: int, *, minimum: int | None = None, is_lost: bool = False
    ) -> Placement | None:
        """Place a frame by matching it with one keyframe, without knowing where it is.

        Args:
            minimum: matches that are asked for; default: what tracking needs.
            is_lost: see :meth:`refine_in_local_map`.
        """
        need = self._config.tracking.min_inliers if minimum is None else minimum
        keyframe = self._map.keyframes[keyframe_id]
        has = np.flatnonzero(keyframe.point_ids >= 0)
        if len(has) < need:
            return None
        a, b = keyframe.features.match(features, has, ratio=0.85)
        rows = keyframe.point_ids[has[a]]
        solution = pose_from_scratch(
            self._camera,
            self._map.position_w[rows],
            features.px[b],
            seed=self._config.seed,
            minimum=max(8, need // 2),
        )
        if solution is None:
            return None
        T, inliers = solution
        start = self._solve(features, T, rows[inliers], b[inliers])
        if start.inliers < max(8, need // 2):
            return None
        return self.refine_in_local_map(features, start, is_lost=is_lost)
