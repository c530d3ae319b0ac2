# SPDX-License-Identifier: Apache-2.0
"""The evaluation of a depth model: a table, a sheet of images, and errors over depth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import card_of
from slamdepth.evaluation import DepthJudgement, Interval
from slamdepth.evaluation.calibration import EXPECTED, Coverage
from slamdepth.report.figure import new_figure, write_png
from slamdepth.report.keyframe_images import UNKNOWN, near_to_far
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
_LEAST_SHARE = 0.001  # of a data set's pixels, for a depth to be drawn
_CURVES = {
    "as_predicted": ("-", "as predicted"),
    "frame_median": ("--", "after each frame's median: one factor"),
    "frame_affine": (":", "after each frame's affine fit: factor and shift"),
}
_DOUBLING = tuple(2.0**k for k in range(-6, 9))
_BETWEEN = tuple(1.5 * place for place in _DOUBLING)
_APART_FROM_ONE = (0.06, 0.12, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 8.0, 16.0)
_AROUND_ONE = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 1.75, 2.0, 2.5)


@dataclass(frozen=True)
class SheetRow:
    """A frame of the sheet of images.

    Attributes:
        image_rgb: ``(H, W, 3)`` uint8.
        sensor_m: ``(H, W)`` measured depth in metres, 0 where unknown.
        predicted_m: ``(H, W)`` predicted depth in metres, scaled, 0 where unknown.
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
    """Figures as rows, ways of scaling as columns; a dash where a figure does not exist."""
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
    """A model in a few lines: what its numbers mean, what it was trained on, and its files."""
    card = card_of(model)
    about = "" if card is None else f"; trained at {card.native_size[0]}x{card.native_size[1]} pixels"
    if card is not None and card.native_focal_px is not None:
        about += f" of focal length {card.native_focal_px:.0f} px"
    lines = [f"{model.name}: {model.kind.value}{about}"]
    for info in model.weights:
        lines.append(
            f"weights {info.name}, sha256 {info.sha256}; {info.licence}; trained on {info.trained_on}"
            + (f"; computes in {info.precision}" if info.precision else "")
        )
    return lines


def judgement_lines(judgement: DepthJudgement) -> list[str]:
    """What :func:`judgement_table` does not show, one sentence each."""
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
    if judgement.scale_coverage is not None:
        lines.append(_scale_line(judgement.scale_coverage))
    return lines


def _scale_line(curve: Coverage) -> str:
    if not curve.known:
        return "scale of every frame: unknown, the images do not look like those the model was trained on"
    one, two = (percent(curve.observed[EXPECTED.index(share)]) for share in (0.6827, 0.9545))
    line = f"scale of a frame within its one sigma: {one} (68 % if calibrated), within two: {two} (95 %)"
    return line if curve.known == 1 else f"{line}; unknown in {percent(1 - curve.known)} of the frames"


def write_sheet(path: Path, rows: Sequence[SheetRow], scaled: str, title: str) -> None:
    """Write image, sensor depth, predicted depth and relative error of each frame, a row each, as PNG.

    Args:
        scaled: how ``predicted_m`` was scaled, for the heading, such as "after each frame's median".

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
    heads = ("image", "sensor", f"predicted, {scaled}", "its error: red too far, blue too near")
    for axis, name in zip(axes[0], heads, strict=True):
        axis.set_title(name, fontsize=9)
    figure.colorbar(metres, ax=axes[:, 1:3].ravel().tolist(), label="depth, m", shrink=0.8)
    figure.colorbar(share, ax=axes[:, 3].tolist(), extend="both", shrink=0.8).set_label(
        f"error, % (±{100 * _ERROR_SHOWN:.0f}: that or more)", fontsize=8
    )
    figure.suptitle(title, fontsize=10)
    write_png(figure, path)


def write_over_depth(path: Path, judgements: Mapping[str, DepthJudgement], title: str) -> None:
    """Plot AbsRel and bias over the sensor's depth, a colour for each data set, as PNG.

    Depths with less than a thousandth of a data set's pixels are left out.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.lines import Line2D

    figure, axes = new_figure(8, 8, 3, 1, sharex=True, height_ratios=(3, 2, 1))
    errors, bias, shares = axes[:, 0]
    drawn: set[str] = set()
    near, far = math.inf, 0.0
    for colour, judgement in enumerate(judgements.values()):
        over = judgement.over_depth
        edges, pixels = np.array(over.edges_m), np.array(over.pixels, dtype=float)
        share = pixels / pixels.sum()
        kept = share >= _LEAST_SHARE
        near, far = min(near, edges[:-1][kept].min()), max(far, edges[1:][kept].max())
        centres = np.sqrt(edges[1:] * edges[:-1])
        for way, (style, _) in _CURVES.items():
            if way in over.abs_rel:
                drawn.add(way)
                error, log_bias = (
                    np.where(kept, _floats(values[way]), np.nan) for values in (over.abs_rel, over.log_bias)
                )
                errors.plot(centres, error, style, color=f"C{colour}")
                bias.plot(centres, np.exp(log_bias), style, color=f"C{colour}")
        shares.plot(centres, share, color=f"C{colour}")
    errors.set(ylabel="AbsRel: mean of |predicted - sensor| / sensor", xscale="log", ylim=(0, None))
    errors.set_title(title)
    errors.legend(
        handles=[
            *(Line2D([], [], color=f"C{colour}", label=name) for colour, name in enumerate(judgements)),
            *(
                Line2D([], [], color="grey", linestyle=style, label=what)
                for way, (style, what) in _CURVES.items()
                if way in drawn
            ),
        ],
        fontsize="x-small",
    )
    bias.axhline(1.0, color="grey", lw=0.8)
    bias.set(ylabel="predicted / sensor\n(above 1: too far)", yscale="log")
    shares.set(ylabel="share of pixels", xlabel="depth by the sensor, m", ylim=(0, None), xlim=(near, far))
    for axis in (errors, bias, shares):
        axis.grid(visible=True, which="major", alpha=0.3)
    ratios = np.concatenate([[0.9, 1.1], *(line.get_ydata() for line in bias.lines)])
    low, high = 0.97 * np.nanmin(ratios), 1.03 * np.nanmax(ratios)
    bias.set_ylim(low, high)
    _set_ticks(shares.xaxis, _DOUBLING if far / near > 16 else sorted((*_DOUBLING, *_BETWEEN)))
    _set_ticks(bias.yaxis, _AROUND_ONE if high / low < 3 else _APART_FROM_ONE)
    write_png(figure, path)


def _set_ticks(axis: Any, places: Sequence[float]) -> None:
    from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

    axis.set_major_locator(FixedLocator(places))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values])
