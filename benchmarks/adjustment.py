# SPDX-License-Identifier: Apache-2.0
"""Measure the final adjustment of maps of any length, made up with exact truth.

    python -m benchmarks.adjustment --keyframes 100,200,400,1000,2000

A camera walks twice round a corridor whose length grows with the number of keyframes; each sees some 400
points with pixel noise. The start has drifted as odometry drifts, and is closed as a pose graph closes it.
Where both are affordable a map is adjusted twice: with the cameras' equations factorised, and by conjugate
gradients as beyond 400 keyframes. One line each: steps, processor time, peak memory of the process so far,
and the error of the poses before and after.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks.command import errors_in_one_line, parser_of
from benchmarks.markdown import markdown_table
from benchmarks.record import environment, write_benchmark
from benchmarks.worker import memory_mib
from slamdepth.backend import camera_system
from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.geometry import invert, project, se3_exp, so3_exp, transform, umeyama
from slamdepth.thread_limits import single_threaded
from slamdepth.types import Camera
from slamdepth.typing import Floats

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
_STEP_M = 0.25  # between keyframes
_NOISE_PX = 0.7
_SIGMA_LOG = 0.05  # of depth
_FARTHEST_M = 4.0
_SEEN_SHARE = 0.55  # of what is in view
_STEPS = (3, 5)
_BOTH_UP_TO = 600  # keyframes
_DRIFT = np.array([0.004, 0.004, 0.004, 0.001, 0.001, 0.001])  # metres and radians per keyframe


@dataclass(frozen=True)
class Figures:
    """One adjustment.

    Attributes:
        solved: how the cameras' equations were solved.
        before_m, after_m: RMS error of the camera centres, aligned by a similarity.
        seconds: of the processor.
        peak_mib: of the process so far.
    """

    keyframes: int
    points: int
    observations: int
    solved: str
    before_m: float
    after_m: float
    steps: int
    seconds: float
    peak_mib: float


def corridor(keyframes: int, *, points: int = 500, seed: int = 0) -> tuple[BundleProblem, Floats]:
    """A map with drift, and the true poses ``(K, 4, 4)``, camera from world.

    Args:
        keyframes: ``K``, over two laps round the corridor; the second sees the points of the first.
        points: per metre of corridor.
    """
    rng = np.random.default_rng(seed)
    per_lap = -(-keyframes // 2)
    radius = per_lap * _STEP_M / (2 * np.pi)
    T = invert(_walk(keyframes, per_lap, radius, rng))
    X, angle = _walls(int(points * per_lap * _STEP_M), radius, rng)
    order = np.argsort(angle)
    X, angle = X[order], angle[order]
    obs_camera, obs_point, px = [], [], []
    reach = _FARTHEST_M / radius
    for k in range(keyframes):
        middle = 2 * np.pi * (k % per_lap) / per_lap
        near = np.flatnonzero((angle - middle + np.pi / 50) % (2 * np.pi) < reach + np.pi / 50)
        u, z = project(CAMERA, transform(T[k], X[near]))
        inside = (z > 0.3) & (z < _FARTHEST_M) & (u > 0).all(axis=1) & (u < (639, 479)).all(axis=1)
        inside &= rng.random(len(near)) < _SEEN_SHARE
        obs_camera.append(np.full(np.count_nonzero(inside), k))
        obs_point.append(near[inside])
        px.append(u[inside] + _NOISE_PX * rng.normal(size=(np.count_nonzero(inside), 2)))
    cameras = np.concatenate(obs_camera)
    used, seen = np.unique(np.concatenate(obs_point), return_inverse=True)
    start = _drifted(T, per_lap, rng)
    creating = np.unique(seen, return_index=True)[1]  # a point is created by the first camera that sees it
    first = cameras[creating]
    X_c = np.einsum("nij,nj->ni", T[first, :3, :3], X[used]) + T[first, :3, 3]
    X_c *= np.exp(_SIGMA_LOG * rng.normal(size=(len(used), 1)))
    T_world_first = invert(start)[first]
    log_depth = np.full(len(seen), np.nan)
    log_depth[creating] = np.log(X_c[:, 2])
    return BundleProblem(
        camera=CAMERA,
        T_camera_world=start,
        fixed=np.arange(keyframes) == 0,
        points_w=np.einsum("nij,nj->ni", T_world_first[:, :3, :3], X_c) + T_world_first[:, :3, 3],
        obs_camera=cameras,
        obs_point=seen,
        px=np.concatenate(px),
        sigma_px=np.ones(len(seen)),
        log_depth=log_depth,
        sigma_log=np.full(len(seen), _SIGMA_LOG),
        sigma_scale=0.1,
    ), T


def _walk(keyframes: int, per_lap: int, radius: float, rng: np.random.Generator) -> Floats:
    """Poses ``(K, 4, 4)``, world from camera, along the corridor, looking ahead and a little aside."""
    angle = 2 * np.pi * np.arange(keyframes) / per_lap
    T = np.tile(np.eye(4), (keyframes, 1, 1))
    # at an angle a the corridor leads towards (cos a, 0, -sin a) from its centre at the origin
    T[:, :3, 3] = radius * np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
    turned = np.zeros((keyframes, 3))
    turned[:, 1] = angle + np.pi / 2 + 0.3 * np.sin(0.37 * np.arange(keyframes))
    T[:, :3, :3] = so3_exp(turned)
    T[:, :3, 3] += 0.1 * rng.normal(size=(keyframes, 3))
    return T


def _walls(count: int, radius: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Points ``(N, 3)`` of both walls, floor and ceiling, and their angles ``(N,)`` along the corridor."""
    angle = rng.uniform(0, 2 * np.pi, count)
    side, up = rng.uniform(-1.2, 1.2, count), rng.uniform(-1.1, 1.1, count)
    on = rng.integers(0, 4, count)
    side = np.where(on == 0, -1.2, np.where(on == 1, 1.2, side))
    up = np.where(on == 2, -1.1, np.where(on == 3, 1.1, up))
    out = radius + side
    return np.stack([out * np.sin(angle), up, out * np.cos(angle)], axis=1), angle


