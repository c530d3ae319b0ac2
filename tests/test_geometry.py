# SPDX-License-Identifier: Apache-2.0
"""Rigid motion and projection, as properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from slamdepth.geometry import (
    backproject,
    invert,
    orthonormalised,
    project,
    quat_xyzw_to_rotation,
    reprojection_errors,
    rotation_angle_rad,
    rotation_to_quat_xyzw,
    se3_exp,
    skew,
    so3_exp,
    so3_log,
    transform,
    umeyama,
)
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 517.3, 516.5, 318.6, 255.3)

numbers = st.floats(-10, 10, allow_nan=False)
vectors = arrays(np.float64, 3, elements=numbers)
tangents = arrays(np.float64, 6, elements=numbers)
seeds = st.integers(0, 2**32 - 1)


def directions(seed: int) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=3)
    v /= np.linalg.norm(v)
    return v


@given(seeds, st.floats(0, np.pi - 1e-6))
def test_so3_log_undoes_exp(seed: int, angle: float) -> None:
    omega = angle * directions(seed)
    np.testing.assert_allclose(so3_log(so3_exp(omega)), omega, atol=1e-7)


@given(vectors)
def test_so3_exp_is_the_matrix_exponential(omega: np.ndarray) -> None:
    R = so3_exp(omega)
    np.testing.assert_allclose(R, expm(skew(omega)), atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9.9e-7, 1.01e-6, 1e-5, 1e-3])
def test_so3_exp_of_small_angles(angle: float) -> None:
    omega = angle * np.array([0.6, -0.0, 0.8])
    np.testing.assert_allclose(so3_exp(omega), Rotation.from_rotvec(omega).as_matrix(), rtol=0, atol=1e-15)


@given(seeds, st.floats(0, np.pi))
def test_angle_of_a_rotation(seed: int, angle: float) -> None:
    assert rotation_angle_rad(so3_exp(angle * directions(seed))) == pytest.approx(angle, abs=1e-7)


@given(tangents)
def test_inverse(xi: np.ndarray) -> None:
    T = se3_exp(xi)
    np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(invert(invert(T)), T, atol=1e-12)


def test_functions_broadcast_over_leading_axes() -> None:
    xi = np.random.default_rng(0).normal(size=(2, 5, 6))
    T = se3_exp(xi)
    assert T.shape == (2, 5, 4, 4)
    np.testing.assert_allclose(invert(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(T[1, 3], se3_exp(xi[1, 3]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(so3_log(T[..., :3, :3])[0, 2], so3_log(T[0, 2, :3, :3]))
    quat = rotation_to_quat_xyzw(T[..., :3, :3])
    assert quat.shape == (2, 5, 4)
    np.testing.assert_allclose(quat_xyzw_to_rotation(quat), T[..., :3, :3], atol=1e-12)


@given(seeds)
def test_quaternion_round_trip(seed: int) -> None:
    q = np.random.default_rng(seed).normal(size=4)
    R = quat_xyzw_to_rotation(q)  # of any length
    np.testing.assert_allclose(R, Rotation.from_quat(q).as_matrix(), atol=1e-12)
    back = rotation_to_quat_xyzw(R)
    assert back[3] >= 0
    q = q / np.linalg.norm(q)
    np.testing.assert_allclose(back, q * np.sign(q[3]), atol=1e-9)


@given(tangents, seeds)
def test_transform_composes(xi: np.ndarray, seed: int) -> None:
    T_a_b, T_b_c = se3_exp(xi), se3_exp(-0.3 * xi + 0.1)
    p = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(transform(T_a_b @ T_b_c, p), transform(T_a_b, transform(T_b_c, p)), atol=1e-9)


@given(seeds)
def test_backproject_undoes_project(seed: int) -> None:
    rng = np.random.default_rng(seed)
    px = rng.uniform((0, 0), (639, 479), size=(10, 2))
    depth = rng.uniform(0.1, 10, 10)
    again, z = project(CAMERA, backproject(CAMERA, px, depth))
    np.testing.assert_allclose(again, px, atol=1e-9)
    np.testing.assert_allclose(z, depth)


def test_reprojection_errors_are_projections_less_measurements() -> None:
    rng = np.random.default_rng(0)
    points_c, px = rng.uniform((-1, -1, 0.5), (1, 1, 4), (20, 3)), rng.uniform(0, 480, (20, 2))
    errors = reprojection_errors(CAMERA, points_c.T, px.T, 0.1)
    np.testing.assert_allclose(errors.T, project(CAMERA, points_c)[0] - px, atol=1e-9)
    behind = reprojection_errors(CAMERA, np.array([[0.1], [0.0], [-2.0]]), np.zeros((2, 1)), 0.1)
    np.testing.assert_allclose(behind[:, 0], [CAMERA.cx + CAMERA.fx, CAMERA.cy])


def test_the_optical_axis_meets_the_principal_point() -> None:
    px, z = project(CAMERA, np.array([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(px[0], [CAMERA.cx, CAMERA.cy])
    np.testing.assert_allclose(px[1], [CAMERA.cx + 0.1 * CAMERA.fx, CAMERA.cy])  # x is right
    assert z[2] < 0
    assert np.isfinite(project(CAMERA, np.zeros((1, 3)))[0]).all()


@given(seeds)
def test_orthonormalised_is_near_and_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3_exp(rng.normal(size=6))
    inexact = T.copy()
    inexact[:3, :3] += 1e-4 * rng.normal(size=(3, 3))
    fixed = orthonormalised(inexact)
    np.testing.assert_allclose(fixed[:3, :3] @ fixed[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(fixed[:3, :3]) > 0
    np.testing.assert_allclose(fixed, T, atol=1e-3)
    np.testing.assert_array_equal(fixed[:3, 3], T[:3, 3])


@given(tangents, st.floats(0.1, 10), seeds)
def test_umeyama_recovers_a_similarity(xi: np.ndarray, scale: float, seed: int) -> None:
    source = np.random.default_rng(seed).normal(size=(12, 3))
    T = se3_exp(xi)
    s, R, t = umeyama(source, scale * source @ T[:3, :3].T + T[:3, 3], with_scale=True)
    assert s == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-8)


def test_umeyama_without_scale_and_never_a_reflection() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(20, 3))
    scale, R, _ = umeyama(source, 2.0 * source, with_scale=False)
    assert scale == 1.0
    np.testing.assert_allclose(R, np.eye(3), atol=1e-12)
    _, R, _ = umeyama(source, source * [1.0, 1.0, -1.0], with_scale=True)
    assert np.linalg.det(R) == pytest.approx(1.0)
    flat = source * [1.0, 1.0, 0.0]  # a plane leaves the sign of its normal to the determinant
    _, R, _ = umeyama(flat, flat, with_scale=True)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-12)


def test_umeyama_of_one_place() -> None:
    scale, _, t = umeyama(np.zeros((3, 3)), np.ones((3, 3)), with_scale=True)
    assert scale == 1.0
    np.testing.assert_allclose(t, 1.0)
