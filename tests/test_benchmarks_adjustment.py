# SPDX-License-Identifier: Apache-2.0
"""Adjustment of long maps with exact truth."""

from __future__ import annotations

import pytest

from benchmarks import adjustment
from slamdepth.backend.bundle import bundle_adjust


def test_solved_by_iteration_a_long_map_becomes_as_good_as_factorised() -> None:
    problem, truth = adjustment.corridor(160, points=100)
    whole, iterated = (adjustment.measure(problem, truth, iterative=n) for n in (False, True))
    assert whole.after_m < 0.7 * whole.before_m
    assert iterated.after_m < 1.2 * whole.after_m
    assert iterated.keyframes == 160


def test_a_map_twice_as_long_is_no_other_problem_for_each_keyframe() -> None:
    short, long = (adjustment.corridor(count, points=100)[0] for count in (160, 320))
    per_keyframe = [len(problem.obs_camera) / len(problem.fixed) for problem in (short, long)]
    assert per_keyframe[1] == pytest.approx(per_keyframe[0], rel=0.4)
    assert bundle_adjust(short).inlier.mean() > 0.99


def test_the_command_prints_a_line_for_each_way(capsys: pytest.CaptureFixture[str]) -> None:
    assert adjustment.main(["--keyframes", "12"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert [line.split("|")[4].strip() for line in lines[2:]] == ["factorised", "gradients"]
    with pytest.raises(SystemExit):
        adjustment.main(["--keyframes", "two"])
