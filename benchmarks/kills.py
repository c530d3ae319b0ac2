# SPDX-License-Identifier: Apache-2.0
"""Kill a run at random moments, go on with it, and compare its end with that of a run nobody killed.

    python -m benchmarks.kills SEQ --kills 50 --depth sensor --work kills -o kills.json

Each process is killed by SIGKILL after a random part of the time that the unbroken run took, be it while
reading, tracking, meshing or writing the report; the next one goes on. When one ends by itself, its
trajectory is compared with that of the unbroken run, and another run begins, until there were as many kills
as asked for.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import errors_in_one_line, parser_of, progress_line
from slamdepth.config import Config
from slamdepth.io import read_tum_trajectory, write_json

FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "mesh.ply")
_STAGES = (
    ("mesh.ply", "report"),
    ("map/map.json", "dense depth and mesh"),
    ("trajectory_online.txt", "tracking"),
)


_IN_A_ROW = 4  # kills of one run, so that many runs begin and end


def in_a_child(work: Callable[[], None], kill_after_s: float | None) -> tuple[int, float]:
    """Do something in a forked process; returns its exit code, negative by a signal, and its seconds."""
    start_s = time.monotonic()
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException as error:
            print(f"failed: {error}", file=sys.stderr)
            os._exit(1)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), time.monotonic() - start_s
        if kill_after_s is not None and time.monotonic() - start_s >= kill_after_s:
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            return os.waitstatus_to_exitcode(status), time.monotonic() - start_s
        time.sleep(0.002)


def load_what_runs_load() -> None:
    """Import once what each child would import, so that few kills fall into imports."""
    for name in ("gtsam", "scipy.sparse", "scipy.spatial", "matplotlib.pyplot", "evo.core.metrics"):
        import_module(name)

    from slamdepth.depth.registry import create_depth_model
    from slamdepth.frontend.compiled import load
    from slamdepth.open3d_loader import import_open3d

    create_depth_model("sensor")  # imports the others as well
    load()
    import_open3d()


def stage_of(folder: Path, began: float) -> str:
    """What a run that began at that time was doing when it was killed, by the files it wrote."""
    for name, stage in _STAGES:
        file = folder / name
        if file.exists() and file.stat().st_mtime >= began:
            return stage
    return "opening"


def compare(folder: Path, whole: Path) -> dict[str, Any]:
    """How the end of a run differs from that of the unbroken one."""
    mine, theirs = (read_tum_trajectory(one / "trajectory.txt")[0] for one in (folder, whole))
    same_frames = np.array_equal(mine.timestamps_s, theirs.timestamps_s)
    apart = mine.T_world_camera[:, :3, 3] - theirs.T_world_camera[:, :3, 3] if same_frames else None
    return {
        "same_bytes": {
            name: (folder / name).read_bytes() == (whole / name).read_bytes()
            for name in FILES
            if (whole / name).is_file()
        },
        "same_frames": same_frames,
        "largest_difference_m": None if apart is None else float(np.linalg.norm(apart, axis=1).max()),
    }


def kill_runs(
    sequence: Path, work: Path, *, kills: int, depth: str, every_s: float, seed: int, max_frames: int | None
) -> dict[str, Any]:
    """Runs that are killed ``kills`` times in all."""
    from slamdepth.pipeline.resume import resume
    from slamdepth.pipeline.run import run

    load_what_runs_load()
    settings = Config.from_dict({"depth": {"name": depth}, "map": {"voxel_size_m": 0.05}})
    whole, folder = work / "whole", work / "killed"
    rng = random.Random(seed)

    def begin(place: Path, checkpoint_s: float) -> Callable[[], None]:
        def do() -> None:
            run(
                sequence,
                place,
                config=settings,
                max_frames=max_frames,
                overwrite=True,
                checkpoint_s=checkpoint_s,
            )

        return do

    def go_on() -> None:
        resume(folder)

    in_a_child(begin(whole, every_s), None)  # the first one waits for the disk
    code, whole_s = in_a_child(begin(whole, every_s), None)
    if code != 0:
        raise SystemExit("the unbroken run failed")
    progress_line(f"the unbroken run took {whole_s:.1f} s")
    killed: list[dict[str, Any]] = []
    ends: list[dict[str, Any]] = []
    failed = 0
    while len(killed) < kills:
        shutil.rmtree(folder, ignore_errors=True)
        task, in_a_row = begin(folder, every_s), 0
        while True:
            is_deadly = len(killed) < kills and in_a_row < _IN_A_ROW
            began = time.time()
            code, took_s = in_a_child(task, rng.uniform(0.0, whole_s) if is_deadly else None)
            if code != -signal.SIGKILL:
                break
            in_a_row += 1
            stage = stage_of(folder, began)
            killed.append({"after_s": round(took_s, 2), "during": stage, "frames": _saved(folder)})
            progress_line(f"kill {len(killed)}: {killed[-1]}")
            if (folder / "checkpoint" / "run.json").is_file():
                task = go_on
        if code != 0:
            failed += 1
            continue
        ends.append({"kills": in_a_row, **compare(folder, whole)})
        progress_line(f"end after {in_a_row} kills: {ends[-1]}")
    stages = [one["during"] for one in killed]
    differences = [end["largest_difference_m"] for end in ends if end["same_frames"]]
    return {
        "sequence": sequence.name,
        "kills": len(killed),
        "by_stage": {stage: stages.count(stage) for stage in sorted(set(stages))},
        "runs": len(ends) + failed,
        "lost": failed + sum(not end["same_frames"] for end in ends),
        "runs_with_the_same_bytes": sum(all(end["same_bytes"].values()) for end in ends),
        "runs_with_the_same_trajectory": sum(end["same_bytes"]["trajectory.txt"] for end in ends),
        "largest_difference_m": max(differences, default=None),
        "unbroken_s": whole_s,
        "ends": ends,
    }


def _saved(folder: Path) -> int:
    """Frames in the checkpoint that the next process goes on from."""
    path = folder / "checkpoint" / "latest.json"
    return int(json.loads(path.read_text(encoding="utf-8"))["frames"]) if path.is_file() else 0


@errors_in_one_line
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code, 1 where a run was lost."""
    parser = parser_of("kills", __doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--depth", default="sensor")
    parser.add_argument("--every", type=float, default=0.5, help="seconds from checkpoint to checkpoint")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, required=True, help="folder of the runs")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    found = kill_runs(
        options.sequence,
        options.work,
        kills=options.kills,
        depth=options.depth,
        every_s=options.every,
        seed=options.seed,
        max_frames=options.max_frames,
    )
    if options.output is not None:
        write_json(options.output, found)
    for name, value in found.items():
        if name != "ends":
            print(f"{name}: {value}")
    return 1 if found["lost"] else 0


if __name__ == "__main__":
    sys.exit(main())
