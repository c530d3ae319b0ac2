# SPDX-License-Identifier: Apache-2.0
"""Depth models judged against sensor depth: one file for each model and data set, and a table."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table
from benchmarks.record import environment, write_benchmark
from slamdepth.depth.base import DepthModel
from slamdepth.depth.evaluate import judge_depth
from slamdepth.errors import DatasetError
from slamdepth.evaluation.depth_fit import fitted_to_sensor
from slamdepth.io import replacing
from slamdepth.pipeline.depth_data import open_depth_data, readable, shown, thinned
from slamdepth.training.data import Place
from slamdepth.types import DepthPrediction, Frame
from slamdepth.typing import Floats

_COLUMNS = (
    ("AbsRel as predicted", "as_predicted", "abs_rel", 3),
    ("one median", "sequence_median", "abs_rel", 3),
    ("frame median", "frame_median", "abs_rel", 3),
    ("frame affine", "frame_affine", "abs_rel", 3),
    ("delta1 (frame median)", "frame_median", "delta1", 3),
    ("SSIM (frame median)", "frame_median", "ssim", 3),
    ("edge F1", "frame_median", "edge_f1", 3),
    ("edge err. px", "frame_median", "edge_error_px", 2),
)
_SPREAD = (
    ("scale spread", "scale_spread", 3),
    ("surest half", "surest_half", 2),
    ("within 1 sigma", "within_one_sigma", 2),
    ("time, ms", "predict_ms", 0),
)
_MISSING = "-"


def judged_row(
    file: Path,
    label: str,
    make: Callable[[], DepthModel],
    data: Path | Place,
    settings: Mapping[str, Any],
    *,
    stride: int | None = None,
    max_frames: int | None = None,
    pictures: int = 0,
) -> dict[str, Any]:
    """Judge a model on ``data``, or read the figures of an earlier call with the same settings.

    Args:
        file: where the figures of this model and data set are kept.
        make: called if the figures have to be computed.
        data: a folder of one data set, or a data set.
        settings: everything else that decides the figures.
        stride: every Nth frame; None: 10 of a sequence, 1 of training pairs.
        pictures: predictions of that many frames are kept for :func:`kept_predictions`.

    Raises:
        DatasetError: ``data`` has no depth, or is a folder of several data sets.
    """
    about = {"data": data.name, "stride": stride, "max_frames": max_frames, "pictures": pictures}
    settings = {**settings, **about} if isinstance(data, Path) else {
        **settings, **about, "fingerprint": data.fingerprint,
    }  # fmt: skip
    kept_file = file.with_suffix(".npz")
    row = _read(file, settings)
    if row is not None and (not pictures or kept_file.is_file()):
        return row
    model = _Timed(make())
    place = only_place(data) if isinstance(data, Path) else data
    chosen = thinned(place, stride, max_frames)
    wanted = shown(chosen, pictures)
    kept: dict[str, Any] = {}

    def watch(frame: Frame, prediction: DepthPrediction) -> None:
        if frame.index in wanted and frame.depth_m is not None:
            kept[str(frame.index)] = fitted_to_sensor(prediction.values, prediction.kind, frame.depth_m)

    figures = judge_depth(model, readable(place, chosen), watch=watch).to_dict()
    figures["predict_ms"] = model.figure()
    del figures["per_frame"], figures["over_depth"]  # `slamdepth eval-depth` writes them
    weights = [asdict(info) for info in model.weights]
    file.parent.mkdir(parents=True, exist_ok=True)
    if pictures:
        with replacing(kept_file) as partial, partial.open("wb") as opened:
            np.savez_compressed(opened, **kept)
    write_benchmark(file, environment(), settings, rows=[{"model": label, "weights": weights, **figures}])
    row = _read(file, settings)
    assert row is not None
    return row


def only_place(data: Path) -> Place:
    """The one data set in a folder.

    Raises:
        DatasetError: there is none with depth, or there are several.
    """
    places = open_depth_data(data)
    if len(places) != 1:
        raise DatasetError(f"{data}: holds {len(places)} data sets; name one of them")
    return places[0]


def kept_predictions(file: Path) -> dict[int, Floats]:
    """Predictions ``(H, W)`` in metres, each scaled by its frame's median, by the index of the frame.

    Args:
        file: the one that :func:`judged_row` wrote.
    """
    with np.load(file.with_suffix(".npz")) as kept:
        return {int(index): kept[index] for index in kept.files}


class _Timed:
    """A depth model that measures the time of its predictions."""

    def __init__(self, model: DepthModel) -> None:
        self.name, self.kind, self.weights = model.name, model.kind, model.weights
        self._model = model
        self._times_ms: list[float] = []

    def predict(self, frame: Frame) -> DepthPrediction:
        """The model's prediction."""
        begun = time.perf_counter()
        prediction = self._model.predict(frame)
        self._times_ms.append(1e3 * (time.perf_counter() - begun))
        return prediction

    def figure(self) -> dict[str, float]:
        """Median and quartiles in milliseconds."""
        low, middle, high = np.percentile(self._times_ms, (25, 50, 75)).tolist()
        return {"value": middle, "low": low, "high": high}


def _read(file: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """The row of a finished judgement; None if there is none with these settings."""
    try:
        written = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(written, dict) or written.get("settings") != json.loads(json.dumps(settings)):
        return None
    row: dict[str, Any] = {"data": settings["data"], **written["rows"][0]}
    return row


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as Markdown; ± is half of the 95 % interval over frames, of times half of the distance between
    the quartiles."""
    headings = ["model", "judged on", "frames", *(name for name, *_ in (*_COLUMNS, *_SPREAD))]
    lines = []
    for row in rows:
        cells = [_cell(row["ways"].get(way, {}).get(key), digits) for _, way, key, digits in _COLUMNS]
        cells += [_cell(row[key], digits) for _, key, digits in _SPREAD]
        lines.append([row["model"], row["data"], str(row["frames"]), *cells])
    return markdown_table(headings, lines)


def mean_row(label: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The mean over data sets, each of which counts the same; without intervals."""

    def mean(found: Sequence[Any]) -> dict[str, Any] | None:
        values = [figure["value"] for figure in found if figure is not None and figure["value"] is not None]
        return {"value": sum(values) / len(values)} if len(values) == len(rows) else None

    ways = {
        way: {key: mean([row["ways"].get(way, {}).get(key) for row in rows]) for key in figures}
        for way, figures in rows[0]["ways"].items()
    }
    return {
        "model": label,
        "data": f"mean of {len(rows)}",
        "frames": sum(row["frames"] for row in rows),
        "ways": ways,
        **{key: mean([row[key] for row in rows]) for _, key, _ in _SPREAD},
    }


def _cell(figure: Mapping[str, float | None] | None, digits: int) -> str:
    if figure is None or (value := figure.get("value")) is None:
        return _MISSING
    text = f"{value:.{digits}f}"
    low, high = figure.get("low"), figure.get("high")
    return text if low is None or high is None else f"{text} ±{(high - low) / 2:.{digits}f}"
