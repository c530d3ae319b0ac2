# SPDX-License-Identifier: Apache-2.0
"""Judged depth for people: a table, a sheet of pictures, and errors over depth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import card_of
from slamdepth.evaluation import DepthJudgement, Interval
from slamdepth.report.figure import new_figure, write_png
from slamdepth.report.pictures import UNKNOWN, near_to_far
from slamdepth.report.text import MISSING, percent

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.table import Table

WAY_NAMES = {
    "as_predicted": "as predicted",
    "sequence_median": "one median",
    "frame_median": "frame median",
    "frame_affine": "frame affine",
}
_FIGURE_NAMES = {
    "abs_rel": ("AbsRel", 3),
    "rmse_m": ("RMSE, m", 3),
    "log_rmse": ("log RMSE", 3),
    "delta1": ("δ < 1.25", 3),
    "delta2": ("δ < 1.25²", 3),
    "delta3": ("δ < 1.25³", 3),
    "ssim": ("SSIM", 3),
    "edge_f1": ("edge F1", 3),
    "edge_error_px": ("edge err., px", 2),
}
_ERROR_SHOWN = 0.5


@dataclass(frozen=True)
class SheetRow:
    """A frame of the picture sheet.

    Attributes:
        image_rgb: ``(H, W, 3)`` uint8.
        sensor_m, predicted_m: ``(H, W)`` metres, 0 where unknown; the latter scaled.
    """

    image_rgb: NDArray[np.uint8]
    sensor_m: NDArray[np.floating]
    predicted_m: NDArray[np.floating]


def with_half(figure: Interval | None, digits: int = 3) -> str:
    """A figure and half of its 95 % interval."""
    if figure is None or not math.isfinite(figure.value):
        return MISSING
    text = f"{figure.value:.{digits}f}"
    if figure.low is None or figure.high is None:
        return text
    return f"{text} ±{(figure.high - figure.low) / 2:.{digits}f}"


def judgement_table(ways: Mapping[str, Mapping[str, Interval]], title: str) -> Table:
    """Figures as rows, ways of scaling as columns; those that do not exist are dashes."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title, style="bold"), title_justify="left", box=box.SIMPLE)
    table.add_column("")
    for name in WAY_NAMES.values():
        table.add_column(name, justify="right")
    for key, (name, digits) in _FIGURE_NAMES.items():
        table.add_row(Text(name), *(with_half(ways.get(way, {}).get(key), digits) for way in WAY_NAMES))
    return table


def model_lines(model: DepthModel) -> list[str]:
    """What a model says of itself: what its numbers mean, what it was trained on, and its files."""
    card = card_of(model)
    about = "" if card is None else f"; learnt from {card.native_size[0]}x{card.native_size[1]} pixels"
    if card is not None and card.native_focal_px is not None:
        about += f" of focal length {card.native_focal_px:.0f} px"
    lines = [f"{model.name}: {model.kind.value}{about}"]
    for info in model.weights:
        lines.append(
            f"weights {info.name}, sha256 {info.sha256}; {info.licence}; trained on {info.trained_on}"
        )
    return lines


def judgement_lines(judgement: DepthJudgement) -> list[str]:
    """What the table does not hold, one sentence each."""
    lines = [
        f"spread of the scale a frame (std of log): {with_half(judgement.scale_spread)}; "
        f"one median: × {judgement.sequence_factor:.3f}; affine: in {judgement.fitted_in}",
        f"{judgement.frames} frames, {percent(judgement.coverage)} of the sensor's pixels; "
        "± is half of the 95 % interval",
    ]
    if judgement.surest_half is not None:
        lines.append(
            f"AbsRel of the surest half over that of all: {with_half(judgement.surest_half)}; "
            f"errors within one sigma: {with_half(judgement.within_one_sigma)} (0.683 if calibrated)"
        )
    return lines


