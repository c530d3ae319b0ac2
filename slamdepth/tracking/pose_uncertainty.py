# SPDX-License-Identifier: Apache-2.0
"""How accurate a placed frame's pose is."""

from __future__ import annotations

import math

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.frontend.pose import pose_covariance
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_view import MapView, median_depth_m
from slamdepth.mapping.placement import Placement
from slamdepth.types import Camera
from slamdepth.typing import Floats

GOOD_SHARE = 0.02
"""A good pose is off by less than this share of the scene's distance,"""
GOOD_RAD = math.radians(2.0)
"""and by less than this angle."""

_CAMERA_SHARE = 0.0075
_DEPTH_SHARE = 0.5
_MATCHES = 150  # that are looked at: a sample says enough, in a third of the time
_MOTION_S = 1.0
_MAX_GAP_S = 1.0  # a step over a longer time says nothing of the motion now


class PoseUncertainty:
    """The covariance and the quality of each pose, see :class:`slamdepth.types.StepResult`.

    To the covariance by the matches comes what all matches of a frame share, for the motion of a second:

    * errors of intrinsics, lens, shutter and clock: 0.75 % of the image motion, an angle plus a length over
      the distance of the scene;
    * the common error of the depths that landmarks were created from: half of their relative deviation along
      the ray, times the length. It vanishes as landmarks are triangulated.

    Args:
        camera: that took the frames.

    Attributes:
        image_sigma: deviation of the last pose as image motion, radians.
    """

    def __init__(self, camera: Camera, map_: MapView) -> None:
        self._camera = camera.without_distortion()
        self._map = map_
        self._last: tuple[float, Floats] | None = None  # time and T_camera_world
        self.image_sigma = 0.0

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {"last": self._last, "image_sigma": self.image_sigma}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        last = state["last"]
        self._last = None if last is None else (last[0], np.array(last[1]))
        self.image_sigma = state["image_sigma"]

    def forget_motion(self) -> None:
        """The last pose is in another world frame now."""
        self._last = None

    def __call__(
        self, timestamp_s: float, features: Features, placement: Placement
    ) -> tuple[Floats | None, float]:
        """Covariance and quality of the next placed frame.

        Args:
            features: of the frame; ``placement`` says which landmark each sees.

        Returns:
            ``(None, 0.0)`` where too few landmarks determine the pose.
        """
        at = np.flatnonzero(placement.landmark_ids >= 0)
        every = 1 + len(at) // _MATCHES
        at = at[::every]
        ids = placement.landmark_ids[at]
        T, landmarks = placement.T_camera_world, self._map.landmarks
        points_w = landmarks.position_w[ids]
        before, self._last = self._last, (timestamp_s, T)
        covariance = pose_covariance(
            self._camera,
            T,
            points_w,
            landmarks.covariance_w[ids],
            features.px[at],
            features.sigma_px[at],
            sampled=1.0 / every,
        )
        if covariance is None:
            return None, 0.0
        distance = median_depth_m(T, points_w)
        if before is not None and timestamp_s - before[0] <= _MAX_GAP_S:
            turn, length = (
                _MOTION_S / (timestamp_s - before[0]) * of_step for of_step in motion_between(before[1], T)
            )
            camera_rad = _CAMERA_SHARE * (turn + length / distance)
            sigmas = np.sort(self._map.sigma_along_ray(ids, -T[:3, :3].T @ T[:3, 3]))
            depth_m = _DEPTH_SHARE * float(sigmas[len(sigmas) // 2]) * length
            position_m2 = (camera_rad * distance) ** 2 + depth_m**2
            covariance.flat[:21:7] += position_m2
            covariance.flat[21::7] += camera_rad**2
        variance = covariance.diagonal().tolist()
        self.image_sigma = math.sqrt(sum(variance[3:])) + math.sqrt(sum(variance[:3])) / distance
        return covariance, pose_quality(covariance, distance)


def motion_between(T_a: Floats, T_b: Floats) -> tuple[float, float]:
    """Angle in radians and length in metres of the motion between two ``T_camera_world (4, 4)``."""
    R_a, R_b = T_a[:3, :3], T_b[:3, :3]
    cosine = 0.5 * (float((R_a * R_b).sum()) - 1.0)
    way = T_b[:3, 3] @ R_b - T_a[:3, 3] @ R_a
    return math.acos(min(max(cosine, -1.0), 1.0)), math.hypot(*way.tolist())


def pose_quality(covariance: Floats, distance: float) -> float:
    """Probability that a pose is within 2 % of the scene's distance and within 2 degrees.

    Args:
        covariance: ``(6, 6)`` of ``(translation, rotation)``, metres and radians.
        distance: of the scene, metres.
    """
    position = _probability_within(covariance[:3, :3], GOOD_SHARE * max(distance, 0.0))
    return position * _probability_within(covariance[3:, 3:], GOOD_RAD)


def _probability_within(covariance: Floats, radius: float) -> float:
    """Probability that a normal vector with ``covariance (3, 3)`` is shorter than ``radius``.

    Its squared length is taken for a scaled chi-square of the same mean and variance (Satterthwaite 1946),
    whose cube root is nearly normal (Wilson and Hilferty 1931).
    """
    mean, squares = float(covariance.trace()), float((covariance * covariance).sum())
    if not mean > 0.0:
        return 1.0
    spread = 2.0 / 9.0 * squares / (mean * mean)
    z = ((radius * radius / mean) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread)
    return 0.5 * math.erfc(-z / math.sqrt(2.0))
