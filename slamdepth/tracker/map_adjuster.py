# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of parts of the map: what goes in, and what the map takes over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.backend.bundle import BundleProblem, BundleResult, bundle_adjust
from slamdepth.config import Config
from slamdepth.geometry import invert, transform
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracker.shutter import Shutter
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_MIN_OBSERVATIONS = 30
_READOUT_KEYFRAMES = 20  # among the recent ones, when the readout time is sought on the way


@dataclass(frozen=True)
class _Part:
    """A part of the map as a problem, and where each of its observations lies."""

    problem: BundleProblem
    keyframes: list[MapKeyframe]
    rows: Ints
    obs_feature: Ints


class MapAdjuster:
    """Adjusts keyframes and points of a :class:`LandmarkMap`."""

    def __init__(self, camera: Camera, config: Config, landmarks: LandmarkMap, shutter: Shutter) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = landmarks
        self._shutter = shutter

    def adjust(
        self, window: list[int], fixed: list[int], rows: Ints, iterations: tuple[int, ...]
    ) -> BundleResult | None:
        """Adjust the keyframes ``window``, held by ``fixed``, over the points ``rows``.

        The map is changed: poses, points, and observations that do not agree are forgotten.

        Returns:
            What came out; None where there is too little to adjust.
        """
        part = self._part(window, fixed, rows)
        if part is None:
            return None
        result = bundle_adjust(part.problem, iterations)
        self._take_over(part, result)
        bad = ~result.inlier
        ids = np.array([k.id for k in part.keyframes])
        self._map.drop_observations(ids[part.problem.obs_camera[bad]], part.obs_feature[bad])
        return result

    def find_readout(self, window: list[int] | None = None) -> bool:
        """Look for the shutter's readout time in some keyframes, by default the recent ones.

        It is one more unknown of an adjustment whose poses and points are thrown away: while
        it is no more than a supposition, the map must not depend on it.

        Returns:
            Whether the readout time is another now; keyframes have to follow.
        """
        if window is None:
            last = len(self._map.keyframes)
            window = list(range(max(0, last - _READOUT_KEYFRAMES), last))
        rows = self._map.points_of(window)
        rows = rows[self._map.observations[rows] >= 3]
        part = self._part(window, [], rows, find_readout=True)
        if part is None:
            return False
        result = bundle_adjust(part.problem, (3, 3))
        assert result.readout_sigma_s is not None
        return self._shutter.learn(result.readout_s, result.readout_sigma_s)

    def _part(
        self, window: list[int], fixed: list[int], rows: Ints, *, find_readout: bool = False
    ) -> _Part | None:
        landmarks = self._map
        used = sorted(window) + sorted(fixed)
        index_of = np.full(landmarks.size + 1, -1, dtype=np.int64)
        index_of[rows] = np.arange(len(rows))
        index_of[-1] = -1
        keyframes = [landmarks.keyframes[k] for k in used]
        seen = [(k, np.flatnonzero(index_of[k.point_ids] >= 0)) for k in keyframes]
        obs_camera = np.concatenate([np.full(len(at), i) for i, (_, at) in enumerate(seen)])
        if len(obs_camera) < _MIN_OBSERVATIONS:
            return None
        is_fixed = np.array([k in set(fixed) or k == 0 for k in used])
        if is_fixed.all():
            return None
        if not is_fixed.any():
            is_fixed[0] = True  # nothing outside holds the window: its oldest keyframe does
        first = landmarks.keyframes[0].prediction
        is_sensor = first is not None and first.is_sensor
        config = self._config.bundle
        sigma_log = np.concatenate([k.sigma_log[at] for k, at in seen])
        problem = BundleProblem(
            camera=self._camera,
            T_camera_world=np.stack([k.T_camera_world for k in keyframes]),
            fixed=is_fixed,
            points_w=landmarks.position_w[rows].copy(),
            obs_camera=obs_camera,
            obs_point=np.concatenate([index_of[k.point_ids[at]] for k, at in seen]),
            px=np.concatenate([k.features.px[at] for k, at in seen]),
            sigma_px=np.concatenate([k.features.sigma_px[at] for k, at in seen]),
            log_depth=np.concatenate([k.log_depth[at] for k, at in seen]),
            sigma_log=sigma_log * (1.0 if is_sensor else config.prior_inflation),
            sigma_scale=0.0 if is_sensor else config.scale_sigma,
            px_rate=(
                np.concatenate([self._shutter.px_rate(k, at) for k, at in seen]) if find_readout else None
            ),
        )
        return _Part(problem, keyframes, rows, np.concatenate([at for _, at in seen]))

    def _take_over(self, part: _Part, result: BundleResult) -> None:
        landmarks, rows = self._map, part.rows
        adjusted = np.zeros(landmarks.size, dtype=bool)
        adjusted[rows] = True
        for keyframe, T_new in zip(part.keyframes, result.T_camera_world, strict=True):
            if np.array_equal(T_new, keyframe.T_camera_world):
                continue
            # points outside the adjustment ride along with the keyframe they were born in
            riders = np.flatnonzero(
                (landmarks.birth_keyframe[: landmarks.size] == keyframe.id)
                & landmarks.alive[: landmarks.size]
                & ~adjusted
            )
            motion = invert(T_new) @ keyframe.T_camera_world
            landmarks.position_w[riders] = transform(motion, landmarks.position_w[riders])
            R = motion[:3, :3]
            landmarks.covariance_w[riders] = R @ landmarks.covariance_w[riders] @ R.T
            keyframe.T_camera_world = T_new
        landmarks.position_w[rows] = result.points_w
        landmarks.covariance_w[rows] = result.covariance_w
        landmarks.refresh_views(rows)