def write_sheet(path: Path, rows: Sequence[SheetRow], scaled: str, title: str) -> None:
    """Image, sensor depth, predicted depth and its relative error, a row a frame, as PNG.

    Args:
        scaled: how ``predicted_m`` was scaled, for the heading.

    Raises:
        OutputError: the file cannot be written.
    """
    depths = near_to_far()
    known = np.concatenate([row.sensor_m[row.sensor_m > 0][::16] for row in rows])
    near, far = np.percentile(known, (1, 98))
    figure, axes = new_figure(13, 2.05 * len(rows) + 0.7, len(rows), 4)
    for line, row in zip(axes, rows, strict=True):
        both = (row.sensor_m > 0) & (row.predicted_m > 0)
        error = np.where(both, row.predicted_m / np.where(both, row.sensor_m, 1.0) - 1.0, np.nan)
        line[0].imshow(row.image_rgb)
        for axis, depth_m in ((line[1], row.sensor_m), (line[2], row.predicted_m)):
            metres = axis.imshow(
                np.where(depth_m > 0, depth_m, np.nan), cmap=depths, vmin=near, vmax=far,
                interpolation="nearest",
            )  # fmt: skip
        share = line[3].imshow(
            100 * error, cmap="RdBu_r", vmin=-100 * _ERROR_SHOWN, vmax=100 * _ERROR_SHOWN,
            interpolation="nearest",
        )  # fmt: skip
        line[3].set_facecolor(UNKNOWN)
        for axis in line:
            axis.set(xticks=[], yticks=[])
    for axis, name in zip(axes[0], ("image", "sensor", f"predicted, {scaled}", "error"), strict=True):
        axis.set_title(name, fontsize=9)
    figure.colorbar(metres, ax=axes[:, 1:3].ravel().tolist(), label="depth, m", shrink=0.8)
    figure.colorbar(share, ax=axes[:, 3].tolist(), label="error, %", shrink=0.8)
    figure.suptitle(title, fontsize=10)
    write_png(figure, path)


def write_over_depth(path: Path, judgements: Mapping[str, DepthJudgement], title: str) -> None:
    """AbsRel and bias over the sensor's depth, a colour a data set, as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.ticker import StrMethodFormatter

    figure, axes = new_figure(8, 8, 3, 1, sharex=True, height_ratios=(3, 2, 1))
    errors, bias, shares = axes[:, 0]
    styles = {"as_predicted": "-", "frame_median": "--", "frame_affine": ":"}
    for colour, (name, judgement) in enumerate(judgements.items()):
        over = judgement.over_depth
        centres = np.sqrt(np.array(over.edges_m[1:]) * np.array(over.edges_m[:-1]))
        for way, style in styles.items():
            if way in over.abs_rel:
                label = f"{name}, {WAY_NAMES[way]}"
                errors.plot(centres, _floats(over.abs_rel[way]), style, color=f"C{colour}", label=label)
                bias.plot(centres, np.exp(_floats(over.log_bias[way])), style, color=f"C{colour}")
        pixels = np.array(over.pixels, dtype=float)
        shares.plot(centres, pixels / pixels.sum(), color=f"C{colour}")
    errors.set(ylabel="AbsRel", xscale="log", ylim=(0, None), title=title)
    errors.legend(fontsize="x-small")
    bias.axhline(1.0, color="grey", lw=0.8)
    bias.set(ylabel="predicted / sensor", yscale="log")
    shares.set(ylabel="share of pixels", xlabel="depth by the sensor, m", ylim=(0, None))
    for axis in (errors, bias, shares):
        axis.grid(visible=True, which="both", alpha=0.3)
    for scale in (shares.xaxis, bias.yaxis):
        scale.set_major_formatter(StrMethodFormatter("{x:g}"))
        scale.set_minor_formatter(StrMethodFormatter("{x:g}"))
    shares.tick_params(axis="x", which="minor", labelsize="x-small")
    bias.tick_params(axis="y", which="minor", labelsize="x-small")
    write_png(figure, path)


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values])
