# SPDX-License-Identifier: Apache-2.0
"""What a rolled camera costs predicted depth: the same frames as taken, and turned upright by true poses.

Where a model finds out which way is down itself, it is also told the true direction, and how often it
finds it is counted.

python -m benchmarks.depth_roll rgbd_dataset_freiburg1_rpy --output roll.json

The true roll is of the ground truth, whose world has to have a vertical axis (TUM's is z). An image is
turned about its principal point, predicted, and the prediction turned back; what was cut off at the
corners is taken from the image as taken. So this is a bound for anything that finds out the roll.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.command import errors_in_one_line
from benchmarks.markdown import markdown_table
from benchmarks.summary import environment
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.evaluate import judge_depth
from slamdepth.depth.registry import create_depth_model
from slamdepth.depth.upright import roll_rad, turned, turned_back
from slamdepth.errors import DatasetError
from slamdepth.evaluation import DepthJudge, DepthJudgement
from slamdepth.io import write_json
from slamdepth.pipeline.depth_data import readable, thinned
from slamdepth.pipeline.training_data import SequencePlace
from slamdepth.types import DepthPrediction, Frame, Trajectory

_FARTHEST_S = 0.05
_WITHIN_DEG = 20
_LABELS = ("as taken", "turned upright", "told which way is down")


def pose_near(truth: Trajectory, frame: Frame) -> NDArray[np.float64] | None:
    """``T_world_camera (4, 4)`` of the true pose nearest in time; None where there is none near."""
    k = int(np.argmin(np.abs(truth.timestamps_s - frame.timestamp_s)))
    if abs(float(truth.timestamps_s[k]) - frame.timestamp_s) > _FARTHEST_S:
        return None
    return truth.T_world_camera[k]


def true_down(truth: Trajectory, up_w: NDArray[np.float64]) -> Callable[[Frame], NDArray[np.float64] | None]:
    """Gravity ``(3,)`` in a frame's camera by the true pose nearest in time; None where none is near."""

    def down(frame: Frame) -> NDArray[np.float64] | None:
        T_world_camera = pose_near(truth, frame)
        return None if T_world_camera is None else np.asarray(T_world_camera[:3, :3].T @ -up_w)

    return down


def predicted_upright(
    model: DepthModel, frame: Frame, angle_rad: float, otherwise: DepthPrediction
) -> DepthPrediction:
    """What a model predicts for an image turned upright, as of the image as taken.

    Args:
        angle_rad: the frame's roll, see :func:`roll_rad`.
        otherwise: its prediction for the image as taken, which counts where the turned one was cut off.
    """
    image = turned(frame.image_rgb, frame.camera, -angle_rad)
    upright = model.predict(replace(frame, image_rgb=image, depth_m=None))
    return turned_back(upright, otherwise, frame.camera, angle_rad)


def judged(
    dataset: Dataset, model: DepthModel, up_w: NDArray[np.float64], stride: int
) -> tuple[DepthJudgement, DepthJudgement, DepthJudgement, list[float]]:
    """As taken, turned upright and told the true direction of gravity, and how far off, in degrees, the one
    is that the model finds itself: 180 where it finds none. Where no true pose tells gravity, the first two
    are of the image as taken, and it counts in neither of the others.

    Raises:
        DatasetError: the sequence has no ground truth or no depth.
    """
    if dataset.ground_truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth to tell the roll by; leave it out")
    place = SequencePlace.of(dataset)
    down_of = true_down(dataset.ground_truth, up_w)
    upright, told, errors_deg = DepthJudge(model.kind), DepthJudge(model.kind), []

    def look(frame: Frame, plain: DepthPrediction) -> None:
        assert frame.depth_m is not None
        if (down := down_of(frame)) is None:
            upright.add(plain, frame.depth_m)
            return
        upright.add(predicted_upright(model, frame, roll_rad(down), plain), frame.depth_m)
        told.add(model.predict(replace(frame, gravity=down)), frame.depth_m)
        cosine = -1.0 if plain.gravity is None else float(np.clip(plain.gravity @ down, -1.0, 1.0))
        errors_deg.append(float(np.degrees(np.arccos(cosine))))

    as_taken = judge_depth(model, readable(place, thinned(place, stride)), watch=look)
    turned_upright, knowing = upright.judge(), told.judge()
    if turned_upright is None or knowing is None:
        raise DatasetError(f"{dataset.path}: no frame with depth has a true pose near in time")
    return as_taken, turned_upright, knowing, errors_deg


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A row a sequence and way, with half of the 95 % intervals."""
    headings = ("sequence", "images", "as predicted", "one median", "frame median",
                "delta1 (frame median)", "scale spread")  # fmt: skip
    return markdown_table(headings, ([row["sequence"], row["images"], *_cells(row)] for row in rows))


def _cells(row: dict[str, Any]) -> list[str]:
    ways = row["ways"]
    figures = [ways[way]["abs_rel"] for way in ("as_predicted", "sequence_median", "frame_median")]
    figures += [ways["frame_median"]["delta1"], row["scale_spread"]]
    return [f"{f['value']:.3f} ±{(f['high'] - f['low']) / 2:.3f}" for f in figures]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_roll",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sequences", nargs="+", type=Path, help="with depth, and ground truth that knows up")
    parser.add_argument("--up", nargs=3, type=float, default=(0.0, 0.0, 1.0), metavar=("X", "Y", "Z"),
                        help="up in the world of the ground truth (default: 0 0 1)")  # fmt: skip
    parser.add_argument("--stride", type=int, default=10, help="every so-manieth frame (default: 10)")
    parser.add_argument("--output", "-o", type=Path, help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parse(arguments)
    rows: list[dict[str, Any]] = []
    up_w = np.array(options.up)
    found: list[str] = []
    down_errors: dict[str, list[float]] = {}
    model = create_depth_model("dinov2")
    for path in options.sequences:
        dataset = open_dataset(path)
        with Console(stderr=True).status(f"{dataset.name}: predicting"):
            *judgements, errors_deg = judged(dataset, model, up_w, options.stride)
        for label, judgement in zip(_LABELS, judgements, strict=True):
            rows.append({"sequence": dataset.name, "images": label, **judgement.to_dict()})
        found.append(
            f"{dataset.name}: found which way is down to {_WITHIN_DEG} degrees in "
            f"{np.mean(np.array(errors_deg) <= _WITHIN_DEG):.0%} of {len(errors_deg)} images, "
            f"half of them to {np.median(errors_deg):.0f} degrees"
        )
        down_errors[dataset.name] = errors_deg
    if options.output:
        weights = [asdict(info) for info in model.weights]
        write_json(
            options.output,
            {"environment": environment(), "weights": weights, "rows": rows, "down_errors_deg": down_errors},
        )
    print(table(rows))
    print(*found, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
