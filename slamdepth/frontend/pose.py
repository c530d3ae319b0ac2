# SPDX-License-Identifier: Apache-2.0
"""The pose of one camera from landmarks whose depth may be uncertain.

A landmark initialised from predicted depth is certain across its ray and uncertain along it. Its
covariance is propagated to the image, so that its residual weighs fully across the
epipolar line and little along it: this is PnP for a well triangulated map, and
essentially epipolar geometry with a weak depth for a new one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.geometry import CHI2_2DOF_95, reprojection_errors, se3_exp
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


HUBER = 1.345
CELLS = 8
"""Along each side of the image: matches of one cell share their errors."""
_NEAREST_M = 0.02
_CONVERGED = 1e-5  # metres and radians: a hundredth of a pixel
_ROUGHLY_CONVERGED = 2e-4  # enough to classify outliers
_FEWEST_MATCHES = 6  # for a covariance; three determine a pose and leave no residual
_SINGULAR = 1e-9  # least eigenvalue of the Hessian scaled to a unit diagonal
_INFLATION = 3.0
_REWHITEN = 0.01  # metres and radians of motion that leave a point's covariance in the image alike


@dataclass(frozen=True)
class PoseEstimate:
    """A refined pose.

    Attributes:
        T_camera_world: ``(4, 4)``.
        inliers: ``(N,)`` bool.
        information: ``(6, 6)`` of the left perturbation (translation, rotation) of
            ``T_camera_world``.
    """

    T_camera_world: Floats
    inliers: NDArray[np.bool_]
    information: Floats


def pixel_covariance(
    camera: Camera, T_camera_world: Floats, points_c: Floats, covariance_w: Floats, sigma_px: Floats
) -> Floats:
    """``(N, 2, 2)`` covariance of where points appear, in square pixels.

    Args:
        points_c: ``(N, 3)`` camera frame; covariance_w: ``(N, 3, 3)`` world frame, m^2;
        sigma_px: ``(N,)`` measurement noise.
    """
    S = np.empty((len(points_c), 2, 2))
    S[:, 0, 0], S[:, 0, 1], S[:, 1, 1] = _pixel_covariance(
        camera, T_camera_world[:3, :3], points_c.T, covariance_w, sigma_px
    )
    S[:, 1, 0] = S[:, 0, 1]
    return S


def _pixel_covariance(
    camera: Camera, R_camera_world: Floats, points_c: Floats, covariance_w: Floats, sigma_px: Floats
) -> tuple[Floats, Floats, Floats]:
    """Elements uu, uv and vv ``(N,)`` of each symmetric covariance; ``points_c`` is ``(3, N)``.

    Written out by coordinate, as NumPy is slow at many tiny matrices.
    """
    x, y, z = points_c
    along_u = _projected_axis(camera.fx / z, x / z, R_camera_world[0], R_camera_world[2])
    along_v = _projected_axis(camera.fy / z, y / z, R_camera_world[1], R_camera_world[2])
    covariance_u = np.einsum("nij,nj->ni", covariance_w, along_u)
    covariance_v = np.einsum("nij,nj->ni", covariance_w, along_v)
    noise = sigma_px * sigma_px
    return (
        np.einsum("ni,ni->n", along_u, covariance_u) + noise,
        np.einsum("ni,ni->n", along_u, covariance_v),
        np.einsum("ni,ni->n", along_v, covariance_v) + noise,
    )


def _projected_axis(scale: Floats, slope: Floats, axis: Floats, forward: Floats) -> Floats:
    """Derivative ``(N, 3)`` of one pixel coordinate by the point: ``scale (axis - slope forward)``."""
    along = np.empty((len(scale), 3))
    for k in range(3):
        along[:, k] = scale * (axis[k] - slope * forward[k])
    return along


def refine_pose(
    camera: Camera,
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
    *,
    rounds: int = 4,
    iterations: int = 4,
    gate: float = CHI2_2DOF_95,
) -> PoseEstimate:
    """Robust Gauss-Newton on the reprojection error, whitened by every point's covariance.

    Args:
        T_camera_world: ``(4, 4)`` initial pose.
        points_w: ``(N, 3)`` m; covariance_w: ``(N, 3, 3)`` m^2.
        px: ``(N, 2)`` undistorted pixels; sigma_px: ``(N,)``.
        rounds: outliers are re-classified after each; Huber kernel in all but the last.
        gate: squared whitened residual beyond which a match is an outlier.
    """
    if (fast := loops()) is not None:
        ok, T, active, H = fast.pose.refine(
            np.array(T_camera_world),
            points_w,
            covariance_w,
            px,
            sigma_px,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            rounds,
            iterations,
            gate,
            HUBER,
            _NEAREST_M,
            (_CONVERGED, _ROUGHLY_CONVERGED),
            _REWHITEN,
        )
        if ok:
            return PoseEstimate(T, active, H)
    match = _Matches(camera, points_w.T.copy(), covariance_w, px.T.copy(), sigma_px)
    T = T_camera_world.copy()
    active = np.ones(len(points_w), dtype=bool)
    H = np.eye(6) * 1e-6
    P = match.seen_from(T)
    whitening, T_whitened = match.whitening(T, P), T
    for round_ in range(rounds):
        robust = round_ < rounds - 1
        use = np.flatnonzero(active & (P[2] > _NEAREST_M))
        if len(use) >= 4:
            part, W = match.taken(use), whitening[:, use]
            for _ in range(iterations):
                H, g = part.normal_equations(part.seen_from(T), W, robust=robust)
                step = _newton_step(H, g)
                T = se3_exp(step) @ T
                if np.abs(step).max() < (_ROUGHLY_CONVERGED if robust else _CONVERGED):
                    break
        P = match.seen_from(T)
        if np.abs(T - T_whitened).max() > _REWHITEN:
            whitening, T_whitened = match.whitening(T, P), T
        active = (P[2] > _NEAREST_M) & (match.squared_residual(P, whitening) < gate)
    return PoseEstimate(T, active, H)


def _newton_step(H: Floats, g: Floats) -> Floats:
    """``-H^-1 g`` for ``H (6, 6)``, by LAPACK directly: NumPy's checks take longer than the solution."""
    from scipy.linalg.lapack import dposv

    damped = H.copy()
    damped.flat[::7] += 1e-9 * H.trace()
    _, step, info = dposv(damped, g)
    if info != 0:
        step = np.linalg.lstsq(damped, g, rcond=None)[0]
    return np.asarray(-step, dtype=np.float64)


