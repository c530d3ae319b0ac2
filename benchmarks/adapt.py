# SPDX-License-Identifier: Apache-2.0
"""What ``--adapt`` changes: each sequence without and with it.

    python -m benchmarks.adapt --output adapt.json DIR/fr1_desk DIR/room

Sequences need ground truth to judge by, and depth is judged where they have a sensor's; neither reaches
the tracker. A run done again gives the same bits, so one is enough. See ``docs/depth.md``.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table
from benchmarks.ours import SlamDepth
from benchmarks.summary import environment
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import DatasetError, SlamdepthError
from slamdepth.evaluation import DepthAccumulator, score_trajectory
from slamdepth.io import write_json
from slamdepth.types import Reconstruction

FORMAT = "slamdepth-adapt-1"
COLUMNS = {
    "ate_sim3_m": "Sim(3) m",
    "ate_se3_m": "SE(3) m",
    "scale": "scale",
    "predicted": "AbsRel predicted",
    "metric": "as predicted",
    "final": "AbsRel final",
    "loss": "held-out loss",
    "cpu_s": "CPU s",
}


def run(dataset: Dataset, depth: str, adapt: bool, frames: int | None) -> dict[str, Any]:
    """One run's figures."""
    began_s = time.process_time()
    system = SlamDepth(
        dataset.camera, Config.from_dict({"depth": {"name": depth, "adapt": adapt}}, origin="benchmark")
    )
    for index in range(min(len(dataset), frames or len(dataset))):
        system.step(dataset.read(index))
    done = system.reconstruction()
    return {"adapt": adapt, "cpu_s": time.process_time() - began_s, **score(dataset, done)}


def score(dataset: Dataset, done: Reconstruction) -> dict[str, Any]:
    """Trajectory against ground truth, and the depth of the keyframes against the sensor's.

    ``predicted`` and ``final`` are AbsRel after one median a keyframe, of what the network says at the
    end of the run and of what is fused into the mesh; ``metric`` is of the former as predicted.
    """
    assert dataset.ground_truth is not None
    path = score_trajectory(dataset.ground_truth, done.trajectory)
    predicted, final = DepthAccumulator(), DepthAccumulator()
    for keyframe in done.keyframes:
        sensor_m = dataset.read(keyframe.frame.index, with_depth=dataset.has_depth).depth_m
        if sensor_m is not None:
            predicted.add(keyframe.prediction.values, sensor_m)
            final.add(keyframe.depth_m, sensor_m)
    figures: dict[str, Any] = {
        "frames": done.frames,
        "tracked": done.tracked / done.frames,
        "keyframes": len(done.keyframes),
        "ate_sim3_m": path.sim3.rmse_m,
        "ate_se3_m": path.se3.rmse_m,
        "scale": path.sim3.scale,
    }
    before, after = predicted.score(), final.score()
    if before is not None and after is not None:
        figures |= {
            "predicted": before.frame_median.abs_rel,
            "metric": before.metric.abs_rel,
            "final": after.frame_median.abs_rel,
        }
    learnt = done.adaptation
    if learnt is not None:
        figures |= {
            "updates": learnt.updates,
            "in_use": learnt.in_use,
            "loss": [learnt.loss_before, learnt.loss_after],
        }
    return figures


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    heads = ["sequence", "`--adapt`", "keyframes", *COLUMNS.values()]
    lines = []
    for row in rows:
        about = [row["sequence"], "on" if row["adapt"] else "off", str(row["keyframes"])]
        lines.append([*about, *(_cell(row.get(name)) for name in COLUMNS)])
    return markdown_table(heads, lines)


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return "-" if None in value else " -> ".join(f"{part:.4f}" for part in value)
    return "-" if value is None else f"{value:.3f}" if np.isfinite(value) else "-"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.adapt", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ")
    parser.add_argument("--depth", default="dinov2", help="depth model (default: dinov2)")
    parser.add_argument("--max-frames", type=int, help="a quick look")
    parser.add_argument("--output", type=Path, help=".json to write")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parse(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    rows: list[dict[str, Any]] = []
    benchmark = {"format": FORMAT, "environment": environment(), "depth": options.depth, "rows": rows}
    try:
        datasets = [open_dataset(path) for path in options.sequences]
        for dataset in datasets:
            if dataset.ground_truth is None:
                raise DatasetError(f"{dataset.path}: has no ground truth to judge by; leave it out")
        for dataset in datasets:
            for adapt in (False, True):
                print(f"{dataset.name}: --adapt {'on' if adapt else 'off'}", file=sys.stderr, flush=True)
                figures = run(dataset, options.depth, adapt, options.max_frames)
                rows.append({"sequence": dataset.name, **figures})
                if options.output:
                    write_json(options.output, benchmark)  # what is done is kept, whatever comes
    except SlamdepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
