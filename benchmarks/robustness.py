# SPDX-License-Identifier: Apache-2.0
"""Robustness: run slamdepth on the same sequences under one corruption at a time.

    python -m benchmarks.robustness SEQ... --depth sensor,dinov2 --output robustness.json

Each run has the default settings. "tracked" counts all frames that were given, black ones too.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.command import comma_separated, errors_in_one_line, parser_of
from benchmarks.corruptions import CORRUPTIONS, Corruption
from benchmarks.markdown import markdown_table
from benchmarks.ours import SlamDepth
from benchmarks.record import environment, write_benchmark
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.errors import DatasetError, InputError
from slamdepth.evaluation import score_trajectory

_HEADINGS = ("sequence", "depth", "corruption", "tracked %", "ATE SE(3) m", "ATE Sim(3) m", "scale",
             "keyframes", "loops", "relocalised", "fps", "longest step ms", "finish s")  # fmt: skip


def opened(path: Path) -> Dataset:
    """Open a sequence that has ground truth.

    Raises:
        DatasetError: the folder is no sequence, or has no ground truth.
    """
    dataset = open_dataset(path)
    if dataset.ground_truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth to score by")
    return dataset


def run(
    dataset: Dataset, corruption: Corruption, config: Config, count: int, model: DepthModel | None = None
) -> dict[str, Any]:
    """Run slamdepth on the first ``count`` frames of a sequence with ground truth, and score it.

    Args:
        model: used instead of the depth model that ``config`` names.

    Raises:
        DatasetError: too few poses can be scored.
    """
    system = SlamDepth(corruption.camera(dataset.camera), config, model)
    steps_s: list[float] = []
    for frame in corruption.play(dataset, count, with_depth=config.depth.name == "sensor"):
        begun = time.perf_counter()
        system.step(frame)
        steps_s.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    found = system.finish()
    finish_s = time.perf_counter() - begun
    score = score_trajectory(corruption.truth_of(dataset, count), found.trajectory)
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
    """One row for each run as Markdown; the row of a failed run holds its error."""
    return markdown_table(_HEADINGS, [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    names = [row["sequence"], row["depth"], row["corruption"]]
    if "error" in row:
        return [*names, row["error"]]
    return [
        *names, f"{100 * row['tracked']:.1f}", f"{row['ate_se3_m']:.3f}", f"{row['ate_sim3_m']:.3f}",
        f"{row['scale']:.3f}", *(str(row[name]) for name in ("keyframes", "loops", "relocalisations")),
        f"{row['fps']:.1f}", f"{row['longest_step_ms']:.0f}", f"{row['finish_s']:.1f}",
    ]  # fmt: skip


def chosen(names: Sequence[str]) -> dict[str, Corruption]:
    """The corruptions of these names.

    Raises:
        InputError: a name is unknown; the message lists the known ones.
    """
    for name in names:
        if name not in CORRUPTIONS:
            raise InputError(f"no corruption '{name}'; there are: {', '.join(CORRUPTIONS)}")
    return {name: CORRUPTIONS[name] for name in names}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("robustness", __doc__)
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ", help="with ground truth")
    parser.add_argument("--depth", type=comma_separated, default=["dinov2"], metavar="NAMES",
                        help="'sensor' and names of depth models, with commas")  # fmt: skip
    parser.add_argument("--corruptions", type=comma_separated, default=list(CORRUPTIONS), metavar="NAMES",
                        help="with commas (default: all)")  # fmt: skip
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
    begun, corruptions = environment(), chosen(asked.corruptions)
    settings = {"max_frames": asked.max_frames}
    rows: list[dict[str, Any]] = []
    for dataset in [opened(path) for path in asked.sequences]:
        count = min(len(dataset), asked.max_frames or len(dataset))
        for depth in asked.depth:
            if depth == "sensor" and not dataset.has_depth:
                continue
            config = Config.from_dict({"depth": {"name": depth}})
            for name, corruption in corruptions.items():
                if corruption.has_depth is not None and depth != "sensor":
                    continue  # it changes nothing for a network
                about = {"sequence": dataset.name, "depth": depth, "corruption": name}
                with Console(stderr=True).status(f"{dataset.name} [{depth}]: {name}"):
                    try:
                        figures = run(dataset, corruption, config, count)
                    except DatasetError as error:  # too few poses to score; the other rows go on
                        figures = {"error": str(error)}
                rows.append({**about, **figures})
                if asked.output:
                    write_benchmark(asked.output, begun, settings, rows=rows)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
