# SPDX-License-Identifier: Apache-2.0
"""The time that each stage of a run took."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamdepth.report import figure as fig
from slamdepth.report.text import fixed, percent

_NAMES = {
    "decode": "reading images",
    "features": "extracting features",
    "tracking": "tracking frames",
    "uncertainty": "covariance of poses",
    "depth": "depth of keyframes",
    "mapping": "creating landmarks",
    "bundle": "local bundle adjustment",
    "loops": "loop closure",
    "finish": "finishing the run",
    "final": "global bundle adjustment",
}
_OVERLAPPING = ("decode", "features", "final")
_WIDTH = 9.6


@dataclass(frozen=True)
class StageTime:
    """Wall time of one stage over a whole run.

    Attributes:
        name: for people.
        seconds: in all.
        calls: how often it was called.
        share: of the run's wall time, or None where that is unknown.
        is_overlapping: True where it ran in parallel in another thread, or within another stage, so that
            it adds nothing to the wall time.
    """

    name: str
    seconds: float
    calls: int
    share: float | None
    is_overlapping: bool

    @property
    def label(self) -> str:
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
                StageTime(name, seconds, calls, seconds / wall_s if wall_s else None, stage in _OVERLAPPING)
            )
    return sorted(times, key=lambda time: (-time.seconds, time.name))


def speed_plot(times: list[StageTime]) -> str | None:
    """Seconds of each stage as bars, overlapping stages in grey; None without any stage."""
    if not times:
        return None
    with fig.styled("timings"):
        figure, axes = fig.new_figure(_WIDTH, 0.5 + 0.26 * len(times))
        panel = axes[0, 0]
        seconds = [time.seconds for time in times]
        colours = [fig.MUTED if time.is_overlapping else fig.ESTIMATE for time in times]
        bars = panel.barh(range(len(times)), seconds, 0.62, color=colours)
        panel.set_yticks(range(len(times)), [time.name for time in times])
        panel.bar_label(bars, labels=[time.label for time in times], padding=4, color=fig.INK)
        panel.set(xlabel="seconds in all", xlim=(0, 1.45 * max(seconds) or 1.0))
        panel.invert_yaxis()
        panel.grid(False, axis="y")
        panel.spines["left"].set_visible(False)
        panel.tick_params(axis="y", length=0, labelcolor=fig.INK)
        return fig.to_svg(figure, "Seconds of each stage in all")


def speed_caption(wall_s: float | None) -> str:
    """The caption of :func:`speed_plot`: what the bars are, and what each stage does."""
    of = "" if wall_s is None else f", share of the {wall_s:.1f} s from the first frame to the last result"
    return (
        f"Seconds in all{of}, and calls × time per call. Depth of keyframes: the prediction or, where it is "
        "made in a thread of its own, the wait for it. Local bundle adjustment: starting it for the newest "
        "keyframes and applying its result. Finishing the run: global bundle adjustment, scale, and the "
        "final pose of every frame. Grey adds nothing to the total: another thread reads images and extracts "
        "features ahead, and global bundle adjustment is part of finishing. The rest to 100 % is waiting for "
        "images and bookkeeping."
    )
