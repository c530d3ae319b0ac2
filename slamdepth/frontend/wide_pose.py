# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame far from its reference, from landmarks whose predicted depth may be grossly wrong.

A network trained indoors places a city at three metres. A majority of such points fits a camera that only
turned: their depth says that a step would have moved them, and they did not move. The essential matrix does
not depend on depth. Its direction of motion is taken where it explains significantly more matches than PnP,
its length is that by which most landmarks with parallax have their depth. A landmark that is then seen much
nearer to infinity than it was predicted is a direction: its covariance along the ray no longer counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.pose import (
    PoseEstimate,
    pixel_covariance,
    pose_from_scratch,
    refine_pose,
    usac_params,
)
from slamdepth.geometry import CHI2_2DOF_95, invert, project, transform
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats

_CONTRADICTS = 2.0  # deviations of its inverse depth by which a landmark is seen nearer to infinity
_RELEASED = 1e4  # factor on its covariance then
_RELEASES = 2
_SIGNIFICANT = 5.0  # deviations above what chance explains
NEAREST_M = 0.02
_FAR = 1e3
_MIN_PARALLAX = 3.0  # deviations of a keypoint, of a match that says something of the scale
MIN_VOTES = 8
_EPIPOLAR_PX = 2.0


@dataclass(frozen=True)
class Sighting:
    """Landmarks and where a frame sees them.

    Attributes:
        points_w: ``(N, 3)`` m; covariance_w: ``(N, 3, 3)`` m^2.
        px: ``(N, 2)`` undistorted pixels; sigma_px: ``(N,)``.
    """

    points_w: Floats
    covariance_w: Floats
    px: Floats
    sigma_px: Floats


def directional_pose(
    camera: Camera, T_camera_world: Floats, seen: Sighting, *, rounds: int = 3
) -> tuple[PoseEstimate, Bools]:
    """Refine a pose; landmarks whose parallax contradicts their depth count as directions.

    Args:
        T_camera_world: ``(4, 4)`` initial pose.
        rounds: of outlier classification, see :func:`slamdepth.frontend.pose.refine_pose`.

    Returns:
        The pose, and which landmarks ``(N,)`` were directions.
    """
    estimate, T = None, T_camera_world
    for _ in range(_RELEASES):
        released = _is_farther(camera, T, seen)
        factor = np.where(released, _RELEASED, 1.0)[:, None, None]
        estimate = refine_pose(
            camera, T, seen.points_w, seen.covariance_w * factor, seen.px, seen.sigma_px, rounds=rounds
        )
        T = estimate.T_camera_world
    assert estimate is not None
    return estimate, released


def _is_farther(camera: Camera, T_camera_world: Floats, seen: Sighting) -> Bools:
    """Landmarks ``(N,)`` that are seen nearer to infinity than their deviation allows.

    Only those whose own uncertainty covers infinity or nearly so, which no triangulated one's does: the
    first-order covariance in the image is that of the inverse depth.
    """
    points_c = transform(T_camera_world, seen.points_w)
    ahead = points_c[:, 2] > NEAREST_M
    points_c[~ahead] = [0.0, 0.0, 1.0]
    px, _ = project(camera, points_c)
    P = pixel_covariance(camera, T_camera_world, points_c, seen.covariance_w, np.zeros(len(px)))
    variance, axis = np.linalg.eigh(P)
    along = np.einsum("ni,ni->n", seen.px - px, axis[:, :, 1])
    across = np.einsum("ni,ni->n", seen.px - px, axis[:, :, 0])
    noise = seen.sigma_px**2
    is_off = along**2 > _CONTRADICTS**2 * (variance[:, 1] + noise)
    on_line = across**2 < CHI2_2DOF_95 * (variance[:, 0] + noise)
    # a point far along the landmark's own ray, the longest axis of its covariance, shows where infinity is
    ray_c = np.linalg.eigh(seen.covariance_w)[1][:, :, 2] @ T_camera_world[:3, :3].T
    ray_c *= np.where(np.einsum("ni,ni->n", ray_c, points_c) < 0, -1.0, 1.0)[:, None]
    far_c = points_c + _FAR * ray_c
    is_beyond = far_c[:, 2] > NEAREST_M
    far_c[~is_beyond] = [0.0, 0.0, 1.0]
    to_infinity, to_seen = project(camera, far_c)[0] - px, seen.px - px
    is_farther = np.einsum("ni,ni->n", to_infinity, to_seen) > 0
    reach_px = 1.1 * np.linalg.norm(to_infinity, axis=1) + 3.0 * seen.sigma_px
    is_short = np.linalg.norm(to_seen, axis=1) < reach_px
    return np.asarray(ahead & is_beyond & is_off & on_line & is_farther & is_short)


