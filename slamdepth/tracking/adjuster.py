# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of parts of the map: what goes in, and what the map takes over."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem, BundleResult
from slamdepth.backend.resection import multi_start
from slamdepth.config import Config
from slamdepth.geometry import CHI2_2DOF_95, orthonormalised
from slamdepth.mapping.map import AdjustedLandmarks, Map, MapKeyframe
from slamdepth.mapping.observations import Observations
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.view_change import ViewChange
from slamdepth.tracking.workers import Worker
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_MIN_OBSERVATIONS = 30
_LOCAL_STEPS = (3, 3)
_READOUT_KEYFRAMES = 20  # latest ones, when the readout time is estimated while tracking
_READOUT_STEPS = (2, 2)
_BETTER = 0.98  # of the cost: another start must be so much better to be believed


@dataclass(frozen=True)
class _Part:
    """A part of the map as a problem, and where each of its observations lies."""

    problem: BundleProblem
    keyframes: list[MapKeyframe]
    landmark_ids: Ints
    obs_feature: Ints


@dataclass(frozen=True)
class Adjustment:
    """An adjustment in progress, of the map as it was when it had so many ``keyframes``."""

    part: _Part
    keyframes: int
    result: Future[BundleResult]


def _total_cost(result: BundleResult) -> float:
    """The cost of the inliers, and for each outlier the least it would have cost."""
    return result.final_cost + CHI2_2DOF_95 * float(np.count_nonzero(~result.inlier))


