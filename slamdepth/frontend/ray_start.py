# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame by its matches with one image, in a map whose predicted depth is not believed."""

from __future__ import annotations

import numpy as np

from slamdepth.frontend.pose import pose_from_scratch
from slamdepth.frontend.ray_pose import RaySighting, pose_with_depths
from slamdepth.frontend.wide_pose import MIN_VOTES, baseline, by_chance, from_essential
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats

_SAMPLES = 200
_ROTATION_SIGMAS = 3.0


def pose_from_rays(
    camera: Camera,
    T_reference_world: Floats,
    reference_px: Floats,
    seen: RaySighting,
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
    scratch = pose_from_scratch(camera, seen.points_w, seen.px, seed=seed, minimum=max(8, minimum // 2))
    starts = [
        None if scratch is None else scratch[0],
        from_essential(camera, T_reference_world, reference_px, seen, seed=seed),
        _from_parallax(camera, T_reference_world, reference_px, seen, seed=seed),
    ]
    poses = [pose_with_depths(camera, T, seen) for T in starts if T is not None]
    if not poses:
        return None
    best = min(poses, key=lambda pose: pose.cost)
    if np.count_nonzero(best.inliers) < max(minimum, by_chance(len(seen.px), camera, seen)):
        return None
    return best.T_camera_world, best.inliers


def _from_parallax(
    camera: Camera, T_reference_world: Floats, reference_px: Floats, seen: RaySighting, *, seed: int
) -> Floats | None:
    """Pose ``(4, 4)`` by the rotation that most matches agree with, and the motion that the others show.

    Where most matches are far, samples for an essential matrix hold too few near ones to tell its direction
    (the degeneracy of a rotating camera; Torr, Fitzgibbon and Zisserman 1999).
    """
    rng = np.random.default_rng(seed)
    K_inv = np.linalg.inv(camera.K)
    a, b = (np.column_stack([px, np.ones(len(px))]) @ K_inv.T for px in (reference_px, seen.px))
    a, b = (rays / np.linalg.norm(rays, axis=1)[:, None] for rays in (a, b))
    limit = _ROTATION_SIGMAS * seen.sigma_px / camera.fx
    if len(a) < MIN_VOTES:
        return None
    pairs = rng.integers(0, len(a), (_SAMPLES, 2))
    R = _rotations(a[pairs], b[pairs])
    turned = np.einsum("sij,nj->sni", R, a)
    is_far = np.linalg.norm(turned - b, axis=2) < limit
    best = int(np.argmax(np.count_nonzero(is_far, axis=1)))
    far, rotation = is_far[best], R[best]
    for _ in range(3):
        if np.count_nonzero(far) < MIN_VOTES:
            return None
        rotation = _rotations(a[None, far], b[None, far])[0]
        far = np.linalg.norm(a @ rotation.T - b, axis=1) < limit
    # the motion lies in the plane of the two rays of every near match
    turned = a @ rotation.T
    normal = np.cross(turned, b)
    near = np.flatnonzero(~far)
    if len(near) < MIN_VOTES:
        return None
    pairs = near[rng.integers(0, len(near), (_SAMPLES, 2))]
    t = np.cross(normal[pairs[:, 0]], normal[pairs[:, 1]])
    t /= np.maximum(np.linalg.norm(t, axis=1), 1e-12)[:, None]
    agree = np.abs(t @ normal[near].T) < limit[near]
    best = int(np.argmax(np.count_nonzero(agree, axis=1)))
    chosen = near[agree[best]]
    if len(chosen) < MIN_VOTES:
        return None
    direction = np.linalg.svd(normal[chosen])[2][2]
    # a point at finite depth moves against the motion of the camera's world: towards t
    if np.sum((b[chosen] - turned[chosen]) @ direction) < 0:
        direction = -direction
    T_camera_reference = np.eye(4)
    T_camera_reference[:3, :3], T_camera_reference[:3, 3] = rotation, direction
    agrees = far.copy()
    agrees[chosen] = True
    length = baseline(camera, T_camera_reference, T_reference_world, reference_px, agrees, seen)
    if length is None:
        return None
    T_camera_reference[:3, 3] *= length
    return np.asarray(T_camera_reference @ T_reference_world)


def _rotations(a: Floats, b: Floats) -> Floats:
    """``(S, 3, 3)`` that turn rays ``a (S, N, 3)`` into ``b``, by least squares (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(np.einsum("sni,snj->sij", b, a))
    sign = np.ones((len(a), 3))
    sign[:, 2] = np.linalg.det(U @ Vt)
    return np.asarray((U * sign[:, None]) @ Vt)