def _drifted(T: Floats, per_lap: int, rng: np.random.Generator) -> Floats:
    """Poses as odometry has them once a pose graph has closed each lap: what is left is spread along it."""
    walked = np.cumsum(_DRIFT * rng.normal(size=(len(T), 6)), axis=0)
    along = np.arange(len(T))
    ends = np.concatenate([np.arange(0, len(T), per_lap), [len(T) - 1]])
    walked -= np.stack([np.interp(along, ends, column[ends]) for column in walked.T], axis=1)
    return np.asarray(se3_exp(walked) @ T)


def position_rms_m(T: Floats, T_true: Floats) -> float:
    """RMS distance of camera centres once the trajectories are aligned by a similarity."""
    found, true = invert(T)[:, :3, 3], invert(T_true)[:, :3, 3]
    scale, R, t = umeyama(found, true, True)
    return float(np.sqrt(np.mean(np.sum((scale * found @ R.T + t - true) ** 2, axis=1))))


def measure(problem: BundleProblem, T_true: Floats, *, iterative: bool) -> Figures:
    """Adjust a map.

    Args:
        T_true: ``(K, 4, 4)`` camera from world.
        iterative: solve the cameras' equations by conjugate gradients, else factorise them.
    """
    most = 0 if iterative else len(T_true)
    with mock.patch.object(camera_system, "_DENSE_CAMERAS", most), single_threaded():
        start = time.process_time()
        result = bundle_adjust(problem, _STEPS)
        seconds = time.process_time() - start
    return Figures(
        keyframes=len(T_true),
        points=len(problem.points_w),
        observations=len(problem.obs_camera),
        solved="gradients" if iterative else "factorised",
        before_m=position_rms_m(problem.T_camera_world, T_true),
        after_m=position_rms_m(result.T_camera_world, T_true),
        steps=result.iterations,
        seconds=seconds,
        peak_mib=memory_mib("VmHWM"),
    )


def table(rows: Sequence[Figures]) -> str:
    """The figures as Markdown."""
    headings = ["keyframes", "points", "observations", "solved", "error before m", "after m", "steps",
                "CPU s", "peak MiB"]  # fmt: skip
    return markdown_table(headings, [
        [str(row.keyframes), str(row.points), str(row.observations), row.solved, f"{row.before_m:.4f}",
         f"{row.after_m:.4f}", str(row.steps), f"{row.seconds:.1f}", f"{row.peak_mib:.0f}"]
        for row in rows
    ])  # fmt: skip


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = parser_of("adjustment", __doc__)
    parser.add_argument(
        "--keyframes", default="100,200,400,1000,2000", metavar="N,...", help="sizes of the maps"
    )
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write all figures here, as JSON")
    asked = parser.parse_args(arguments)
    sizes = [int(part) for part in asked.keyframes.split(",") if part.strip().isdecimal()]
    if not sizes or min(sizes) < 10:
        parser.error("--keyframes must be numbers from 10")
    begun = environment()
    rows: list[Figures] = []
    for size in sizes:
        problem, T_true = corridor(size)
        for iterative in (False, True):
            if iterative or size <= _BOTH_UP_TO:
                rows.append(measure(problem, T_true, iterative=iterative))
    if asked.output is not None:
        settings = {"keyframes": sizes}
        write_benchmark(asked.output, begun, settings, figures=[asdict(row) for row in rows])
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
