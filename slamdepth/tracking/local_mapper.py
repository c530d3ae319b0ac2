# SPDX-License-Identifier: Apache-2.0
"""What a keyframe adds to the map: landmarks from its depth, and observations in its neighbours."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.alignment import DepthField, fit_depth_field, log_depth_at, prior_log_depth_at
from slamdepth.frontend.features import Features
from slamdepth.geometry import backproject, transform
from slamdepth.io.tree import Tree
from slamdepth.mapping.map import AdjustedLandmarks, Map, MapKeyframe
from slamdepth.robust import robust_deviation
from slamdepth.tracking.known_surface import KnownSurface
from slamdepth.tracking.localiser import Localiser
from slamdepth.types import Camera, DepthPrediction
from slamdepth.typing import Bools, Floats, Ints

log = logging.getLogger(__name__)

_MIN_JUDGES = 50  # well-known landmarks that it takes to judge a prediction
_WELL_KNOWN = 0.1  # relative deviation of a landmark's distance
_DISAGREES = 2.0  # times the scatter that a prediction claims


class LocalMapper:
    """Gives keyframes their depth and grows the map from it.

    Attributes:
        dropped: number of predictions that disagreed with the map.
    """

    def __init__(self, camera: Camera, config: Config, map_: Map, localiser: Localiser) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._map = map_
        self._localiser = localiser
        self._surface = KnownSurface(camera)
        self.dropped = 0

    def count_creatable(self, features: Features, prediction: DepthPrediction) -> int:
        """How many landmarks a first keyframe would create."""
        depth, sigma = log_depth_at(prediction, features.raw_px)
        return int(np.count_nonzero(self._is_creatable(depth, sigma)))

    def _is_creatable(self, log_depth: Floats, sigma_log: Floats) -> Bools:
        """Where a depth is known, in range, and certain enough by the model's own deviation."""
        config = self._config.depth
        in_range = (log_depth > np.log(config.min_m)) & (log_depth < np.log(config.max_m))
        return np.asarray(in_range & (sigma_log < config.max_sigma_log))

    def add_depth(self, keyframe: MapKeyframe, prediction: DepthPrediction) -> None:
        """Give a keyframe its depth and create landmarks where it sees none yet.

        A prediction that disagrees with the map as a whole is dropped: the keyframe has no depth then.
        """
        is_doubted = self._localiser.view_change.doubts_depth
        if not (prediction.is_sensor or is_doubted or self._agrees(keyframe, prediction)):
            log.warning("keyframe %d: its predicted depth disagrees with the map; not used", keyframe.id)
            prediction = replace(prediction, values=np.zeros_like(prediction.values))
            self.dropped += 1
        features: Features = keyframe.features
        kept = _compact(prediction)
        depth, sigma = log_depth_at(prediction, features.raw_px)
        certain = sigma < self._config.depth.max_sigma_log
        if prediction.is_sensor:
            new = self._creatable(keyframe, depth, sigma, certain)
            self._map.set_depth(keyframe, kept, depth, sigma)
        else:
            prior, prior_sigma = prior_log_depth_at(prediction, features.raw_px)
            field = self.depth_field(keyframe, kept, by_others=True)
            there = features.raw_px, np.nan_to_num(prior), np.nan_to_num(prior_sigma, nan=1.0)
            correction = field.mean(*there)
            aligned = prior + correction
            own = self._anchored(keyframe)
            unseen = np.flatnonzero(((keyframe.landmark_ids < 0) | own) & certain)
            sigma[unseen] = field.correction(*(values[unseen] for values in there))[1]
            # in a map that has grown far beyond the network's range, that of its own values decides
            in_range = np.where(np.isfinite(aligned), depth, np.nan) if is_doubted else aligned
            new = self._creatable(keyframe, in_range, sigma, certain)
            log_depth, sigma_log = keyframe.log_depth.copy(), keyframe.sigma_log.copy()
            replaced = np.flatnonzero(own & certain & self._is_creatable(in_range, sigma))
            for at in (new, replaced):
                log_depth[at], sigma_log[at] = aligned[at], sigma[at]
            self._place(keyframe, replaced, aligned, sigma)
            self._surface.add(keyframe, kept, field)
            scale = float(np.exp(np.median(correction)))
            self._map.set_depth(keyframe, kept, log_depth, sigma_log, predicted_log_depth=depth, scale=scale)
            depth = aligned
        self._map.create_landmarks(keyframe, new, *self._points(keyframe, new, depth, sigma))

    def add_surface(self, keyframe: MapKeyframe) -> float:
        """Create landmarks of a keyframe from the depth of earlier ones, until its own is predicted.

        The depth of earlier keyframes is aligned to what the keyframe sees, as a prediction of its own is.

        Returns:
            The share of features without a landmark that got one.
        """
        features: Features = keyframe.features
        others = [self._map.keyframes[k] for k in self.neighbours(keyframe)]
        aligned, sigma = self._surface.log_depth(keyframe, others)
        unseen = keyframe.landmark_ids < 0
        known = np.flatnonzero(unseen & np.isfinite(aligned))
        if not len(known):
            return 0.0
        seen, ids, z = self._map.depths_seen(keyframe, observations=2)
        field = fit_depth_field(
            features.raw_px[seen],
            aligned[seen],
            sigma[seen],
            np.log(z),
            self._map.sigma_along_ray(ids, keyframe.center_w),
            width=self._camera.width,
        )
        correction, posterior = field.correction(features.raw_px[known], aligned[known], sigma[known])
        aligned[known] += correction
        sigma[known] = posterior
        new = known[self._is_creatable(aligned[known], posterior)]
        log_depth, sigma_log = keyframe.log_depth.copy(), keyframe.sigma_log.copy()
        log_depth[new], sigma_log[new] = aligned[new], sigma[new]
        self._map.set_prior(keyframe, log_depth, sigma_log)
        self._map.create_landmarks(keyframe, new, *self._points(keyframe, new, aligned, sigma))
        return len(new) / np.count_nonzero(unseen)

    def _points(
        self, keyframe: MapKeyframe, at: Ints, log_depth: Floats, sigma_log: Floats
    ) -> tuple[Floats, Floats]:
        """Positions ``(M, 3)`` and covariances ``(M, 3, 3)`` in the world of the features ``at (M,)``."""
        features: Features = keyframe.features
        position_c = backproject(self._camera, features.px[at], np.exp(log_depth[at]))
        covariance_c = ray_covariance(
            self._camera, features.px[at], position_c, sigma_log[at], features.sigma_px[at]
        )
        T_world_camera = keyframe.T_world_camera
        R = T_world_camera[:3, :3]
        return transform(T_world_camera, position_c), R @ covariance_c @ R.T

    def _anchored(self, keyframe: MapKeyframe) -> Bools:
        """Which features see a landmark that this keyframe created."""
        ids = keyframe.landmark_ids
        anchor = self._map.landmarks.anchor_keyframe
        return np.asarray((ids >= 0) & (anchor[ids] == keyframe.id)) if len(anchor) else ids >= 0

    def _place(self, keyframe: MapKeyframe, at: Ints, log_depth: Floats, sigma_log: Floats) -> None:
        """Move landmarks that no other keyframe has seen yet to the depth of features ``at (M,)``."""
        at = at[self._map.landmarks.observations[keyframe.landmark_ids[at]] < 2]
        points = AdjustedLandmarks(
            keyframe.landmark_ids[at], *self._points(keyframe, at, log_depth, sigma_log)
        )
        self._map.correct([], np.zeros((0, 4, 4)), adjusted=points)

    def _creatable(
        self, keyframe: MapKeyframe, log_depth: Floats, sigma_log: Floats, certain: Bools
    ) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Features without a landmark whose depth is good enough to create one."""
        return np.flatnonzero(
            (keyframe.landmark_ids < 0) & certain & self._is_creatable(log_depth, sigma_log)
        )

    def _agrees(self, keyframe: MapKeyframe, prediction: DepthPrediction) -> bool:
        """Whether a prediction scatters about well-known landmarks by what it claims, or nearly so.

        Its scale is left out: that is an error that tracking estimates.
        """
        at, ids, z = self._map.depths_seen(keyframe, observations=3)
        predicted, sigma = log_depth_at(prediction, keyframe.features.raw_px[at])
        ratio = np.log(z) - predicted
        ratio = ratio[self._map.sigma_along_ray(ids, keyframe.center_w) < _WELL_KNOWN]
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < _MIN_JUDGES:
            return True
        scatter = robust_deviation(ratio)
        return scatter < _DISAGREES * float(np.median(sigma))

    def depth_field(
        self, keyframe: MapKeyframe, prediction: DepthPrediction, *, by_others: bool = False
    ) -> DepthField:
        """The keyframe's ``prediction`` aligned to the landmarks it shares with other keyframes.

        Args:
            by_others: leave out landmarks that the keyframe created.
        """
        seen, ids, z = self._map.depths_seen(keyframe, observations=2)
        if by_others:
            kept = self._map.landmarks.anchor_keyframe[ids] != keyframe.id
            seen, ids, z = seen[kept], ids[kept], z[kept]
        raw = keyframe.features.raw_px[seen]
        log_predicted, sigma = prior_log_depth_at(prediction, raw)
        return fit_depth_field(
            raw,
            log_predicted,
            sigma,
            np.log(z),
            self._map.sigma_along_ray(ids, keyframe.center_w),
            width=self._camera.width,
            prior_offset=float(np.log(self._map.keyframes[keyframe.id - 1].scale)) if keyframe.id else 0.0,
        )

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {"dropped": self.dropped, "surface": self._surface.state()}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self.dropped = state["dropped"]
        self._surface.restore(state["surface"], self._map.keyframes)

    def absorb(self, other: LocalMapper) -> None:
        """Take over the views and the count of another map's keyframes, which are in this map now."""
        self.dropped += other.dropped
        self._surface.absorb(other._surface)

    def neighbours(self, keyframe: MapKeyframe, limit: int = 10) -> list[int]:
        """Ids of the keyframes that see most of what ``keyframe`` sees, best first."""
        own = keyframe.landmark_ids[keyframe.landmark_ids >= 0]
        return [k for k in self._map.covisible(own, limit + 1, minimum=8) if k != keyframe.id]

    def search(self, keyframe: MapKeyframe, neighbours: Iterable[int], *, may_fuse: bool = True) -> None:
        """Find the keyframe's landmarks in other keyframes, and fuse what is one landmark.

        For a new landmark the search area is the part of its epipolar line that its predicted depth
        allows; a match is its first triangulation.
        """
        max_px = self._camera.width / 4 if self._localiser.view_change.is_large else 60.0
        for k in neighbours:
            other = self._map.keyframes[k]
            mine = np.unique(keyframe.landmark_ids[keyframe.landmark_ids >= 0])
            ids = mine[~self._map.mask(other.landmark_ids)[mine]]
            visible = self._localiser.expected(other.T_camera_world, ids)
            ids, at, _ = self._localiser.search(
                visible, other.features, 2.5, max_px, is_strict=True, ratio=0.75, sigmas=2.5
            )
            if not may_fuse:
                free = other.landmark_ids[at] < 0
                at, ids = at[free], ids[free]
            self._map.observe(other, at, ids)


def _compact(prediction: DepthPrediction) -> DepthPrediction:
    """What a keyframe keeps: a sensor's deviation follows from its depth, a network's needs few digits."""
    if prediction.is_sensor or prediction.sigma_log is None:
        return replace(prediction, sigma_log=None)
    return replace(prediction, sigma_log=prediction.sigma_log.astype(np.float16))


def ray_covariance(
    camera: Camera, px: Floats, position_c: Floats, sigma_log: Floats, sigma_px: Floats
) -> Floats:
    """``(N, 3, 3)`` covariance in m^2, camera frame, of points known by pixel and uncertain depth.

    Args:
        px: ``(N, 2)`` undistorted pixels with deviations ``sigma_px (N,)``.
        position_c: ``(N, 3)`` metres, camera frame.
        sigma_log: ``(N,)`` deviation of the natural logarithm of the depth.
    """
    z = position_c[:, 2]
    along = position_c * sigma_log[:, None]
    lateral = z * sigma_px / camera.fx
    covariance = along[:, :, None] * along[:, None, :]
    for axis in range(3):
        covariance[:, axis, axis] += lateral**2
    return covariance
