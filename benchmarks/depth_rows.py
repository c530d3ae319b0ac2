# SPDX-License-Identifier: Apache-2.0
"""A judged model on one data set as a file, made once, and such files as a table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.markdown import markdown_table
from benchmarks.summary import environment
from slamdepth.depth.base import DepthModel
from slamdepth.depth.evaluate import judge_depth
from slamdepth.errors import DatasetError
from slamdepth.io import write_json
from slamdepth.pipeline.depth_data import open_depth_data, readable, thinned

_COLUMNS = (
    ("AbsRel as predicted", "as_predicted", "abs_rel", 3),
    ("one median", "sequence_median", "abs_rel", 3),
    ("frame median", "frame_median", "abs_rel", 3),
    ("frame affine", "frame_affine", "abs_rel", 3),
    ("delta1 (frame median)", "frame_median", "delta1", 3),
    ("RMSE m (frame median)", "frame_median", "rmse_m", 3),
    ("log RMSE (frame median)", "frame_median", "log_rmse", 3),
    ("SSIM (frame median)", "frame_median", "ssim", 3),
    ("edge F1", "frame_median", "edge_f1", 3),
    ("edge err. px", "frame_median", "edge_error_px", 2),
)
_MISSING = "-"


def read_row(file: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """What an earlier, finished call wrote, if its settings were these."""
    try:
        row = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = isinstance(row, dict) and row.get("settings") == json.loads(json.dumps(settings))
    return row if same else None


def judged_row(
    file: Path,
    label: str,
    model: Callable[[], DepthModel],
    data: Path,
    settings: Mapping[str, Any],
    *,
    stride: int | None = None,
    max_frames: int | None = None,
) -> dict[str, Any]:
    """Judge a model on ``data``, or read what was judged before with the same settings.

    Args:
        file: of the figures, one a model and data set.
        settings: everything else that decides the figures; kept in the file.

    Raises:
        DatasetError: ``data`` holds no depth, or several data sets.
    """
    settings = {**settings, "data": data.name, "stride": stride, "max_frames": max_frames}
    row = read_row(file, settings)
    if row is None:
        network = model()
        places = open_depth_data(data)
        if len(places) != 1:
            raise DatasetError(f"{data}: holds {len(places)} data sets; name one of them")
        judged = judge_depth(network, readable(places[0], thinned(places[0], stride, max_frames)))
        weights = [asdict(info) for info in network.weights]
        row = {
            "model": label, "settings": settings, "environment": environment(), "weights": weights,
            **judged.to_dict(),
        }  # fmt: skip
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, row)
        row = json.loads(file.read_text(encoding="utf-8"))
    return row


def table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as Markdown; ± is half of the 95 % interval over frames."""
    headings = ["model", "judged on", "frames", *(name for name, *_ in _COLUMNS)]
    headings += ["scale spread", "surest half"]
    lines = []
    for row in rows:
        cells = [_cell(row["ways"].get(way, {}).get(key), digits) for _, way, key, digits in _COLUMNS]
        more = [_cell(row["scale_spread"], 3), _cell(row["surest_half"], 2)]
        about = [row["model"], row["settings"]["data"], str(row["frames"])]
        lines.append([*about, *cells, *more])
    return markdown_table(headings, lines)


def mean_row(label: str, rows: list[Mapping[str, Any]]) -> dict[str, Any]:
    """The mean over data sets, each of which counts the same; without intervals."""

    def mean(found: list[Any]) -> dict[str, Any] | None:
        values = [figure["value"] for figure in found if figure is not None and figure["value"] is not None]
        return {"value": sum(values) / len(values)} if len(values) == len(rows) else None

    ways = {
        way: {key: mean([row["ways"].get(way, {}).get(key) for row in rows]) for key in figures}
        for way, figures in rows[0]["ways"].items()
    }
    return {
        "model": label,
        "settings": {"data": f"mean of {len(rows)}"},
        "frames": sum(row["frames"] for row in rows),
        "ways": ways,
        "scale_spread": mean([row["scale_spread"] for row in rows]),
        "surest_half": mean([row["surest_half"] for row in rows]),
    }


def _cell(figure: Mapping[str, float | None] | None, digits: int) -> str:
    if figure is None or figure.get("value") is None:
        return _MISSING
    text = f"{figure['value']:.{digits}f}"
    low, high = figure.get("low"), figure.get("high")
    return text if low is None or high is None else f"{text} ±{(high - low) / 2:.{digits}f}"
