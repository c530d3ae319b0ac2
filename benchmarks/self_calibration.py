# SPDX-License-Identifier: Apache-2.0
"""The camera found from the motion, on recordings whose camera is known and taken away.

    python -m benchmarks.self_calibration --data ../shared/data --also room
    python -m benchmarks.self_calibration --data ../shared/data --also room --parts 2

Each recording is tracked from a guess of 60 degrees, as ``slamdepth run`` does without a camera file: error
of the focal length and of its interval, and Sim(3) error of the path, of each piece of the truth, also with
the known camera. With --parts, each recording is cut into so many, and the camera of each part is looked for
as that of a whole recording, before it is tracked: how many errors are within one and two deviations. The
kitchen's published 585 px are those of its depth camera, and 532 px fit its colour images better; errors
are against the latter.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.markdown import markdown_table
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.seeded import seeded_depth_model
from benchmarks.wild_recordings import Recording, find_recordings
from slamdepth.backend.self_calibration_passes import focal_length_of
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of
from slamdepth.errors import DatasetError, InputError, SlamdepthError
from slamdepth.evaluation import score_trajectory
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.camera import OpeningCamera, check_camera, settle_camera
from slamdepth.tracking import Tracker
from slamdepth.types import Camera, Trajectory

_KEYS = ("sequence", "part", "frames")
_OTHER_FOCAL_PX = {"7scenes_redkitchen_seq-01": 532.0}
_RUN_HEADINGS = ("sequence", "true f", "found", "error, %", "deviation, %", "in two deviations",
                 "tracked with", "Sim(3) ATE", "with its camera", "tracked", "windows",
                 "seconds before")  # fmt: skip
_PART_HEADINGS = ("sequence", "part", "frames", "found", "error, %", "deviation, %", "error / deviation",
                  "windows", "memory")  # fmt: skip


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
    """Track a recording without its camera, and with it: the figures, or the error."""
    dataset, true_px = guessed(recording)
    config = Config.from_dict({"depth": {"name": "dinov2"}})
    indices = range(len(dataset))[:frames]
    try:
        opening, opened_s = _opened(dataset, indices, config)
        tracker, found = _tracked(dataset, indices, config)
        facts = check_camera(dataset, opening, tracker)
        known = open_dataset(recording.sequence, recording.camera_file)
        given = _tracked(known, indices, config)[1] if recording.truths else None
    except SlamdepthError as error:
        return {"error": str(error)}
    return {
        **_figures(facts.best, facts.sigma_log_f, true_px, opening),
        "observed": facts.is_observed,
        "tracked_px": facts.tracked.fx,
        "k1": facts.best.distortion[0],
        "ate_m": _ates_m(recording, found.trajectory),
        "given_ate_m": [] if given is None else _ates_m(recording, given.trajectory),
        "tracked": len(found.trajectory) / len(indices),
        "opening_s": opened_s,
    }


def part(recording: Recording, number: int, parts: int) -> dict[str, Any]:
    """Find the camera of one of ``parts`` stretches of a recording, before it would be tracked."""
    dataset, true_px = guessed(recording)
    config = Config.from_dict({"depth": {"name": "dinov2"}})
    first, last = (round(n * len(dataset) / parts) for n in (number - 1, number))
    try:
        opening, opened_s = _opened(dataset, range(first, last), config)
    except SlamdepthError as error:
        return {"error": str(error)}
    assert opening.prior is not None
    return {
        **_figures(dataset.camera, opening.sigma_log_f, true_px, opening),
        "observed": opening.sigma_log_f != opening.prior.sigma_log_f,
        "length": last - first,
        "opening_s": opened_s,
    }


def _opened(dataset: Dataset, indices: range, config: Config) -> tuple[OpeningCamera, float]:
    start_s = time.perf_counter()
    model = seeded_depth_model("dinov2", config)
    opening = settle_camera(dataset, indices, model, config, lambda state: None, threading.Event())
    return opening, time.perf_counter() - start_s


def _tracked(dataset: Dataset, indices: range, config: Config) -> tuple[Tracker, Reconstruction]:
    model = seeded_depth_model("dinov2", config)
    with Tracker(dataset.camera, model, config) as tracker:
        for index in indices:
            tracker.step(dataset.read(index))
        return tracker, tracker.finish()


def _figures(camera: Camera, sigma: float | None, true_px: float, opening: OpeningCamera) -> dict[str, Any]:
    assert opening.prior is not None
    log_f = math.log(opening.prior.focal_px)
    return {
        "true_px": true_px,
        "found_px": camera.fx,
        "error": math.log(camera.fx / true_px),
        "sigma": sigma,
        "memory": focal_length_of(opening.passes, log_f, opening.prior.sigma_log_f).memory,
        "passes": [asdict(one) for one in opening.passes],
    }


def _ates_m(recording: Recording, found: Trajectory) -> list[float]:
    return [rmse for truth in recording.truths if (rmse := _ate_m(truth, found)) is not None]


def _ate_m(truth: Trajectory, found: Trajectory) -> float | None:
    try:
        return score_trajectory(truth, found).sim3.rmse_m
    except DatasetError:  # too few poses in common
        return None


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Runs and parts as two Markdown tables, and the shares of parts within their deviations."""
    runs = [_run_cells(row) for row in rows if row["part"] is None]
    parts = [row for row in rows if row["part"] is not None]
    text = [markdown_table(_RUN_HEADINGS, runs)] if runs else []
    if parts:
        text += [markdown_table(_PART_HEADINGS, [_part_cells(row) for row in parts]), _coverage(parts)]
    return "\n\n".join(text)


