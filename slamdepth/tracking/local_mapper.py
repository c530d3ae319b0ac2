# SPDX-License-Identifier: Apache-2.0
"""What happens at a keyframe: birth of points, search in neighbours, local bundle adjustment."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.alignment import (
    DepthField,
    fit_depth_field,
    log_depth_at,
    prior_log_depth_at,
)
from slamdepth.frontend.features import Features
from slamdepth.geometry import backproject, transform
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.map_adjuster import Adjustment, MapAdjuster
from slamdepth.types import Camera, DepthPrediction, Frame
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


_LOCAL_STEPS = (3, 3)


_JUDGES = 50  # well-known points that it takes to judge a prediction
_WELL_KNOWN = 0.1  # relative deviation of a point's distance
_DISAGREES = 2.0  # times the scatter that a prediction says of itself

log = logging.getLogger(__name__)


class LocalMapper:
    """Grows and refines a :class:`LandmarkMap`, one keyframe at a time.

    Attributes:
        dropped: predictions that disagreed with the map.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        landmarks: LandmarkMap,
        localiser: Localiser,
        adjuster: MapAdjuster,
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = landmarks
        self._localiser = localiser
        self._adjuster = adjuster
        self.dropped = 0

    def insert(
        self,
        frame: Frame,
        features: Features,
        T_camera_world: Floats,
        point_ids: Ints,
        velocity: Floats,
    ) -> MapKeyframe:
        """Make ``frame`` a keyframe of the map with the points it knows; its depth comes later."""
        keyframe = MapKeyframe(
            id=len(self._map.keyframes),
            frame=StoredFrame(frame),
            features=features,
            T_camera_world=T_camera_world.copy(),
            point_ids=point_ids.copy(),
            log_depth=np.full(len(features), np.nan),
            sigma_log=np.full(len(features), np.nan),
            velocity=velocity,
        )
        self._map.add_keyframe(keyframe)
        return keyframe

    def count_births(self, features: Features, prediction: DepthPrediction) -> int:
        """How many points a first keyframe would give birth to."""
        depth, sigma = log_depth_at(prediction, features.raw_px)
        return int(np.count_nonzero(self._may_be_born(depth, sigma)))

    def _may_be_born(self, log_depth: Floats, sigma_log: Floats) -> NDArray[np.bool_]:
        """Where a depth is known, in range, and sure enough by the model's own word."""
        config = self._config.depth
        in_range = (log_depth > np.log(config.min_m)) & (log_depth < np.log(config.max_m))
        return in_range & (sigma_log < config.max_sigma_log)

    def give_birth(self, keyframe: MapKeyframe, prediction: DepthPrediction) -> None:
        """Give a keyframe its depth, and birth to the points it sees anew.

        A prediction that disagrees with the map as a whole is dropped: the keyframe has no depth then.
        """
        if not prediction.is_sensor and not self._agrees(keyframe, prediction):
            log.warning("keyframe %d: its predicted depth disagrees with the map; not used", keyframe.id)
            prediction = replace(prediction, values=np.zeros_like(prediction.values))
            self.dropped += 1
        compact = _compact(prediction)
        keyframe.prediction = StoredPrediction(compact)
        features = keyframe.features
        depth, sigma = log_depth_at(prediction, features.raw_px)
        sure = sigma < self._config.depth.max_sigma_log
        if prediction.is_sensor:
            keyframe.log_depth, keyframe.sigma_log = depth, sigma
        else:
            prior, doubt = prior_log_depth_at(prediction, features.raw_px)
            keyframe.predicted_log_depth = depth
            field = self.depth_field(keyframe, compact)
            there = features.raw_px, np.nan_to_num(prior), np.nan_to_num(doubt, nan=1.0)
            correction = field.mean(*there)
            keyframe.scale = float(np.exp(np.median(correction)))
            depth = prior + correction
            new = np.flatnonzero((keyframe.point_ids < 0) & sure)
            sigma[new] = field.correction(*(values[new] for values in there))[1]
        born = np.flatnonzero((keyframe.point_ids < 0) & sure & self._may_be_born(depth, sigma))
        if not prediction.is_sensor:
            keyframe.log_depth[born] = depth[born]
            keyframe.sigma_log[born] = sigma[born]
        position_c = backproject(self._camera, features.px[born], np.exp(depth[born]))
        T_world_camera = keyframe.T_world_camera
        covariance_c = ray_covariance(
            self._camera, features.px[born], position_c, sigma[born], features.sigma_px[born]
        )
        R = T_world_camera[:3, :3]
        self._map.add_points(keyframe, born, transform(T_world_camera, position_c), R @ covariance_c @ R.T)

    def _agrees(self, keyframe: MapKeyframe, prediction: DepthPrediction) -> bool:
        """Whether a prediction scatters about the well-known points as it says of itself, or nearly so.

        Its scale is left out: that is an error that tracking estimates.
        """
        at, rows, z = self._map.depths_seen(keyframe, observations=3)
        predicted, sigma = log_depth_at(prediction, keyframe.features.raw_px[at])
        ratio = np.log(z) - predicted
        ratio = ratio[self._map.sigma_along_ray(rows, keyframe.center_w) < _WELL_KNOWN]
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < _JUDGES:
            return True
        scatter = 1.4826 * float(np.median(np.abs(ratio - np.median(ratio))))
        return scatter < _DISAGREES * float(np.median(sigma))

    def depth_field(self, keyframe: MapKeyframe, prediction: DepthPrediction) -> DepthField:
        """The keyframe's ``prediction`` tied to the well-known points it sees."""
        seen, rows, z = self._map.depths_seen(keyframe, observations=2)
        raw = keyframe.features.raw_px[seen]
        log_predicted, sigma = prior_log_depth_at(prediction, raw)
        return fit_depth_field(
            raw,
            log_predicted,
            sigma,
            np.log(z),
            self._map.sigma_along_ray(rows, keyframe.center_w),
            width=self._camera.width,
            prior_offset=float(np.log(self._map.keyframes[keyframe.id - 1].scale)) if keyframe.id else 0.0,
        )

    def neighbours(self, keyframe: MapKeyframe, limit: int = 10) -> list[int]:
        """The keyframes that see most of what ``keyframe`` sees, best first."""
        own = keyframe.point_ids[keyframe.point_ids >= 0]
        return [k for k in self._map.covisible(own, limit + 1, minimum=8) if k != keyframe.id]

    def search(self, keyframe: MapKeyframe, neighbours: Iterable[int]) -> None:
        """Find the keyframe's points in others, and merge what is one point.

        For a freshly born point the search area is the stretch of its epipolar line that
        its predicted depth allows; a hit is its first triangulation.
        """
        landmarks = self._map
        for k in neighbours:
            other = landmarks.keyframes[k]
            mine = np.unique(keyframe.point_ids[keyframe.point_ids >= 0])
            seen_there = np.zeros(landmarks.size + 1, dtype=bool)
            seen_there[other.point_ids] = True
            seen_there[-1] = False
            rows = mine[~seen_there[mine]]
            visible = self._localiser.expected(other.T_camera_world, rows)
            rows, at, _ = self._localiser.search(
                visible, other.features, 2.5, 60.0, is_strict=True, ratio=0.75, sigmas=2.5
            )
            self._attach(other, rows, at)

    def _attach(self, keyframe: MapKeyframe, rows: Ints, at: Ints) -> None:
        landmarks = self._map
        there = keyframe.point_ids[at]
        free = there < 0
        keyframe.point_ids[at[free]] = rows[free]
        landmarks.observations[rows[free]] += 1
        mine, theirs = rows[~free], there[~free]
        alive = (mine != theirs) & landmarks.alive[mine] & landmarks.alive[theirs]
        mine, theirs = mine[alive], theirs[alive]
        stronger = landmarks.observations[mine] > landmarks.observations[theirs]
        landmarks.merge(np.where(stronger, theirs, mine), np.where(stronger, mine, theirs))

    def begin_window(self, keyframe: MapKeyframe) -> Adjustment | None:
        """Local bundle adjustment of the keyframe and those that see most of its points, in the thread
        beside; see :meth:`MapAdjuster.begin`. None where it is switched off."""
        if not self._config.bundle.local:
            return None
        return self._adjuster.begin(*self._window(keyframe), _LOCAL_STEPS)

    def _window(self, keyframe: MapKeyframe) -> tuple[list[int], list[int], Ints]:
        """Keyframes to move, keyframes that hold them, and the points between."""
        landmarks, config = self._map, self._config.bundle
        own = keyframe.point_ids[keyframe.point_ids >= 0]
        window = landmarks.covisible(own, config.window, minimum=10)
        if keyframe.id not in window:
            window = [keyframe.id, *window[: config.window - 1]]
        rows = landmarks.points_of(window)
        rows = rows[landmarks.observations[rows] >= 2]
        around = landmarks.shared_points(rows)
        around[window] = 0
        order = np.argsort(-around, kind="stable")[: config.fixed]
        fixed = [int(k) for k in order if around[k] > 0]
        return window, fixed, rows

    def cull(self, keyframe: MapKeyframe) -> None:
        """Remove points that are seldom found where they should be."""
        landmarks = self._map
        n = landmarks.size
        age = keyframe.id - landmarks.birth_keyframe[:n]
        seldom = landmarks.found[:n] < 0.25 * landmarks.visible[:n]
        # a point that several keyframes have found proved itself: what hides it is blur or an obstacle
        young = (age <= 3) | (landmarks.observations[:n] < 3)
        lonely = (landmarks.observations[:n] < 2) & (age >= 3)
        behind = landmarks.alive[:n] & ~np.isfinite(landmarks.position_w[:n]).all(axis=1)
        landmarks.kill(
            np.flatnonzero(landmarks.alive[:n] & ((seldom & (age >= 1) & young) | lonely | behind))
        )


def _compact(prediction: DepthPrediction) -> DepthPrediction:
    """What a keyframe keeps: a sensor's deviation follows from its depth, a network's needs few digits."""
    if prediction.is_sensor or prediction.sigma_log is None:
        return replace(prediction, sigma_log=None)
    return replace(prediction, sigma_log=prediction.sigma_log.astype(np.float16))


def ray_covariance(
    camera: Camera, px: Floats, position_c: Floats, sigma_log: Floats, sigma_px: Floats
) -> Floats:
    """``(N, 3, 3)`` covariance, camera frame, of points known by pixel and uncertain depth."""
    z = position_c[:, 2]
    along = position_c * sigma_log[:, None]
    lateral = z * sigma_px / camera.fx
    covariance = along[:, :, None] * along[:, None, :]
    for axis in range(3):
        covariance[:, axis, axis] += lateral**2
    return covariance
