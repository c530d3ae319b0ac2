# SPDX-License-Identifier: Apache-2.0
"""Where the time of a run went."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamdepth.report import figure as fig
from slamdepth.report.text import fixed, percent

_NAMES = {
    "decode": "reading images",
    "features": "finding features",
    "tracking": "placing frames",
    "depth": "depth of keyframes",
    "mapping": "new map points",
    "bundle": "adjusting the map near by",
    "loops": "closing loops",
    "finish": "the end of the run",
    "final": "the end: adjusting all",
}
_BESIDE = ("decode", "features", "final")
_WIDTH = 9.6


@dataclass(frozen=True)
class StageTime:
    """Wall time of one stage over a whole run.

    Attributes:
        name: for people.
        is_beside: measured in another thread, or within another stage: adds nothing to the run.
        share: of the run's wall time, or None where that is unknown.
    """

    name: str
    seconds: float
    calls: int
    share: float | None
    is_beside: bool

    @property
    def told(self) -> str:
        """Seconds, share, calls and milliseconds per call in one line."""
        times = (
            "once" if self.calls == 1 else f"{self.calls} × {fixed(1e3 * self.seconds / self.calls, 1, 'ms')}"
        )
        share = "" if self.share is None else f" · {percent(self.share)}"
        return f"{fixed(self.seconds, 2, 's')}{share} · {times}"


def stage_times(
    timings_ms: dict[str, float], timing_calls: dict[str, int], wall_s: float | None
) -> list[StageTime]:
    """The stages that were measured, the longest first.

    Args:
        timings_ms: mean milliseconds per call of each stage.
        timing_calls: calls of each stage; one without any is left out.
        wall_s: seconds from the first frame to the end of the optimisation.
    """
    times = []
    for stage, ms in timings_ms.items():
        calls = timing_calls.get(stage, 0)
        if calls and math.isfinite(ms):
            seconds = 1e-3 * ms * calls
            name = _NAMES.get(stage, stage.replace("_", " "))
            times.append(
                StageTime(name, seconds, calls, seconds / wall_s if wall_s else None, stage in _BESIDE)
            )
    return sorted(times, key=lambda time: (-time.seconds, time.name))


def speed_plot(times: list[StageTime]) -> str | None:
    """Seconds of each stage as bars, those that add nothing to the run in grey; None without any."""
    if not times:
        return None
    with fig.styled("timings"):
        figure, axes = fig.new_figure(_WIDTH, 0.5 + 0.26 * len(times))
        panel = axes[0, 0]
        seconds = [time.seconds for time in times]
        colours = [fig.MUTED if time.is_beside else fig.ESTIMATE for time in times]
        bars = panel.barh(range(len(times)), seconds, 0.62, color=colours)
        panel.set_yticks(range(len(times)), [time.name for time in times])
        panel.bar_label(bars, labels=[time.told for time in times], padding=4, color=fig.INK)
        panel.set(xlabel="seconds in all", xlim=(0, 1.45 * max(seconds) or 1.0))
        panel.invert_yaxis()
        panel.grid(False, axis="y")
        panel.spines["left"].set_visible(False)
        panel.tick_params(axis="y", length=0, labelcolor=fig.INK)
        return fig.to_svg(figure, "Seconds of each stage in all")


def speed_caption(wall_s: float | None) -> str:
    """What the bars of :func:`speed_plot` are, and what each stage does."""
    of = "" if wall_s is None else f", share of the {wall_s:.1f} s from the first frame to the last result"
    return (
        f"Seconds in all{of}, and calls × time of a call. Depth of keyframes: the prediction or, where a "
        "thread of its own makes it, the wait for it. Adjusting the map near by: bundle adjustment of the "
        "newest keyframes, begun and taken over. The end of the run: bundle adjustment of the whole map, its "
        "scale, and every frame placed once more. Grey adds nothing to the whole: a thread that works ahead "
        "reads images and finds features, and adjusting all is part of the end. What is missing to 100 % is "
        "waiting for images and bookkeeping."
    )
