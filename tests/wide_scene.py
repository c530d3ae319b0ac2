# SPDX-License-Identifier: Apache-2.0
"""A large step on a terrace: a parapet that is predicted well, and a city predicted at three metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.frontend.wide_pose import Sighting
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.tracking.local_mapper import ray_covariance
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)
STEP = np.array([0.35, -0.05, 0.1, 0.02, -0.12, 0.03])
SIGMA_LOG = 0.3


def errors(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two ``T_camera_world``."""
    D = invert(estimate) @ truth
    return float(np.linalg.norm(D[:3, 3])), float(np.degrees(rotation_angle_rad(D[:3, :3])))


def terrace(near: int, far: int, seed: int = 0) -> tuple[np.ndarray, Sighting, np.ndarray]:
    """A parapet that is predicted well and a city that is predicted three metres away.

    Returns:
        Pixels ``(N, 2)`` in the reference, which is the origin; the landmarks as seen after the step; its
        true pose.
    """
    rng = np.random.default_rng(seed)
    n = near + far
    reference_px = rng.uniform((150, 30), (610, 450), (n, 2))
    true_m = np.concatenate([rng.uniform(1.5, 3.0, near), rng.uniform(80.0, 400.0, far)])
    predicted_m = np.concatenate([true_m[:near] * np.exp(0.05 * rng.normal(size=near)), np.full(far, 3.0)])
    T = se3_exp(STEP)
    px, _ = project(CAMERA, transform(T, backproject(CAMERA, reference_px, true_m)))
    px += 0.5 * rng.normal(size=px.shape)
    points = backproject(CAMERA, reference_px, predicted_m)
    covariance = ray_covariance(CAMERA, reference_px, points, np.full(n, SIGMA_LOG), np.ones(n))
    return reference_px, Sighting(points, covariance, px, np.ones(n)), T


def elsewhere(seen: Sighting) -> Sighting:
    """The landmarks, matched with an image of another place."""
    px = np.random.default_rng(1).uniform((0, 0), (640, 480), seen.px.shape)
    return replace(seen, px=px)


def half_wrong(seen: Sighting) -> tuple[Sighting, np.ndarray]:
    """The landmarks with half of their matches wrong, and which are ``(N,)``."""
    rng = np.random.default_rng(1)
    wrong = rng.random(len(seen.px)) < 0.5
    px = np.where(wrong[:, None], rng.uniform((0, 0), (640, 480), seen.px.shape), seen.px)
    return replace(seen, px=px), wrong
