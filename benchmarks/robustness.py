# SPDX-License-Identifier: Apache-2.0
"""How slamdepth bears what recordings suffer: the same sequences, disturbed one way at a time.

python -m benchmarks.robustness SEQ... --depth sensor,dinov2 --output disturbed.json

Each run has the default settings; "tracked" is of the frames that were given, black ones included.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.command import errors_in_one_line
from benchmarks.corruptions import DISTURBANCES, Disturbance
from benchmarks.markdown import markdown_table
from benchmarks.ours import SlamDepth
from benchmarks.summary import environment
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.errors import DatasetError, InputError
from slamdepth.evaluation import score_trajectory
from slamdepth.io import write_json

FORMAT = 1
_HEADINGS = ("sequence", "depth", "disturbed", "tracked %", "ATE SE(3) m", "ATE Sim(3) m", "scale",
             "keyframes", "loops", "relocalised", "fps", "longest step ms", "finish s")  # fmt: skip


def opened(path: Path) -> Dataset:
    """A sequence that can be scored.

    Raises:
        DatasetError: it is none, or has no ground truth.
    """
    dataset = open_dataset(path)
    if dataset.ground_truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth to score by; leave it out")
    return dataset


def run(
    dataset: Dataset, disturbance: Disturbance, config: Config, count: int, model: DepthModel | None = None
) -> dict[str, Any]:
    """One run over the first ``count`` frames of a sequence with ground truth.

    Args:
        model: in place of the depth model that ``config`` names.

    Raises:
        DatasetError: too few poses can be scored.
    """
    system = SlamDepth(disturbance.camera(dataset.camera), config, model)
    steps_s: list[float] = []
    for frame in disturbance.play(dataset, count, with_depth=config.depth.name == "sensor"):
        begun = time.perf_counter()
        system.step(frame)
        steps_s.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    found = system.finish()
    finish_s = time.perf_counter() - begun
    score = score_trajectory(disturbance.truth_of(dataset, count), found.trajectory)
    return {
        "frames": len(steps_s),
        "fps": len(steps_s) / (sum(steps_s) + finish_s),
        "longest_step_ms": 1e3 * max(steps_s),
        "finish_s": finish_s,
        "tracked": len(found.trajectory) / len(steps_s),
        "ate_se3_m": score.se3.rmse_m,
        "ate_sim3_m": score.sim3.rmse_m,
        "scale": score.sim3.scale,
        **found.counts,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A row a run; a failed one says why."""
    return markdown_table(_HEADINGS, [[*_names(row), *_cells(row)] for row in rows])


def _names(row: dict[str, Any]) -> list[str]:
    return [row["sequence"], row["depth"], row["disturbance"]]


def _cells(row: dict[str, Any]) -> list[str]:
    if "error" in row:
        return [row["error"]]
    return [
        f"{100 * row['tracked']:.1f}", f"{row['ate_se3_m']:.3f}", f"{row['ate_sim3_m']:.3f}",
        f"{row['scale']:.3f}", *(str(row[name]) for name in ("keyframes", "loops", "relocalisations")),
        f"{row['fps']:.1f}", f"{row['longest_step_ms']:.0f}", f"{row['finish_s']:.1f}",
    ]  # fmt: skip


def chosen(names: str | None) -> dict[str, Disturbance]:
    """Those named, with commas; all by default.

    Raises:
        InputError: a name is unknown; lists those that are not.
    """
    if names is None:
        return DISTURBANCES
    asked = [name.strip() for name in names.split(",")]
    for name in asked:
        if name not in DISTURBANCES:
            raise InputError(f"no disturbance '{name}'; there are: {', '.join(DISTURBANCES)}")
    return {name: DISTURBANCES[name] for name in asked}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.robustness",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ", help="with ground truth")
    parser.add_argument("--depth", default="dinov2", help="'sensor' and names of depth models, with commas")
    parser.add_argument("--disturbances", metavar="NAMES", help="with commas (default: all)")
    parser.add_argument("--max-frames", type=int, metavar="N", help="no more than the first N frames")
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    asked = parser.parse_args(arguments)
    if asked.max_frames is not None and asked.max_frames < 1:
        parser.error(f"--max-frames must be at least 1, got {asked.max_frames}")
    return asked


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked = parse(arguments)
    begun, ways = environment(), chosen(asked.disturbances)
    rows: list[dict[str, Any]] = []
    for dataset in [opened(path) for path in asked.sequences]:
        count = min(len(dataset), asked.max_frames or len(dataset))
        for depth in asked.depth.split(","):
            if depth == "sensor" and not dataset.has_depth:
                continue
            config = Config.from_dict({"depth": {"name": depth}})
            for name, disturbance in ways.items():
                if disturbance.has_depth is not None and depth != "sensor":
                    continue  # as it is, to a network
                about = {"sequence": dataset.name, "depth": depth, "disturbance": name}
                with Console(stderr=True).status(f"{dataset.name} [{depth}]: {name}"):
                    try:
                        figures = run(dataset, disturbance, config, count)
                    except DatasetError as error:  # too few poses to score; the other rows go on
                        figures = {"error": str(error)}
                rows.append({**about, **figures})
                if asked.output:
                    write_json(asked.output, {"format": FORMAT, "environment": begun, "rows": rows})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
