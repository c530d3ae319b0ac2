# SPDX-License-Identifier: Apache-2.0
"""What a rolled camera costs predicted depth: the same frames as taken, and turned upright by true poses.

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

import cv2
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
from slamdepth.errors import DatasetError
from slamdepth.evaluation import DepthJudge, DepthJudgement
from slamdepth.io import write_json
from slamdepth.pipeline.depth_data import readable, thinned
from slamdepth.pipeline.training_data import SequencePlace
from slamdepth.types import Camera, DepthPrediction, Frame, Trajectory

_FARTHEST_S = 0.05


def roll_rad(T_world_camera: NDArray[np.float64], up_w: NDArray[np.float64]) -> float:
    """Angle of "down" in the image from its vertical axis, positive towards the right side."""
    down_c = T_world_camera[:3, :3].T @ -up_w
    return float(np.arctan2(down_c[0], down_c[1]))


def true_roll(truth: Trajectory, up_w: NDArray[np.float64]) -> Callable[[Frame], float | None]:
    """The roll of a frame by the true pose nearest in time; None where there is none near."""

    def roll(frame: Frame) -> float | None:
        k = int(np.argmin(np.abs(truth.timestamps_s - frame.timestamp_s)))
        if abs(float(truth.timestamps_s[k]) - frame.timestamp_s) > _FARTHEST_S:
            return None
        return roll_rad(truth.T_world_camera[k], up_w)

    return roll


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
    values = turned_back(upright.values, otherwise.values, frame.camera, angle_rad)
    sigma = upright.sigma_log
    if sigma is not None and otherwise.sigma_log is not None:
        sigma = turned_back(sigma, otherwise.sigma_log, frame.camera, angle_rad)
    return replace(otherwise, values=values, sigma_log=sigma)


def turned(image_rgb: NDArray[np.uint8], camera: Camera, angle_rad: float) -> NDArray[np.uint8]:
    """An image turned about its principal point, its border mirrored."""
    out = _warped(image_rgb, camera, angle_rad, cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.uint8)


def turned_back(
    values: NDArray[np.float32], otherwise: NDArray[np.float32], camera: Camera, angle_rad: float
) -> NDArray[np.float32]:
    """A map of a turned image for the image as taken, ``otherwise`` where that was cut off."""
    out = _warped(values, camera, angle_rad, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return np.where(out > 0, out, otherwise).astype(np.float32)


def _warped(
    image: NDArray[Any], camera: Camera, angle_rad: float, interpolation: int, border: int
) -> NDArray[Any]:
    M = cv2.getRotationMatrix2D((camera.cx, camera.cy), np.degrees(angle_rad), 1.0)
    return np.asarray(cv2.warpAffine(image, M, image.shape[1::-1], flags=interpolation, borderMode=border))


def judged(
    dataset: Dataset, model: DepthModel, up_w: NDArray[np.float64], stride: int
) -> tuple[DepthJudgement, DepthJudgement]:
    """As taken, and turned upright; where no true pose tells the roll, both are as taken.

    Raises:
        DatasetError: the sequence has no ground truth or no depth.
    """
    if dataset.ground_truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth to tell the roll by; leave it out")
    place = SequencePlace.of(dataset)
    roll_of = true_roll(dataset.ground_truth, up_w)
    upright = DepthJudge(model.kind)

    def turn(frame: Frame, plain: DepthPrediction) -> None:
        assert frame.depth_m is not None
        roll = roll_of(frame)
        prediction = plain if roll is None else predicted_upright(model, frame, roll, plain)
        upright.add(prediction, frame.depth_m)

    as_taken = judge_depth(model, readable(place, thinned(place, stride)), watch=turn)
    turned_upright = upright.judge()
    assert turned_upright is not None
    return as_taken, turned_upright


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
    model = create_depth_model("dinov2")
    for path in options.sequences:
        dataset = open_dataset(path)
        with Console(stderr=True).status(f"{dataset.name}: predicting"):
            found = judged(dataset, model, up_w, options.stride)
        for label, judgement in zip(("as taken", "turned upright"), found, strict=True):
            rows.append({"sequence": dataset.name, "images": label, **judgement.to_dict()})
    if options.output:
        weights = [asdict(info) for info in model.weights]
        write_json(options.output, {"environment": environment(), "weights": weights, "rows": rows})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
