# SPDX-License-Identifier: Apache-2.0
"""The pose graph of keyframes: odometry and loops brought into agreement, false loops out.

Loops are weighed by graduated non-convexity with truncated least squares (Yang et al.,
"Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020): it starts from the
convex problem, so that a true loop that closes a large drift is not taken for a false
one, as a kernel that trusts the first estimate would.

The only adapter to GTSAM's tangents is here: they are rotation, translation, logarithm
of scale. A Similarity3 (R, t, s) maps p to s (R p + t), so its t is a position divided
by its scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.geometry import orthonormalised
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Holds the fixed keyframe where it is, yet leaves the normal equations well conditioned.
_GAUGE_SIGMA = 1e-4
# 99 % of true loops have a smaller squared Mahalanobis error (chi-square, 6 and 7 degrees).
_INLIER_CHI2 = {6: 16.81, 7: 18.48}


@dataclass(frozen=True)
class Edge:
    """What was measured between two keyframes.

    Attributes:
        i, j: indices of the keyframes.
        T_i_j: ``(4, 4)`` pose of camera j in camera i, translation in metres of keyframe i.
        scale_i_j: metres of keyframe i that a metre of keyframe j is;
            ``p_i = scale_i_j * R_i_j @ p_j + t_i_j``. Not used without scales.
        sigmas: standard deviations of rotation in radians, translation in metres and
            the natural logarithm of the scale.
        is_loop: a loop may be false and is weighed robustly; other edges are believed.
    """

    i: int
    j: int
    T_i_j: Floats
    scale_i_j: float = 1.0
    sigmas: tuple[float, float, float] = (0.01, 0.01, 0.01)
    is_loop: bool = False


@dataclass(frozen=True)
class PoseGraphResult:
    """Keyframes after optimisation.

    Attributes:
        T_world_camera: ``(K, 4, 4)`` rigid poses.
        scales: ``(K,)`` factor that turns the metres of a keyframe into those of the
            world; its depths are to be multiplied by it. All 1 without scales.
        weights: ``(E,)`` from 0, a false loop, to 1; 1 for odometry.
        is_inlier: ``(E,)`` True where the weight is above one half.
        error_before, error_after: half the sum of squared whitened errors over the inlier
            edges, before and after.
        iterations: Levenberg-Marquardt steps of the last solution.
    """

    T_world_camera: Floats
    scales: Floats
    weights: Floats
    is_inlier: NDArray[np.bool_]
    error_before: float
    error_after: float
    iterations: int


def optimise_pose_graph(
    T_world_camera: Floats,
    edges: Sequence[Edge],
    *,
    fixed: int = 0,
    with_scale: bool = False,
    scales: Floats | None = None,
) -> PoseGraphResult:
    """Poses (and scales) of keyframes that agree best with what was measured between them.

    Args:
        T_world_camera: ``(K, 4, 4)`` present estimate.
        edges: measurements; those that are not loops must connect all keyframes.
        fixed: the keyframe that stays where it is, at its scale.
        with_scale: let each keyframe have a scale of its own (Sim(3)); without, SE(3).
        scales: ``(K,)`` present scales, 1 if None; only with ``with_scale``.

    Raises:
        TrackingError: the graph is empty, not connected without its loops, refers to
            keyframes that do not exist, or holds a value that is not finite.
    """
    import gtsam

    poses = _checked(T_world_camera, edges, fixed)
    count = len(poses)
    start_scales = np.ones(count) if scales is None else np.asarray(scales, dtype=np.float64)
    if start_scales.shape != (count,) or not np.all(np.isfinite(start_scales)) or np.any(start_scales <= 0):
        raise TrackingError(f"pose graph: scales must be ({count},) positive finite numbers")
    if scales is not None and not with_scale:
        raise TrackingError("pose graph: scales were given to an optimisation without scale")

    initial = gtsam.Values()
    for k in range(count):
        initial.insert(k, _to_gtsam(poses[k], start_scales[k], with_scale))
    factors = [_factor(edge, with_scale) for edge in edges]
    gauge = _gauge(fixed, initial, with_scale)

    weights = np.ones(len(edges))
    loops = [e for e, edge in enumerate(edges) if edge.is_loop]
    if loops:
        weights[loops] = _loop_weights(factors, loops, gauge, initial, with_scale)
    inlier = weights > 0.5
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(gauge)
    for factor, keep in zip(factors, inlier, strict=True):
        if keep:
            graph.push_back(factor)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, initial, _lm_parameters())
    solution = optimiser.optimize()
    error_after = float(graph.error(solution))
    if not np.isfinite(error_after):
        raise TrackingError("pose graph: the optimisation diverged; check the edges' sigmas")
    solved, solved_scales = _from_gtsam(solution, count, with_scale)
    return PoseGraphResult(
        T_world_camera=solved,
        scales=solved_scales,
        weights=weights,
        is_inlier=inlier,
        error_before=float(graph.error(initial)),
        error_after=error_after,
        iterations=int(optimiser.iterations()),
    )


def _loop_weights(
    factors: Sequence[Any], loops: Sequence[int], gauge: Any, initial: Any, with_scale: bool
) -> Floats:
    """Weight of each loop by graduated non-convexity; the other edges are known inliers."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    graph.push_back(gauge)
    is_loop = set(loops)
    parameters = gtsam.GncLMParams(_lm_parameters(relative_tolerance=1e-4))
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers([k for k in range(graph.size()) if k not in is_loop])
    optimiser = gtsam.GncLMOptimizer(graph, initial, parameters)
    # GTSAM's error of a factor is half its squared Mahalanobis distance.
    optimiser.setInlierCostThresholds(0.5 * _INLIER_CHI2[7 if with_scale else 6])
    optimiser.optimize()
    return np.asarray(optimiser.getWeights(), dtype=np.float64)[list(loops)]


