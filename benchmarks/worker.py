# SPDX-License-Identifier: Apache-2.0
"""One run in a process of its own, so that CPU time and peak memory are those of one system.

    python -m benchmarks.worker JOB.json RESULT.json

``benchmarks.jobs`` starts it and writes the job.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.depth_cache import DepthCache
from benchmarks.jobs import Job
from benchmarks.rows import Row, build_system
from benchmarks.system import Estimate, NotInstalled, System
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import DatasetError, ImageDecodeError, SlamdepthError
from slamdepth.types import Frame, Trajectory


@dataclass(frozen=True)
class Measured:
    """Time and memory of one run, without reading images and waiting.

    Attributes:
        step_s: wall time of each step.
        finish_s: wall time of ``finish``.
        cpu_s: processor time of all threads.
        peak_memory_mib: peak memory of the process.
        without_depth: number of frames without a depth image.
    """

    step_s: list[float]
    finish_s: float
    cpu_s: float
    peak_memory_mib: float
    without_depth: int


def main(arguments: list[str]) -> int:
    """Run the job and write its result."""
    job_file, result_file = map(Path, arguments)
    job = Job.from_dict(json.loads(job_file.read_text(encoding="utf-8")))
    try:
        result = predict(job) if job.kind == "predict" else run(job)
    except NotInstalled as error:
        result = {"status": "not installed", "message": str(error)}
    except SlamdepthError as error:
        result = {"status": "failed", "message": str(error)}
    result_file.write_text(json.dumps(result, allow_nan=False), encoding="utf-8")
    return 0


def predict(job: Job) -> dict[str, Any]:
    """Fill the depth cache; the result holds its folder."""
    from slamdepth.depth.registry import create_depth_model

    dataset = open_dataset(Path(job.sequence))
    model = create_depth_model(job.row.depth)
    cache = DepthCache.of(Path(job.cache or "."), dataset, model)
    made = cache.fill(dataset, model, job.indices(len(dataset)))
    return {"status": "ok", "folder": str(cache.folder), "made": made}


def run(job: Job) -> dict[str, Any]:
    """Measure and score one run."""
    dataset = open_dataset(Path(job.sequence))
    system = build_system(job.row, dataset.camera, Path(job.vocabulary) if job.vocabulary else None)
    indices = job.indices(len(dataset))
    measured, estimate = measure(system, dataset, indices, job)
    frames = len(measured.step_s)
    total_s = sum(measured.step_s) + measured.finish_s
    figures: dict[str, float] = {
        **estimate.counts,
        "tracked": len(estimate.trajectory) / frames,
        "fps": frames / total_s,
        "step_ms": 1e3 * float(np.median(measured.step_s)),
        "step_p95_ms": 1e3 * float(np.percentile(measured.step_s, 95)),
        "finish_s": measured.finish_s,
        "cpu_ms_per_frame": 1e3 * measured.cpu_s / frames,
        "peak_memory_mib": measured.peak_memory_mib,
    }
    notes = list(estimate.notes)
    if job.row.needs_sensor and measured.without_depth:
        notes.append(f"{measured.without_depth} of {frames} frames have no sensor depth")
    figures.update(score(dataset.ground_truth, estimate, notes))
    return {
        "status": "ok",
        "frames": frames,
        "figures": figures,
        "notes": notes,
    }


def measure(system: System, dataset: Dataset, indices: range, job: Job) -> tuple[Measured, Estimate]:
    """Play the frames and finish, at the pace of the sequence or as fast as the system takes them.

    Raises:
        DatasetError: no image can be decoded.
    """
    cache = DepthCache(Path(job.depth_folder)) if job.depth_folder else None
    step_s: list[float] = []
    without_depth = 0
    reading_cpu_s = 0.0
    start_cpu_s = _cpu_s()
    start_s: float | None = None
    for index in indices:
        before = time.thread_time()
        try:
            frame: Frame | None = _read(dataset, index, job.row, cache)
        except ImageDecodeError:
            frame = None
        reading_cpu_s += time.thread_time() - before
        if frame is None:
            continue
        if start_s is None:
            start_s = time.perf_counter() - frame.timestamp_s
        early_s = start_s + frame.timestamp_s - time.perf_counter()
        if job.pace == "sequence" and early_s > 0:
            time.sleep(early_s)
        without_depth += frame.depth_m is None
        begin = time.perf_counter()
        system.step(frame)
        step_s.append(time.perf_counter() - begin)
    if not step_s:
        raise DatasetError(f"{dataset.path}: no image decodes")
    begin = time.perf_counter()
    estimate = system.finish()
    finish_s = time.perf_counter() - begin
    cpu_s = _cpu_s() - start_cpu_s - reading_cpu_s
    return Measured(step_s, finish_s, cpu_s, memory_mib("VmHWM"), without_depth), estimate


def score(truth: Trajectory | None, estimate: Estimate, notes: list[str]) -> dict[str, float]:
    """ATE and RPE of the full trajectory, and the ATE of the keyframes alone.

    A trajectory without scale has no SE(3) figures; its RPE is that after Sim(3) scaling.

    Args:
        notes: gets a line where something cannot be scored.
    """
    from slamdepth.evaluation import score_trajectory

    if truth is None:
        notes.append("no ground truth")
        return {}
    try:
        scored = score_trajectory(truth, estimate.trajectory)
        figures = {"ate_sim3_m": scored.sim3.rmse_m, "scale": scored.sim3.scale}
        if estimate.trajectory.is_metric:
            figures["ate_se3_m"] = scored.se3.rmse_m
        else:
            T = estimate.trajectory.T_world_camera.copy()
            T[:, :3, 3] *= scored.sim3.scale
            scored = score_trajectory(truth, replace(estimate.trajectory, T_world_camera=T))
        if scored.per_second is not None:
            figures["rpe_m_per_s"] = scored.per_second.trans_rmse_m
            figures["rpe_deg_per_s"] = scored.per_second.rot_rmse_deg
        if estimate.keyframes is not None and len(estimate.keyframes) > 2:
            figures["ate_sim3_keyframes_m"] = score_trajectory(truth, estimate.keyframes).sim3.rmse_m
    except DatasetError as error:
        notes.append(f"not scored: {error}")
        return {}
    return figures


def _read(dataset: Dataset, index: int, row: Row, cache: DepthCache | None) -> Frame:
    if cache is not None:
        return replace(dataset.read(index), depth_m=cache.read(index))
    return dataset.read(index, with_depth=row.needs_sensor)


def _cpu_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def memory_mib(name: str) -> float:
    """Memory of this process: the peak ("VmHWM") or the current resident memory ("VmRSS").

    ``ru_maxrss`` starts at the value of the parent process on Linux, so it is used on other systems only,
    where both names give the peak.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
