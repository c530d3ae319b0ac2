# SPDX-License-Identifier: Apache-2.0
"""The camera found from the motion, on recordings whose camera is known and taken away.

    python -m benchmarks.self_calibration --data ../shared/data --also room
    python -m benchmarks.self_calibration --data ../shared/data --windows 3

Each recording is tracked from a guess of 60 degrees, as ``slamdepth run`` does without a camera file: error
of the focal length and of its interval, and Sim(3) error of the path, of each piece of the truth. With
--windows, so many stretches of 150 frames of each recording are adjusted by themselves, from the known
camera: how many errors are within one and two deviations. The kitchen's published 585 px are those of its
depth camera, and 532 px fit its colour images better; errors are against the latter.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.markdown import markdown_table
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.seeded import seeded_depth_model
from benchmarks.wild_recordings import Recording, find_recordings
from slamdepth.backend.self_calibration import self_calibrate
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of
from slamdepth.errors import DatasetError, InputError, SlamdepthError
from slamdepth.evaluation import score_trajectory
from slamdepth.pipeline.camera import WINDOW, check_camera, prior_of, settle_camera, sights_of_window
from slamdepth.tracking import Tracker
from slamdepth.types import Trajectory

_KEYS = ("sequence", "start", "frames")
_OTHER_FOCAL_PX = {"7scenes_redkitchen_seq-01": 532.0}
_RUN_HEADINGS = ("sequence", "true f", "found", "error, %", "deviation, %", "tracked with", "Sim(3) ATE",
                 "tracked", "seconds before")  # fmt: skip
_WINDOW_HEADINGS = (
    "sequence",
    "from frame",
    "error, %",
    "deviation, %",
    "if independent, %",
    "error / deviation",
)


def guessed(recording: Recording) -> tuple[Dataset, float]:
    """A recording without its camera, and the true focal length of its images."""
    dataset = open_dataset(recording.sequence, recording.camera_file)
    camera = dataset.camera
    true_px = _OTHER_FOCAL_PX.get(recording.name, camera.fx)
    found = intrinsics_of(camera.width, camera.height)
    dataset.camera = replace(found.camera, depth_factor=camera.depth_factor, fps=camera.fps)
    dataset.camera_source = CameraSource(Certainty.GUESSED, found.how)
    return dataset, true_px


def run(recording: Recording, frames: int | None) -> dict[str, Any]:
    """Track a recording without its camera: the figures, or the error."""
    dataset, true_px = guessed(recording)
    config = Config.from_dict({"depth": {"name": "dinov2"}})
    model = seeded_depth_model("dinov2", config)
    indices = range(len(dataset))[:frames]
    start_s = time.perf_counter()
    try:
        opening = settle_camera(dataset, indices, model, config, lambda state: None, threading.Event())
        opened_s = time.perf_counter() - start_s
        model = seeded_depth_model("dinov2", config)
        with Tracker(dataset.camera, model, config) as tracker:
            for index in indices:
                tracker.step(dataset.read(index))
            found = tracker.finish()
        facts = check_camera(dataset, opening, tracker)
    except SlamdepthError as error:
        return {"error": str(error)}
    return {
        "true_px": true_px,
        "found_px": facts.best.fx,
        "error": math.log(facts.best.fx / true_px),
        "sigma": facts.sigma_log_f,
        "observed": facts.is_observed,
        "tracked_px": facts.tracked.fx,
        "k1": facts.best.distortion[0],
        "ate_m": [
            rmse for truth in recording.truths if (rmse := _ate_m(truth, found.trajectory)) is not None
        ],
        "tracked": len(found.trajectory) / len(indices),
        "opening_s": opened_s,
    }


def _ate_m(truth: Trajectory, found: Trajectory) -> float | None:
    try:
        return score_trajectory(truth, found).sim3.rmse_m
    except DatasetError:  # too few poses in common
        return None


def window(recording: Recording, start: int) -> dict[str, Any]:
    """Adjust one stretch of a recording by itself."""
    dataset, true_px = guessed(recording)
    prior = prior_of(dataset.camera.fx, dataset.camera_source, Config())
    true = open_dataset(recording.sequence, recording.camera_file).camera
    dataset.camera = replace(true, fx=true_px, fy=true_px * true.fy / true.fx)
    config = Config.from_dict({"depth": {"name": "dinov2"}})
    model = seeded_depth_model("dinov2", config)
    indices = range(len(dataset))[start : start + WINDOW]
    sights = sights_of_window(dataset, indices, model, config, threading.Event())
    if sights is None:
        return {"error": "too little was seen"}
    found = self_calibrate(sights, dataset.camera, prior)
    return {
        "error": math.log(found.camera.fx / true_px),
        "sigma": found.sigma_log_f,
        "naive_sigma": found.naive_sigma_log_f,
    }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Runs and windows as two Markdown tables, and the shares of windows within their deviations."""
    runs = [_run_cells(row) for row in rows if row["start"] is None]
    windows = [row for row in rows if row["start"] is not None and isinstance(row["error"], float)]
    text = [markdown_table(_RUN_HEADINGS, runs)] if runs else []
    if windows:
        cells = [
            [row["sequence"], str(row["start"]), *(f"{100 * row[name]:.2f}" for name in _FIGURES),
             f"{row['error'] / row['sigma']:.1f}"]
            for row in windows
        ]  # fmt: skip
        off = np.abs([row["error"] / row["sigma"] for row in windows])
        text += [
            markdown_table(_WINDOW_HEADINGS, cells),
            f"{100 * np.mean(off < 1):.0f} % within one deviation, {100 * np.mean(off < 2):.0f} % within two",
        ]
    return "\n\n".join(text)