def pose_covariance(
    camera: Camera,
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
    *,
    sampled: float = 1.0,
) -> Floats | None:
    """Covariance of an optimised pose, from matches whose errors are alike within a part of the image.

    The inverse of the Gauss-Newton Hessian takes all errors for independent. Neighbours in the image share
    theirs: of the map, of the lens, of the shutter. So the residuals are summed within the cells of a grid,
    and the scatter of these sums is added (the cluster-robust "sandwich" estimator, Liang and Zeger 1986).
    Both see only what is not common to all matches, so the sum is inflated by a constant, measured over the
    motion of a second against true poses.

    Args:
        T_camera_world: ``(4, 4)``, optimised over these matches.
        points_w: ``(N, 3)`` m; covariance_w: ``(N, 3, 3)`` m^2.
        px: ``(N, 2)`` undistorted pixels; sigma_px: ``(N,)``.
        sampled: share of the matches that are given, evenly chosen.

    Returns:
        ``(6, 6)`` of ``(translation, rotation)`` in metres and radians, both along the axes of the world:
        the true camera centre is ``center_w + translation`` and the true ``R_world_camera`` is
        ``so3_exp(rotation) @ R_world_camera``. None where the matches do not determine the pose.
    """
    if len(points_w) < _FEWEST_MATCHES:
        return None
    H, sums = _equations_by_cell(camera, T_camera_world, points_w, covariance_w, px, sigma_px)
    # translation and rotation differ by orders of magnitude: the condition of the scaled matrix counts
    unit = 1.0 / np.sqrt(np.maximum(H.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(H * unit[:, None] * unit)
    if not values[0] > _SINGULAR:
        return None
    inverse = (vectors / values) @ vectors.T * unit[:, None] * unit
    cells = len(sums)
    scatter = sums.T @ sums * (cells / max(cells - 1.0, 1.0))
    covariance = _INFLATION * (sampled * inverse + inverse @ scatter @ inverse)
    # the left perturbation of T_camera_world moves the camera by -R_world_camera, see se3_exp
    R = np.zeros((6, 6))
    R[:3, :3] = R[3:, 3:] = T_camera_world[:3, :3].T
    return np.asarray(R @ covariance @ R.T)


def _equations_by_cell(
    camera: Camera,
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
) -> tuple[Floats, Floats]:
    """Hessian ``(6, 6)`` of all matches, and sums ``(cells, 6)`` of their gradients by cell of the image."""
    if (fast := loops()) is not None:
        found: tuple[Floats, Floats] = fast.pose.equations_by_cell(
            np.array(T_camera_world),
            points_w,
            covariance_w,
            px,
            sigma_px,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            (camera.width, camera.height),
            CELLS,
            _NEAREST_M,
        )
        return found
    match = _Matches(camera, points_w.T.copy(), covariance_w, px.T.copy(), sigma_px)
    points_c = match.seen_from(T_camera_world)
    whitening = match.whitening(T_camera_world, points_c)
    J = match.derivatives(points_c, whitening)
    r = match.residual(points_c, whitening)
    sums = _sums_by_cell(camera, match.px, J[:, 0] * r[0] + J[:, 1] * r[1])
    return J.reshape(6, -1) @ J.reshape(6, -1).T, sums


def _sums_by_cell(camera: Camera, px: Floats, values: Floats) -> Floats:
    """Sums of ``values (6, N)`` over the cells of a grid that hold any of ``px (2, N)``, ``(cells, 6)``."""
    cell = cells_of(camera, px)
    count = CELLS * CELLS
    # one weighted count for all rows: each has cells of its own
    cell_of_row = cell + count * np.arange(len(values))[:, None]
    sums = np.bincount(cell_of_row.ravel(), values.ravel(), count * len(values)).reshape(-1, count)
    return np.asarray(sums[:, np.bincount(cell, minlength=count) > 0].T)


def cells_of(camera: Camera, px: Floats) -> Ints:
    """Numbers ``(N,)`` of the :data:`CELLS` x :data:`CELLS` cells of the image that ``px (2, N)`` lie in."""
    column, row = (
        np.minimum(np.maximum(of_one * (CELLS / size), 0.0), CELLS - 1.0).astype(np.int64)
        for of_one, size in zip(px, (camera.width, camera.height), strict=True)
    )
    return np.asarray(CELLS * row + column, dtype=np.int64)


class _Matches:
    """Points and their measurements, one row per coordinate."""

    def __init__(
        self, camera: Camera, points_w: Floats, covariance_w: Floats, px: Floats, sigma_px: Floats
    ) -> None:
        self.camera, self.points_w, self.covariance_w = camera, points_w, covariance_w
        self.px, self.sigma_px = px, sigma_px

    def taken(self, index: NDArray[np.int64]) -> _Matches:
        """Only the matches ``index``."""
        return _Matches(
            self.camera,
            self.points_w[:, index],
            self.covariance_w[index],
            self.px[:, index],
            self.sigma_px[index],
        )

    def seen_from(self, T_camera_world: Floats) -> Floats:
        """Points ``(3, N)`` in the camera frame."""
        return T_camera_world[:3, :3] @ self.points_w + T_camera_world[:3, 3:]

    def whitening(self, T_camera_world: Floats, points_c: Floats) -> Floats:
        """Lower triangular W with W S W^T = I: its elements 00, 10 and 11 as ``(3, N)``.

        They are meaningless for points that are not in front of the camera.
        """
        ahead = points_c.copy()
        ahead[2] = np.maximum(ahead[2], _NEAREST_M)
        S00, S01, S11 = _pixel_covariance(
            self.camera, T_camera_world[:3, :3], ahead, self.covariance_w, self.sigma_px
        )
        a = 1.0 / np.sqrt(S00)
        b = S01 * a
        W = np.empty((3, len(a)))
        W[0] = a
        W[2] = c = 1.0 / np.sqrt(np.maximum(S11 - b * b, 1e-12))
        W[1] = -b * a * c
        return W

    def residual(self, points_c: Floats, whitening: Floats) -> Floats:
        """Whitened residuals ``(2, N)``."""
        r = reprojection_errors(self.camera, points_c, self.px, _NEAREST_M)
        du, dv = r
        dv *= whitening[2]
        dv += whitening[1] * du
        du *= whitening[0]
        return r

    def squared_residual(self, points_c: Floats, whitening: Floats) -> Floats:
        """Squared whitened residuals ``(N,)``; chi-square with two degrees of freedom for inliers."""
        ru, rv = self.residual(points_c, whitening)
        return np.asarray(ru * ru + rv * rv)

    def normal_equations(self, points_c: Floats, whitening: Floats, *, robust: bool) -> tuple[Floats, Floats]:
        """``(6, 6)`` and ``(6,)`` for the left perturbation (translation, rotation)."""
        r = self.residual(points_c, whitening)
        J = self.derivatives(points_c, whitening)
        Jw = J
        if robust:
            Jw = J * (HUBER / np.maximum(np.sqrt(r[0] * r[0] + r[1] * r[1]), HUBER))
        return Jw.reshape(6, -1) @ J.reshape(6, -1).T, Jw.reshape(6, -1) @ r.ravel()

    def derivatives(self, points_c: Floats, whitening: Floats) -> Floats:
        """``(6, 2, N)`` of the whitened residuals by the left perturbation (translation, rotation)."""
        camera = self.camera
        x, y = points_c[:2]
        z = np.maximum(points_c[2], _NEAREST_M)
        J = np.empty((6, 2, len(z)))
        right, down, forward = J[0], J[1, 1], J[2]  # the first coordinate does not depend on y: J[1, 0] is 0
        np.multiply(whitening[:2], camera.fx / z, out=right)
        J[1, 0] = 0.0
        np.multiply(whitening[2], camera.fy / z, out=down)
        np.multiply(right, -x / z, out=forward)
        forward[1] -= down * (y / z)
        # d(omega x p)/d omega = -[p]_x
        np.multiply(forward, y, out=J[3])
        J[3, 1] -= down * z
        np.multiply(right, z, out=J[4])
        J[4] -= forward * x
        np.multiply(right, -y, out=J[5])
        J[5, 1] += down * x
        return J


def corner_deviation_px(
    camera: Camera, T_camera_world: Floats, points_w: Floats, information: Floats
) -> float:
    """How far, in pixels, an uncertain pose misplaces points in that corner of the image where it errs most.

    Landmarks in one half of the image tell a turn from a shift badly; in the other half the two differ.

    Args:
        T_camera_world: ``(4, 4)``; points_w: ``(N, 3)`` m that it was estimated from. Points of their median
            depth are considered.
        information: ``(6, 6)``, see :class:`PoseEstimate`.

    Returns:
        The largest standard deviation in any direction; infinity where the pose is not determined.
    """
    from scipy.linalg.lapack import dposv

    z = points_w @ T_camera_world[2, :3] + T_camera_world[2, 3]
    middle = float(np.partition(z, len(z) // 2)[len(z) // 2]) if len(z) else 0.0
    if middle <= _NEAREST_M:
        return np.inf
    along = _corner_derivatives(camera).copy()
    along[:3] /= middle
    _, weighted, info = dposv(information, along)
    if info != 0:
        return np.inf
    S = along.T @ weighted
    S00, S01, S11 = S.diagonal()[:4], S.diagonal(4), S.diagonal()[4:]
    half_trace = 0.5 * (S00 + S11)
    largest = float((half_trace + np.sqrt(np.maximum(half_trace**2 - (S00 * S11 - S01**2), 0.0))).max())
    return float(np.sqrt(largest)) if largest > 0.0 else np.inf


@lru_cache(maxsize=4)
def _corner_derivatives(camera: Camera) -> Floats:
    """Derivatives ``(6, 8)`` of the pixels of points one metre away, u of the four corners and then v."""
    u, v = (axis.ravel() for axis in np.meshgrid([0.0, camera.width - 1.0], [0.0, camera.height - 1.0]))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    zero, one = np.zeros(4), np.ones(4)
    along_u = camera.fx * np.stack([one, zero, -x, -x * y, 1.0 + x * x, -y])
    along_v = camera.fy * np.stack([zero, one, -y, -1.0 - y * y, x * y, x])
    return np.asarray(np.hstack([along_u, along_v]))


def usac_params(seed: int, threshold_px: float, *, confidence: float, iterations: int) -> Any:
    """OpenCV's USAC with uniform samples, local optimisation and MSAC score."""
    import cv2

    params = cv2.UsacParams()
    params.randomGeneratorState = seed
    params.confidence = confidence
    params.maxIterations = iterations
    params.threshold = threshold_px
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    return params


def pose_from_scratch(
    camera: Camera, points_w: Floats, px: Floats, *, seed: int, threshold_px: float = 6.0, minimum: int = 12
) -> tuple[Floats, NDArray[np.bool_]] | None:
    """PnP without an initial pose, by RANSAC (OpenCV's USAC with local optimisation and MSAC score).

    Returns:
        ``(T_camera_world, inliers (N,))``, or None where no pose has ``minimum`` inliers.
    """
    import cv2

    if len(points_w) < minimum:
        return None
    params = usac_params(seed, threshold_px, confidence=0.999, iterations=1000)
    ok, _, rvec, tvec, index = cv2.solvePnPRansac(
        np.ascontiguousarray(points_w)[:, None],
        np.ascontiguousarray(px)[:, None],
        camera.K,
        None,
        params=params,
    )
    if not ok or index is None or len(index) < minimum:
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rvec)[0]
    T[:3, 3] = np.ravel(tvec)
    if not np.isfinite(T).all():
        return None
    inliers = np.zeros(len(points_w), dtype=bool)
    inliers[np.ravel(index)] = True
    return T, inliers
