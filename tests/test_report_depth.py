# SPDX-License-Identifier: Apache-2.0
"""The plots of an evaluated depth model."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slamdepth.evaluation.depth_judge import OverDepth
from slamdepth.report import depth as report
from slamdepth.report.depth import SheetRow, write_over_depth, write_sheet


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures instead of their files."""
    figures: list[Any] = []
    monkeypatch.setattr(report, "write_png", lambda figure, path: figures.append(figure))
    return figures


def texts(figure: Any) -> list[str]:
    from matplotlib.text import Text

    figure.canvas.draw()
    return [text.get_text() for text in figure.findobj(Text) if text.get_visible() and text.get_text()]


def judged(pixels: list[int], edges: np.ndarray, bias: float) -> Any:
    ways = ("as_predicted", "sequence_median", "frame_median", "frame_affine")
    errors = tuple(0.1 if n else None for n in pixels)
    biases = tuple(bias if n else None for n in pixels)
    over = OverDepth(
        tuple(edges.tolist()), tuple(pixels), dict.fromkeys(ways, errors), dict.fromkeys(ways, biases)
    )
    return SimpleNamespace(over_depth=over)


@pytest.mark.parametrize(("bias", "ratios"), [(0.0, {"0.9", "1", "1.1"}), (1.5, {"1", "2", "4"})])
def test_errors_over_depth_start_where_there_are_pixels(
    bias: float, ratios: set[str], drawn: list[Any]
) -> None:
    edges = np.geomspace(0.1, 10, 11)
    pixels = [3, 0, 0, 0, 4000, 9000, 8000, 5000, 2, 0]
    write_over_depth(Path("x.png"), {"hall": judged(pixels, edges, bias)}, "network")
    (figure,) = drawn
    figure.canvas.draw()
    errors, ratio, shares = figure.axes
    assert shares.get_xlim() == pytest.approx((edges[4], edges[8]))
    assert np.isfinite(errors.lines[0].get_ydata()).sum() == 4
    for axis, wanted in ((shares.xaxis, {"0.75", "1", "1.5", "2", "3"}), (ratio.yaxis, ratios)):
        low, high = axis.get_view_interval()
        shown = {
            label.get_text()
            for place, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
            if low <= place <= high
        }
        assert wanted <= shown
        assert not axis.get_ticklocs(minor=True).size
    shown_texts = texts(figure)
    assert {"hall", "as predicted", "after each frame's affine fit: factor and shift"} <= set(shown_texts)
    assert "AbsRel: mean of |predicted - sensor| / sensor" in shown_texts


def test_a_sheet_says_what_its_colours_mean(drawn: list[Any]) -> None:
    depth = np.linspace(1, 3, 48 * 64).reshape(48, 64)
    row = SheetRow(np.zeros((48, 64, 3), np.uint8), depth, 1.2 * depth)
    write_sheet(Path("x.png"), [row], "after each frame's median", "network on hall")
    shown_texts = texts(drawn[0])
    for text in (
        "predicted, after each frame's median",
        "its error: red too far, blue too near",
        "error, % (±50: that or more)",
    ):
        assert text in shown_texts
