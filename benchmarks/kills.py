# SPDX-License-Identifier: Apache-2.0
"""Kill a run in each of its stages, go on with it, and compare its end with that of a run nobody killed.

    python -m benchmarks.kills SEQ --kills 50 --depth sensor --work kills -o kills.json

Kills are spread evenly over the stages: opening, each half of tracking, and all that follows. A stage is left
by SIGKILL after a random part of the time that it took in the unbroken run; the next process goes on, and is
killed in a later stage. After four kills a run ends by itself, its files are compared with those of the
unbroken run, and another run begins, until there were as many kills as asked for.
"""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import errors_in_one_line, parser_of, progress_line
from slamdepth.config import Config
from slamdepth.io import read_tum_trajectory, write_json
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage

FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "mesh.ply")

_OPENING = "opening"
_IN_A_ROW = 4  # kills of one run, so that many runs begin and end
_SHORTEST_S = 0.01  # a stage that takes less is over before a kill arrives


@dataclass(frozen=True)
class Kill:
    """Kill a process so many seconds after it enters a stage, or as it leaves it."""

    stage: str
    after_s: float


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Attributes:
        code: its exit code, negative by a signal.
        stages: what it did, each with its seconds; the last one is what it was killed in.
    """

    code: int
    stages: tuple[tuple[str, float], ...]


def stage_of(state: RunProgress) -> str:
    """What a run is doing, tracking in two halves."""
    if state.stage is not RunStage.TRACKING:
        return str(state.stage.value)
    half = "second" if 2 * state.done >= state.total else "first"
    return f"{state.stage.value}, {half} half"


def in_a_child(work: Callable[[ProgressCallback], None], kill: Kill | None = None) -> Ended:
    """Do something in a forked process, and perhaps kill it.

    Args:
        work: is given a callback that it reports its progress to.
    """
    told, telling = os.pipe()
    start_s = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(told)
        _work_and_exit(work, telling)
    os.close(telling)
    entered = [(_OPENING, start_s)]
    code = None
    with os.fdopen(told, "rb", buffering=0) as stages:
        while code is None:
            if select.select([stages], [], [], 0.002)[0]:
                # one read may hold several names; an empty one is the end
                for name in stages.read(4096).decode().split("\n")[:-1]:
                    entered.append((name, time.monotonic()))
            if kill is not None and _is_time(kill, entered):
                os.kill(child, signal.SIGKILL)
                code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
                break
            done, status = os.waitpid(child, os.WNOHANG)
            code = os.waitstatus_to_exitcode(status) if done else None
    ends_s = [since_s for _, since_s in entered[1:]] + [time.monotonic()]
    took = [(stage, end_s - since_s) for (stage, since_s), end_s in zip(entered, ends_s, strict=True)]
    return Ended(code, tuple(took))


def _is_time(kill: Kill, entered: Sequence[tuple[str, float]]) -> bool:
    """Whether to kill a process that entered these stages; where it left the stage too soon, at once."""
    stage, since_s = entered[-1]
    if stage == kill.stage:
        return time.monotonic() - since_s >= kill.after_s
    return any(name == kill.stage for name, _ in entered)


def _work_and_exit(work: Callable[[ProgressCallback], None], telling: int) -> None:
    last = _OPENING

    def tell(state: RunProgress) -> None:
        nonlocal last
        stage = stage_of(state)
        if stage != last:
            os.write(telling, f"{stage}\n".encode())
            last = stage

    try:
        work(tell)
        os._exit(0)
    except BaseException as error:
        print(f"failed: {error}", file=sys.stderr)
        os._exit(1)


def next_kills(
    lengths_s: Mapping[str, float], tried: Counter[str], count: int, rng: random.Random
) -> list[Kill]:
    """The kills of one run: of the stages tried least so far, in the order of the run.

    Args:
        lengths_s: what each stage took in the unbroken run, in order.
        tried: kills of each stage so far, those included that fell into the next one.
        count: at most so many.
    """
    stages = [stage for stage, took_s in lengths_s.items() if took_s >= _SHORTEST_S]
    rank = {stage: (tried[stage], rng.random()) for stage in stages}
    chosen = set(sorted(stages, key=rank.__getitem__)[:count])
    return [Kill(stage, rng.uniform(0.0, lengths_s[stage])) for stage in stages if stage in chosen]


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

    def begin(place: Path) -> Callable[[ProgressCallback], None]:
        def do(tell: ProgressCallback) -> None:
            run(
                sequence,
                place,
                config=settings,
                max_frames=max_frames,
                overwrite=True,
                checkpoint_s=every_s,
                progress=tell,
            )

        return do

    def go_on(tell: ProgressCallback) -> None:
        resume(folder, progress=tell)

    in_a_child(begin(whole))  # the first one waits for the disk
    unbroken = in_a_child(begin(whole))
    if unbroken.code != 0:
        raise SystemExit("the unbroken run failed")
    lengths_s: dict[str, float] = {}
    for stage, took_s in unbroken.stages:
        lengths_s[stage] = lengths_s.get(stage, 0.0) + took_s
    progress_line(f"the unbroken run took {sum(lengths_s.values()):.1f} s")
    killed: list[dict[str, Any]] = []
    by_stage: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    ends: list[dict[str, Any]] = []
    failed = 0
    while len(killed) < kills:
        shutil.rmtree(folder, ignore_errors=True)
        task, in_a_row = begin(folder), 0
        in_order = next_kills(lengths_s, tried, min(_IN_A_ROW, kills - len(killed)), rng)
        for kill in [*in_order, None]:
            if kill is not None:
                tried[kill.stage] += 1
            ended = in_a_child(task, kill)
            if ended.code != -signal.SIGKILL:
                break
            in_a_row += 1
            stage, in_stage_s = ended.stages[-1]
            by_stage[stage] += 1
            killed.append({"during": stage, "after_s": round(in_stage_s, 3), "frames": _saved(folder)})
            progress_line(f"kill {len(killed)}: {killed[-1]}")
            if (folder / "checkpoint" / "run.json").is_file():
                task = go_on
        if ended.code != 0:
            failed += 1
            continue
        ends.append({"kills": in_a_row, **compare(folder, whole)})
        progress_line(f"end after {in_a_row} kills: {ends[-1]}")
    differences = [end["largest_difference_m"] for end in ends if end["same_frames"]]
    return {
        "sequence": sequence.name,
        "kills": len(killed),
        "by_stage": {stage: by_stage[stage] for stage in lengths_s},
        "runs": len(ends) + failed,
        "lost": failed + sum(not end["same_frames"] for end in ends),
        "runs_with_the_same_bytes": sum(all(end["same_bytes"].values()) for end in ends),
        "runs_with_the_same_trajectory": sum(end["same_bytes"]["trajectory.txt"] for end in ends),
        "largest_difference_m": max(differences, default=None),
        "unbroken_s": lengths_s,
        "killed": killed,
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
        if name not in ("ends", "killed"):
            print(f"{name}: {value}")
    return 1 if found["lost"] else 0


if __name__ == "__main__":
    sys.exit(main())
