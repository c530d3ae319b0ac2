# SPDX-License-Identifier: Apache-2.0
"""The time that each stage of a run took, in all."""

from __future__ import annotations

import re

import pytest

from slamdepth.report.speed import speed_caption, speed_plot, stage_times

TIMINGS_MS = {"tracking": 11.0, "finish": 1675.0, "final": 1200.0, "features": 8.0, "depth": float("nan")}
CALLS = {"tracking": 600, "finish": 1, "final": 1, "features": 600, "depth": 3}


def test_stages_are_compared_by_what_they_cost_in_all() -> None:
    times = stage_times(TIMINGS_MS, CALLS, 10.0)
    assert [time.name for time in times] == [
        "tracking frames",
        "extracting features",
        "finishing the run",
        "global bundle adjustment",
    ]
    assert [time.seconds for time in times] == pytest.approx([6.6, 4.8, 1.675, 1.2])
    assert [time.share for time in times] == pytest.approx([0.66, 0.48, 0.1675, 0.12])
    assert times[0].label == "6.60 s · 66.0 % · 600 × 11.0 ms"
    assert times[2].label == "1.68 s · 16.8 % · once"
    # stages within or parallel to another are marked; the others sum to at most the wall time
    assert sum(time.seconds for time in times if not time.is_overlapping) <= 10.0
    assert [time.is_overlapping for time in times] == [False, True, False, True]


def test_a_stage_without_calls_is_left_out_and_an_unknown_wall_time_gives_no_share() -> None:
    (only,) = stage_times({"tracking": 2.0, "bundle": 3.0, "odd_one": 4.0}, {"tracking": 5}, None)
    assert only.label == "0.01 s · 5 × 2.0 ms"
    assert stage_times({"odd_one": 4.0}, {"odd_one": 2}, 1.0)[0].name == "odd one"


def test_the_chart_says_seconds_shares_and_calls() -> None:
    svg = speed_plot(stage_times(TIMINGS_MS, CALLS, 10.0))
    assert svg is not None
    texts = re.findall(r">([^<>]+)</text>", svg)
    for text in ("tracking frames", "6.60 s · 66.0 % · 600 × 11.0 ms", "seconds in all"):
        assert text in texts
    assert "10.0 s" in speed_caption(10.0)
    assert "share" not in speed_caption(None)
