# SPDX-License-Identifier: Apache-2.0
"""A plot of the calibration of a depth model: expected against observed coverage."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slamdepth.evaluation import DepthJudgement
from slamdepth.evaluation.calibration import EXPECTED, Coverage
from slamdepth.report.figure import new_figure, write_png

_KINDS = (
    ("pixel_coverage", "depth of a pixel, after each frame's median"),
    ("scale_coverage", "scale of an image"),
)


def write_calibration(path: Path, judgements: Mapping[str, DepthJudgement], title: str) -> bool:
    """Plot expected against observed coverage of pixels and of scales, a colour for each data set, as PNG.

    Returns:
        False, and nothing is written, where no judgement has an uncertainty.

    Raises:
        OutputError: the file cannot be written.
    """
    curves = {
        kind: {name: curve for name, judged in judgements.items() if (curve := getattr(judged, kind))}
        for kind, _ in _KINDS
    }
    if not any(curves.values()):
        return False
    figure, axes = new_figure(10, 5, 1, 2)
    for axis, (kind, what) in zip(axes[0], _KINDS, strict=True):
        axis.plot([0, 1], [0, 1], color="grey", lw=0.8)
        for colour, name in enumerate(judgements):
            if (curve := curves[kind].get(name)) is not None:
                label = f"{name}{_unknown(curve)}"
                axis.plot(EXPECTED, curve.observed, ".-", color=f"C{colour}", label=label)
        axis.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel="expected coverage", title=what)
        axis.grid(visible=True, alpha=0.3)
        if curves[kind]:
            axis.legend(fontsize="x-small")
    axes[0][0].set_ylabel("observed coverage\n(below the line: sigma is too small)")
    figure.suptitle(title, fontsize=10)
    write_png(figure, path)
    return True


def _unknown(curve: Coverage) -> str:
    return "" if curve.known == 1 else f" ({1 - curve.known:.0%} of its images: scale unknown)"
