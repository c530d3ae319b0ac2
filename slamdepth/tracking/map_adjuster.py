# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of parts of the map: what goes in, and what the map takes over."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from slamdepth.backend.bundle import BundleProblem, BundleResult, bundle_adjust
from slamdepth.backend.resection import placed_anew
from slamdepth.config import Config
from slamdepth.geometry import CHI2_2DOF_95, invert, orthonormalised, transform
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.shutter import Shutter
from slamdepth.tracking.side_thread import SideThread
from slamdepth.types import Camera
from slamdepth.typing import Ints

_MIN_OBSERVATIONS = 30
_READOUT_KEYFRAMES = 20  # among the recent ones, when the readout time is sought on the way
_READOUT_STEPS = (2, 2)
_BETTER = 0.98  # of the cost: another start must be so much better to be believed


@dataclass(frozen=True)
class _Part:
    """A part of the map as a problem, and where each of its observations lies."""

    problem: BundleProblem
    keyframes: list[MapKeyframe]
    rows: Ints
    obs_feature: Ints


@dataclass(frozen=True)
class Adjustment:
    """One on its way: of a part of the map as it was when there were so many keyframes."""

    part: _Part
    keyframes: int
    result: Future[BundleResult]


def _whole_cost(result: BundleResult) -> float:
    """The cost of what was kept, and for what was not the least it would have been."""
    return result.final_cost + CHI2_2DOF_95 * float(np.count_nonzero(~result.inlier))


class MapAdjuster:
    """Adjusts keyframes and points of a :class:`LandmarkMap`, at once or in a thread beside."""

    def __init__(
        self, camera: Camera, config: Config, landmarks: LandmarkMap, shutter: Shutter, side: SideThread
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = landmarks
        self._shutter = shutter
        self._side = side

    def adjust(self, window: list[int], fixed: list[int], rows: Ints, iterations: tuple[int, ...]) -> None:
        """Adjust the keyframes ``window``, held by ``fixed``, over the points ``rows``.

        The map is changed: poses, points, and observations that do not agree are forgotten. Nothing
        happens where there is too little to adjust.
        """
        part = self._part(window, fixed, rows)
        if part is not None:
            self._take_over(part, bundle_adjust(part.problem, iterations))

    def reconsider(self, window: list[int], rows: Ints, iterations: tuple[int, ...]) -> bool:
        """Look for a better minimum: adjust from where the map is, and from another start.

        The map is changed where the other start ends better, by more than chance.

        Returns:
            Whether the other start was the better one.
        """
        part = self._part(window, [], rows)
        if part is None:
            return False
        other = placed_anew(part.problem)
        if other is None:
            return False
        was, now = (bundle_adjust(problem, iterations) for problem in (part.problem, other))
        if _whole_cost(now) > _BETTER * _whole_cost(was):
            return False
        self._take_over(part, now)
        return True

    def begin(
        self, window: list[int], fixed: list[int], rows: Ints, iterations: tuple[int, ...]
    ) -> Adjustment | None:
        """The same in the thread beside. Until it is completed the map may get more keyframes, without
        points of their own, and poses may be read; no point may be merged, die or change its row.

        Returns:
            None where there is too little to adjust.
        """
        part = self._part(window, fixed, rows)
        if part is None:
            return None
        result = self._side.ask(bundle_adjust, part.problem, iterations)
        return Adjustment(part, len(self._map.keyframes), result)

    def complete(self, adjustment: Adjustment) -> None:
        """Wait for an adjustment and let the map take it over; keyframes made since then move along."""
        newest = max(adjustment.part.keyframes, key=lambda keyframe: keyframe.id)
        T_world_newest = newest.T_world_camera
        self._take_over(adjustment.part, adjustment.result.result())
        for keyframe in self._map.keyframes[adjustment.keyframes :]:
            keyframe.T_camera_world = orthonormalised(
                keyframe.T_camera_world @ T_world_newest @ newest.T_camera_world
            )

    def find_readout(self, window: list[int]) -> bool:
        """Look for the shutter's readout time in some keyframes.

        It is one more unknown of an adjustment whose poses and points are thrown away: while
        it is no more than a supposition, the map must not depend on it.

        Returns:
            Whether the readout time is another now; keyframes have to follow.
        """
        part = self._readout_part(window)
        return part is not None and self._learn(bundle_adjust(part.problem, _READOUT_STEPS))

    def begin_readout(self) -> Future[BundleResult] | None:
        """Look for it in the recent keyframes in the thread beside; None where there is too little."""
        last = len(self._map.keyframes)
        part = self._readout_part(list(range(max(0, last - _READOUT_KEYFRAMES), last)))
        return None if part is None else self._side.ask(bundle_adjust, part.problem, _READOUT_STEPS)

    def complete_readout(self, result: Future[BundleResult]) -> bool:
        """Wait for it; returns what :meth:`find_readout` does."""
        return self._learn(result.result())

    def _readout_part(self, window: list[int]) -> _Part | None:
        rows = self._map.points_of(window)
        return self._part(window, [], rows[self._map.observations[rows] >= 3], find_readout=True)

    def _learn(self, result: BundleResult) -> bool:
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
        is_sensor = landmarks.is_measured
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
        bad = ~result.inlier
        ids = np.array([k.id for k in part.keyframes])
        landmarks.drop_observations(ids[part.problem.obs_camera[bad]], part.obs_feature[bad])