def _coverage(rows: Sequence[dict[str, Any]]) -> str:
    found = [row for row in rows if isinstance(row["error"], float)]
    off = np.abs([row["error"] / row["sigma"] for row in found])
    text = f"{100 * np.mean(off < 1):.0f} % within one deviation, {100 * np.mean(off < 2):.0f} % within two"
    observed = [row["sigma"] for row in found if row["observed"]]
    if observed:
        text += f"; {len(observed)} observed, median deviation {100 * np.median(observed):.1f} %"
    return text


def _run_cells(row: dict[str, Any]) -> list[str]:
    if isinstance(row["error"], str):
        return [row["sequence"], row["error"]]
    return [
        row["sequence"], f"{row['true_px']:.1f}", _found(row), f"{100 * row['error']:+.1f}",
        f"{100 * row['sigma']:.1f}", "yes" if abs(row["error"]) < 2 * row["sigma"] else "no",
        f"{row['tracked_px']:.1f}", _metres(row["ate_m"]), _metres(row["given_ate_m"]),
        f"{100 * row['tracked']:.0f} %", str(len(row["passes"])), f"{row['opening_s']:.0f}",
    ]  # fmt: skip


def _part_cells(row: dict[str, Any]) -> list[str]:
    name = [row["sequence"], row["part"]]
    if isinstance(row["error"], str):
        return [*name, row["error"]]
    return [
        *name, str(row["length"]), _found(row), f"{100 * row['error']:+.1f}", f"{100 * row['sigma']:.1f}",
        f"{row['error'] / row['sigma']:+.1f}", str(len(row["passes"])), f"{row['memory']:.2f}",
    ]  # fmt: skip


def _found(row: dict[str, Any]) -> str:
    return f"{row['found_px']:.1f}" + ("" if row["observed"] else " (not observable)")


def _metres(errors_m: Sequence[float]) -> str:
    return ", ".join(f"{rmse:.4f}" for rmse in errors_m) or "-"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("self_calibration", __doc__)
    add = parser.add_argument
    add("--data", type=Path, metavar="DIR", help="all recordings in this folder whose camera is known")
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="of --data, with commas")
    add("--also", type=Path, nargs="*", default=[], metavar="SEQ", help="further sequences with true poses")
    add("--frames", type=int, metavar="N", help="no more than N frames of each")
    add("--parts", type=int, default=0, metavar="N", help="look at N parts of each, and track none")
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
        for number in range(1, asked.parts + 1) or [None]:
            name = None if number is None else f"{number} of {asked.parts}"
            row = file.find(sequence=recording.name, part=name, frames=asked.frames)
            if row is None:
                if number is None:
                    figures = run(recording, asked.frames)
                else:
                    figures = part(recording, number, asked.parts)
                row = {"sequence": recording.name, "part": name, "frames": asked.frames, **figures}
                file.add(row)
                progress_line(f"{recording.name}: done")
            rows.append(row)
    print(tables(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