def _lm_parameters(relative_tolerance: float = 1e-9) -> Any:
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setAbsoluteErrorTol(1e-12)
    return parameters


def _factor(edge: Edge, with_scale: bool) -> Any:
    import gtsam

    rotation, translation, log_scale = edge.sigmas
    measured = _to_gtsam(orthonormalised(edge.T_i_j), edge.scale_i_j, with_scale)
    if with_scale:
        # The error lies in the frame, and so in the metres, of keyframe j.
        sigmas = [rotation] * 3 + [translation / edge.scale_i_j] * 3 + [log_scale]
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
        return gtsam.BetweenFactorSimilarity3(edge.i, edge.j, measured, noise)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [translation] * 3))
    return gtsam.BetweenFactorPose3(edge.i, edge.j, measured, noise)


def _gauge(fixed: int, initial: Any, with_scale: bool) -> Any:
    import gtsam

    noise = gtsam.noiseModel.Isotropic.Sigma(7 if with_scale else 6, _GAUGE_SIGMA)
    if with_scale:
        return gtsam.PriorFactorSimilarity3(fixed, initial.atSimilarity3(fixed), noise)
    return gtsam.PriorFactorPose3(fixed, initial.atPose3(fixed), noise)


def _to_gtsam(T: Floats, scale: float, with_scale: bool) -> Any:
    import gtsam

    if with_scale:
        return gtsam.Similarity3(gtsam.Rot3(T[:3, :3]), T[:3, 3] / scale, scale)
    return gtsam.Pose3(T)


def _from_gtsam(values: Any, count: int, with_scale: bool) -> tuple[Floats, Floats]:
    T, scales = np.tile(np.eye(4), (count, 1, 1)), np.ones(count)
    for k in range(count):
        if with_scale:
            similarity = values.atSimilarity3(k)
            scales[k] = similarity.scale()
            T[k, :3, :3] = similarity.rotation().matrix()
            T[k, :3, 3] = similarity.translation() * scales[k]
        else:
            T[k] = values.atPose3(k).matrix()
    return orthonormalised(T), scales


def _checked(T_world_camera: Floats, edges: Sequence[Edge], fixed: int) -> Floats:
    """The poses as float64 with exact rotations, once poses and edges are known to be sound."""
    poses = np.asarray(T_world_camera, dtype=np.float64)
    count = len(poses)
    if count == 0 or poses.shape != (count, 4, 4):
        raise TrackingError(f"pose graph: poses must be (K, 4, 4) with K > 0, got {poses.shape}")
    if not np.all(np.isfinite(poses)):
        bad = int(np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))[0])
        raise TrackingError(f"pose graph: the pose of keyframe {bad} is not finite")
    if not 0 <= fixed < count:
        raise TrackingError(f"pose graph: fixed keyframe {fixed} does not exist; there are {count}")
    for e, edge in enumerate(edges):
        name = f"pose graph: edge {e} ({edge.i} -> {edge.j})"
        if not (0 <= edge.i < count and 0 <= edge.j < count) or edge.i == edge.j:
            raise TrackingError(f"{name} must join two of the {count} keyframes")
        if np.shape(edge.T_i_j) != (4, 4) or not np.all(np.isfinite(edge.T_i_j)):
            raise TrackingError(f"{name}: its pose must be (4, 4) and finite")
        positive = (edge.scale_i_j, *edge.sigmas)
        if len(edge.sigmas) != 3 or not all(np.isfinite(v) and v > 0 for v in positive):
            raise TrackingError(f"{name}: its scale and its three sigmas must be positive and finite")
    _check_connected(count, edges)
    return orthonormalised(poses)


def _check_connected(count: int, edges: Sequence[Edge]) -> None:
    """Loops do not count: one that is rejected must not leave a part of the graph adrift."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.array([(edge.i, edge.j) for edge in edges if not edge.is_loop], dtype=np.intp).reshape(-1, 2)
    adjacency = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    parts, label = connected_components(adjacency, directed=False)
    if parts > 1:
        adrift = int(np.flatnonzero(label != label[0])[0])
        raise TrackingError(
            f"pose graph: keyframe {adrift} is not connected to keyframe 0 by odometry edges "
            f"({parts} parts); add an edge that is no loop"
        )