class Adjuster:
    """Adjusts keyframes and landmarks of a map, at once or in another thread."""

    def __init__(
        self,
        camera: Camera,
        config: Config,
        map_: Map,
        shutter: RollingShutter,
        view_change: ViewChange,
        side: Worker,
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = map_
        self._shutter = shutter
        self._view_change = view_change
        self._side = side

    def adjust(
        self, window: list[int], fixed: list[int], landmark_ids: Ints, iterations: tuple[int, ...]
    ) -> None:
        """Adjust keyframes and landmarks and let the map take the result over.

        Does nothing where there is too little to adjust.

        Args:
            window: ids of the keyframes to adjust.
            fixed: ids of keyframes that hold them.
            landmark_ids: ``(P,)``.
            iterations: see :func:`bundle_adjust`.
        """
        part = self._part(window, fixed, landmark_ids)
        if part is not None:
            self._take_over(part, bundle_adjust(part.problem, iterations))

    def adjust_from_two_starts(
        self, window: list[int], landmark_ids: Ints, iterations: tuple[int, ...]
    ) -> bool:
        """Adjust from the present map and from re-registered keyframes; keep the better result.

        The map is changed only where the other start ends better by more than chance.

        Args:
            window, landmark_ids, iterations: see :meth:`adjust`.

        Returns:
            Whether the other start was better.
        """
        part = self._part(window, [], landmark_ids)
        if part is None:
            return False
        other = multi_start(part.problem)
        if other is None:
            return False
        was, now = (bundle_adjust(problem, iterations) for problem in (part.problem, other))
        if _total_cost(now) > _BETTER * _total_cost(was):
            return False
        self._take_over(part, now)
        return True

    def begin_window(self, keyframe: MapKeyframe) -> Adjustment | None:
        """Start local bundle adjustment of a keyframe and those that share most landmarks with it.

        It runs in the side thread. Until :meth:`complete` the map may get keyframes without landmarks
        of their own, and poses may be read; no landmark may be fused, removed or change its id.

        Returns:
            None where local adjustment is switched off or there is too little to adjust.
        """
        if not self._config.bundle.local:
            return None
        part = self._part(*self._window(keyframe))
        if part is None:
            return None
        result = self._side.submit(bundle_adjust, part.problem, _LOCAL_STEPS)
        return Adjustment(part, len(self._map.keyframes), result)

    def adjust_window(self, keyframe: MapKeyframe) -> None:
        """Local bundle adjustment of a keyframe and those that share most landmarks with it, at once."""
        if self._config.bundle.local:
            self.adjust(*self._window(keyframe), _LOCAL_STEPS)

    def _window(self, keyframe: MapKeyframe) -> tuple[list[int], list[int], Ints]:
        """Keyframes to move, keyframes that hold them, and the landmarks between."""
        config = self._config.bundle
        own = keyframe.landmark_ids[keyframe.landmark_ids >= 0]
        window = self._map.covisible(own, config.window, minimum=10)
        if keyframe.id not in window:
            window = [keyframe.id, *window[: config.window - 1]]
        ids = self._map.seen_from(window)
        ids = ids[self._map.landmarks.observations[ids] >= 2]
        around = self._map.shared_landmarks(ids)
        around[window] = 0
        order = np.argsort(-around, kind="stable")[: config.fixed]
        return window, [int(k) for k in order if around[k] > 0], ids

    def complete(self, adjustment: Adjustment) -> None:
        """Wait for an adjustment and let the map take it over; keyframes made since then move along."""
        newest = max(adjustment.part.keyframes, key=lambda keyframe: keyframe.id)
        T_world_newest = newest.T_world_camera
        self._take_over(adjustment.part, adjustment.result.result())
        later = self._map.keyframes[adjustment.keyframes :]
        moved = [
            orthonormalised(keyframe.T_camera_world @ T_world_newest @ newest.T_camera_world)
            for keyframe in later
        ]
        self._map.correct([keyframe.id for keyframe in later], np.array(moved).reshape(-1, 4, 4))

    def estimate_readout(self, window: list[int]) -> bool:
        """Estimate the shutter's readout time over some keyframes.

        It is one more unknown of an adjustment whose poses and landmarks are dropped: the map must
        not depend on a readout time that may not be significant.

        Returns:
            Whether the readout time has changed; keyframes have to follow.
        """
        part = self._readout_part(window)
        return part is not None and self._update_readout(bundle_adjust(part.problem, _READOUT_STEPS))

    def begin_readout(self) -> Future[BundleResult] | None:
        """Start to estimate it over the latest keyframes in the side thread; None where there are too few."""
        last = len(self._map.keyframes)
        part = self._readout_part(list(range(max(0, last - _READOUT_KEYFRAMES), last)))
        return None if part is None else self._side.submit(bundle_adjust, part.problem, _READOUT_STEPS)

    def complete_readout(self, result: Future[BundleResult]) -> bool:
        """Wait for the estimate; returns whether the readout time has changed."""
        return self._update_readout(result.result())

    def _readout_part(self, window: list[int]) -> _Part | None:
        ids = self._map.seen_from(window)
        ids = ids[self._map.landmarks.observations[ids] >= 3]
        return self._part(window, [], ids, with_readout=True)

    def _update_readout(self, result: BundleResult) -> bool:
        assert result.readout_sigma_s is not None
        return self._shutter.update(result.readout_s, result.readout_sigma_s)

    def _part(
        self, window: list[int], fixed: list[int], landmark_ids: Ints, *, with_readout: bool = False
    ) -> _Part | None:
        used = sorted(window) + sorted(fixed)
        keyframes = [self._map.keyframes[k] for k in used]
        seen = Observations.of(keyframes, landmark_ids, self._map.size)
        if len(seen) < _MIN_OBSERVATIONS:
            return None
        is_fixed = np.array([k in set(fixed) or k == 0 for k in used])
        if is_fixed.all():
            return None
        if not is_fixed.any():
            is_fixed[0] = True  # nothing outside holds the window: its oldest keyframe does
        is_sensor = self._map.is_measured
        config = self._config.bundle
        problem = BundleProblem(
            camera=self._camera,
            T_camera_world=np.stack([k.T_camera_world for k in keyframes]),
            fixed=is_fixed,
            points_w=self._map.landmarks.position_w[landmark_ids].copy(),
            obs_camera=seen.keyframe,
            obs_point=seen.landmark,
            px=seen.px,
            sigma_px=seen.sigma_px,
            log_depth=seen.log_depth,
            sigma_log=seen.sigma_log * (1.0 if is_sensor else config.prior_inflation),
            sigma_scale=0.0 if is_sensor else config.scale_sigma,
            px_rate=self._px_rate(keyframes, seen) if with_readout else None,
            doubt=config.prior_inflation if self._view_change.doubts_depth else 1.0,
        )
        return _Part(problem, keyframes, landmark_ids, seen.feature)

    def _px_rate(self, keyframes: list[MapKeyframe], seen: Observations) -> Floats:
        """``(M, 2)`` see :attr:`BundleProblem.px_rate`."""
        features = [seen.feature[seen.keyframe == n] for n in range(len(keyframes))]
        return np.concatenate(
            [self._shutter.px_rate(k, at) for k, at in zip(keyframes, features, strict=True)]
        )

    def _take_over(self, part: _Part, result: BundleResult) -> None:
        """Landmarks that were not adjusted move with their anchor keyframes."""
        ids = np.array([keyframe.id for keyframe in part.keyframes])
        moved = [
            i
            for i, (keyframe, T_new) in enumerate(zip(part.keyframes, result.T_camera_world, strict=True))
            if not np.array_equal(T_new, keyframe.T_camera_world)
        ]
        adjusted = AdjustedLandmarks(part.landmark_ids, result.points_w, result.covariance_w)
        self._map.correct(ids[moved].tolist(), result.T_camera_world[moved], adjusted=adjusted)
        bad = ~result.inlier
        self._map.forget_observations(ids[part.problem.obs_camera[bad]], part.obs_feature[bad])
