# SPDX-License-Identifier: Apache-2.0
"""A plot of accuracy over speed, one panel for each sequence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.tables import by_sequence

_MARKERS = "osD^vPX*<>ph"


def write_plot(path: Path, benchmark: Mapping[str, Any]) -> bool:
    """Draw ATE Sim(3) over frames per second: medians, with bars from the least to the most.

    Returns:
        False, and no file, where no row has both figures.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    panels = {
        sequence: good
        for sequence, rows in by_sequence(benchmark["rows"]).items()
        if (good := [row for row in rows if {"ate_sim3_m", "fps"} <= row["figures"].keys()])
    }
    if not panels:
        return False
    labels = list(dict.fromkeys(row["label"] for rows in panels.values() for row in rows))
    depths = list(dict.fromkeys(row["depth"] for rows in panels.values() for row in rows))
    figure, axes = plt.subplots(
        1, len(panels), figsize=(5.5 * len(panels), 5.5), squeeze=False, layout="constrained"
    )
    for axis, (sequence, rows) in zip(axes[0], panels.items(), strict=True):
        for row in rows:
            (fps, fps_bar), (ate, ate_bar) = (_with_bar(row, key) for key in ("fps", "ate_sim3_m"))
            axis.errorbar(
                fps,
                ate,
                xerr=fps_bar,
                yerr=ate_bar,
                marker=_MARKERS[labels.index(row["label"]) % len(_MARKERS)],
                color=f"C{depths.index(row['depth']) % 10}",
                linestyle="none",
                label=f"{row['label']} [{row['depth']}]",
            )
        axis.set(title=sequence, xlabel="frames per second", ylabel="ATE RMSE, Sim(3), m", yscale="log")
        axis.set_xlim(left=0)
        axis.grid(visible=True, which="both", alpha=0.3)
        axis.legend(fontsize="x-small")
    figure.savefig(path)
    plt.close(figure)
    return True


def _with_bar(row: Mapping[str, Any], key: str) -> tuple[float, list[list[float]]]:
    """The median, and how far below and above it the extremes lie, ``(2, 1)``."""
    median = float(row["figures"][key])
    low, high = row["spread"].get(key, (median, median))
    return median, [[median - low], [high - median]]