def pose_from_reference(
    camera: Camera,
    T_reference_world: Floats,
    reference_px: Floats,
    seen: Sighting,
    *,
    seed: int,
    minimum: int,
) -> tuple[Floats, Bools] | None:
    """Place a frame by its matches with one reference image, without a guess of where it is.

    Args:
        T_reference_world: ``(4, 4)`` pose of the reference.
        reference_px: ``(N, 2)`` undistorted pixels of the matches there.
        seen: the same landmarks in the frame.
        minimum: landmarks that must agree.

    Returns:
        ``(T_camera_world, inliers (N,))``, or None where no pose has so many.
    """
    best: PoseEstimate | None = None
    scratch = pose_from_scratch(camera, seen.points_w, seen.px, seed=seed, minimum=max(8, minimum // 2))
    if scratch is not None:
        best, _ = directional_pose(camera, scratch[0], seen)
    epipolar = from_essential(camera, T_reference_world, reference_px, seen, seed=seed)
    if epipolar is not None:
        other, _ = directional_pose(camera, epipolar, seen)
        if best is None or _explains_more(other, best, camera, seen):
            best = other
    if best is None or np.count_nonzero(best.inliers) < max(minimum, by_chance(len(seen.px), camera, seen)):
        return None
    return best.T_camera_world, best.inliers


def _explains_more(other: PoseEstimate, best: PoseEstimate, camera: Camera, seen: Sighting) -> bool:
    """Whether the epipolar pose explains more matches than chance would of those that PnP leaves."""
    left = int(np.count_nonzero(~best.inliers))
    gained = int(np.count_nonzero(other.inliers)) - int(np.count_nonzero(best.inliers))
    return gained > by_chance(left, camera, seen)


def by_chance(matches: int, camera: Camera, seen: Sighting) -> float:
    """Matches of unrelated images that would lie on their epipolar lines, and five deviations more."""
    share = 2.0 * np.sqrt(CHI2_2DOF_95) * float(np.median(seen.sigma_px)) / camera.height
    mean = matches * share
    return float(mean + _SIGNIFICANT * np.sqrt(mean) + _SIGNIFICANT)


def from_essential(
    camera: Camera, T_reference_world: Floats, reference_px: Floats, seen: Sighting, *, seed: int
) -> Floats | None:
    """Pose ``(4, 4)`` by the essential matrix, the length of its step from the landmarks' depths."""
    import cv2

    if len(seen.px) < 8:
        return None
    a, b = np.ascontiguousarray(reference_px), np.ascontiguousarray(seen.px)
    params = usac_params(seed, _EPIPOLAR_PX, confidence=0.9999, iterations=2000)
    E, mask = cv2.findEssentialMat(a, b, camera.K, camera.K, None, None, params)
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    agree = mask.ravel() > 0
    if np.count_nonzero(agree) < 8:
        return None
    _, R, t, _ = cv2.recoverPose(E, a[agree], b[agree], camera.K)
    T_camera_reference = np.eye(4)
    T_camera_reference[:3, :3], T_camera_reference[:3, 3] = R, t.ravel()
    length = baseline(camera, T_camera_reference, T_reference_world, a, agree, seen)
    if length is None:
        return None
    T_camera_reference[:3, 3] *= length
    return np.asarray(T_camera_reference @ T_reference_world)


def baseline(
    camera: Camera,
    T_camera_reference: Floats,
    T_reference_world: Floats,
    reference_px: Floats,
    agree: Bools,
    seen: Sighting,
) -> float | None:
    """Length of a step of unit length by which most landmarks have the depth that the map gives them.

    The votes ``depth in the map / triangulated depth`` are combined by the mode of their density, each as
    wide as its own deviation: landmarks placed wrong by any factor spread, the others agree.
    """
    R, t = T_camera_reference[:3, :3], T_camera_reference[:3, 3]
    K = camera.K
    ray = np.column_stack([reference_px, np.ones(len(reference_px))]) @ np.linalg.inv(K).T
    turned = ray @ R.T
    # depth z in the reference by least squares of  z K R ray + K t = w (u, v, 1)
    u = (seen.px - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]]
    rows = turned[:, :2] - u * turned[:, 2:]
    offset = u * t[2] - t[:2]
    z = np.einsum("ni,ni->n", rows, offset) / np.maximum(np.einsum("ni,ni->n", rows, rows), 1e-12)
    parallax_px = np.linalg.norm(rows, axis=1) * K[0, 0] / np.maximum(np.abs(turned[:, 2]), 1e-3)
    z_map = transform(T_reference_world, seen.points_w)[:, 2]
    offset_w = seen.points_w - invert(T_reference_world)[:3, 3]
    distance = np.maximum(np.linalg.norm(offset_w, axis=1), 1e-6)
    along = offset_w / distance[:, None]
    sigma_map = np.sqrt(np.einsum("ni,nij,nj->n", along, seen.covariance_w, along)) / distance
    votes = agree & (z > 0) & (z_map > NEAREST_M) & (parallax_px > _MIN_PARALLAX * seen.sigma_px)
    if np.count_nonzero(votes) < MIN_VOTES:
        return None
    log = np.log(z_map[votes] / z[votes])
    sigma = np.sqrt(sigma_map[votes] ** 2 + (seen.sigma_px[votes] / parallax_px[votes]) ** 2 + 0.03**2)
    density = (np.exp(-0.5 * ((log[:, None] - log[None]) / sigma) ** 2) / sigma).sum(axis=1)
    return float(np.exp(log[int(np.argmax(density))]))
