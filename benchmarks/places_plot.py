# SPDX-License-Identifier: Apache-2.0
"""A plot of precision over recall, one panel for each sequence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import by_sequence


def write_precision_recall(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw one curve for each method; a method with a single score is a dot."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    panels = by_sequence(rows)
    figure, axes = plt.subplots(
        1, len(panels), figsize=(5.5 * len(panels), 5.5), squeeze=False, layout="constrained"
    )
    for axis, (sequence, methods) in zip(axes[0], panels.items(), strict=True):
        for row in methods:
            recall, precision = ([point[k] for point in row["curve"]] for k in (0, 1))
            axis.plot(recall, precision, marker=".", label=row["method"])
        axis.set(title=sequence, xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize="x-small")
    figure.savefig(path)
    plt.close(figure)