_FIGURES = ("error", "sigma", "naive_sigma")


def _run_cells(row: dict[str, Any]) -> list[str]:
    if isinstance(row["error"], str):
        return [row["sequence"], row["error"]]
    observed = "" if row["observed"] else " (not observable)"
    ate = ", ".join(f"{rmse:.4f}" for rmse in row["ate_m"])
    return [
        row["sequence"], f"{row['true_px']:.1f}", f"{row['found_px']:.1f}{observed}",
        f"{100 * row['error']:+.2f}", f"{100 * row['sigma']:.2f}", f"{row['tracked_px']:.1f}", ate or "-",
        f"{100 * row['tracked']:.0f} %", f"{row['opening_s']:.0f}",
    ]  # fmt: skip


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("self_calibration", __doc__)
    add = parser.add_argument
    add("--data", type=Path, metavar="DIR", help="all recordings in this folder whose camera is known")
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="of --data, with commas")
    add("--also", type=Path, nargs="*", default=[], metavar="SEQ", help="further sequences with true poses")
    add("--frames", type=int, metavar="N", help="no more than N frames of each")
    add(
        "--windows", type=int, default=0, metavar="N", help="adjust N stretches of each, and track none whole"
    )
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    if not asked.data and not asked.also:
        raise InputError("nothing to run: name --data or --also")
    file = RowFile(asked.output, begun, {}, _KEYS)
    rows = []
    for recording in find_recordings(asked.data, asked.also, asked.only):
        starts: list[int | None] = [None]
        if asked.windows:
            length = len(open_dataset(recording.sequence, recording.camera_file))
            last = max(0, length - WINDOW)
            starts = sorted({round(start) for start in np.linspace(0, last, asked.windows)})
        for start in starts:
            row = file.find(sequence=recording.name, start=start, frames=asked.frames)
            if row is None:
                figures = run(recording, asked.frames) if start is None else window(recording, start)
                row = {"sequence": recording.name, "start": start, "frames": asked.frames, **figures}
                file.add(row)
                progress_line(f"{recording.name}: done")
            rows.append(row)
    print(tables(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
