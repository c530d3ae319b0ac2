# SPDX-License-Identifier: Apache-2.0
"""What an opened sequence is, and what is wrong with it, for ``slamdepth info``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count, pairwise
from typing import Any

import numpy as np

from slamdepth.datasets.addresses import address_of
from slamdepth.datasets.base import Dataset, read_sound
from slamdepth.datasets.intrinsics import Certainty
from slamdepth.datasets.sensor_depth import check_sensor_depth
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError, SourceEnded
from slamdepth.types import Frame

_SAMPLES = 7
_LIVE_SAMPLES = 10
_GAP_INTERVALS = 5.0
"""Frames farther apart than so many usual intervals have a gap between them."""
_FLAT = 2.0
"""Standard deviation of grey values below which an image shows nothing."""
_FEW_FRAMES = 20


@dataclass(frozen=True)
class SequenceSummary:
    """What there is to know of a sequence before a run.

    Attributes:
        facts: by name, for JSON: strings, numbers, lists and None.
        problems: what is wrong with it, one line each.
        notes: what was guessed, dropped or repaired while it was opened.
    """

    facts: dict[str, Any]
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {**self.facts, "problems": list(self.problems), "notes": list(self.notes)}


def summarise(dataset: Dataset) -> SequenceSummary:
    """Look at a sequence: all its times, and a few of its frames."""
    problems: list[str] = []
    frames = _samples(dataset, problems)
    problems += _troubles_of_images(frames)
    times_s = np.asarray(dataset.timestamps_s)
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s)) if len(steps_s) else None
    if not dataset.is_live:
        problems += _troubles_of_times(times_s)
        if len(times_s) < _FEW_FRAMES:
            problems.append(f"only {len(times_s)} frames")
    if dataset.camera_source.certainty is Certainty.GUESSED:
        problems.append("the intrinsics are unknown: pass --camera FILE if you have a calibration")
    camera = dataset.camera
    facts = {
        "name": dataset.name,
        "path": address_of(str(dataset.path)),
        "layout": dataset.layout,
        "live": dataset.is_live,
        "frames": None if dataset.is_live else len(times_s),
        "duration_s": None if dataset.is_live or not len(times_s) else float(times_s[-1] - times_s[0]),
        "rate_hz": 1.0 / usual_s if usual_s else None,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")},
        "distortion": [float(value) for value in camera.distortion],
        "camera_certainty": dataset.camera_source.certainty.value,
        "camera_source": dataset.camera_source.how,
        "ground_truth": _truth(dataset),
        "depth": _depth(dataset, frames, problems),
        "imu": None if dataset.imu_path is None else str(dataset.imu_path),
    }
    return SequenceSummary(facts, tuple(problems), tuple(dataset.notes))


def _samples(dataset: Dataset, problems: list[str]) -> list[Frame]:
    """A few frames; those that do not decode are told of."""
    if dataset.is_live:
        return _first_frames(dataset, problems)
    indices = np.unique(np.linspace(0, len(dataset) - 1, _SAMPLES).round().astype(int)).tolist()
    frames: list[Frame] = []
    broken: list[str] = []
    for index in indices:
        try:
            frame, error = read_sound(dataset, index, with_depth=dataset.has_depth)
        except (ImageDecodeError, CameraError) as trouble:
            broken.append(str(trouble))
            continue
        if error is not None:
            broken.append(str(error))
        frames.append(frame)
    if broken:
        problems.append(f"{len(broken)} of {len(indices)} frames looked at are bad; the first: {broken[0]}")
    return frames


def _first_frames(dataset: Dataset, problems: list[str]) -> list[Frame]:
    frames: list[Frame] = []
    for index in count():
        if len(frames) == _LIVE_SAMPLES:
            return frames
        try:
            frames.append(dataset.read(index))
        except (ImageDecodeError, SourceEnded) as error:
            problems.append(str(error))
            return frames
    return frames


def _troubles_of_images(frames: list[Frame]) -> list[str]:
    flat = [frame.index for frame in frames if float(frame.image_rgb.std()) < _FLAT]
    if not flat:
        return []
    return [f"{len(flat)} of {len(frames)} frames looked at show nothing, such as frame {flat[0]}"]


def _troubles_of_times(times_s: Any) -> list[str]:
    steps_s = np.diff(times_s)
    if not len(steps_s):
        return []
    usual_s = float(np.median(steps_s))
    gaps = np.flatnonzero(steps_s > _GAP_INTERVALS * usual_s)
    if not len(gaps):
        return []
    longest = int(gaps[np.argmax(steps_s[gaps])])
    return [
        f"{len(gaps)} gaps between frames, the longest of {steps_s[longest]:.2f} s after frame {longest} "
        f"(usual: {usual_s:.3f} s)"
    ]


def _truth(dataset: Dataset) -> dict[str, Any] | None:
    truth = dataset.ground_truth
    if truth is None:
        return None
    positions = truth.T_world_camera[:, :3, 3]
    length = sum(float(np.linalg.norm(b - a)) for a, b in pairwise(positions))
    return {
        "poses": len(truth),
        "path_length": length,
        "metric": truth.is_metric,
        "source": dataset.truth_source or "measured by the data set",
    }


def _depth(dataset: Dataset, frames: list[Frame], problems: list[str]) -> dict[str, Any] | None:
    if not dataset.has_depth:
        return None
    try:
        problems += check_sensor_depth(dataset, range(len(dataset)))
    except DatasetError as error:
        problems.append(str(error))
    known = [frame.depth_m[frame.depth_m > 0] for frame in frames if frame.depth_m is not None]
    pixels = sum(frame.depth_m.size for frame in frames if frame.depth_m is not None)
    values = np.concatenate(known) if known else np.zeros(0)
    if not len(values):
        problems.append("no depth in the frames looked at")
        return {"median_m": None, "share_known": 0.0}
    return {"median_m": float(np.median(values)), "share_known": len(values) / pixels}
