# SPDX-License-Identifier: Apache-2.0
"""The benchmark of loop closing: which loops are true, and which revisits were found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ring_world import TURN, World

from benchmarks import loops
from benchmarks.loops_closed import ClosedLoop, closed_loops, covisibility
from benchmarks.loops_injected import FalseLoops
from benchmarks.loops_truth import TrueKeyframes, judge_loops, runs, true_keyframes
from slamdepth.datasets import open_dataset
from slamdepth.depth.sensor import SensorDepth
from slamdepth.geometry import se3_exp
from slamdepth.tracking import Tracker
from slamdepth.types import Camera, Trajectory

CAMERA = Camera(320, 240, 320.0, 320.0, 159.5, 119.5)
WALL = np.full((240, 320), 2.0, np.float32)  # 2 m wide in view


def before_a_wall(*x_m: float) -> np.ndarray:
    """Cameras side by side, all looking ahead."""
    T = np.tile(np.eye(4), (len(x_m), 1, 1))
    T[:, 0, 3] = x_m
    return T


def truth_of(*x_m: float, map_scale: float = 1.0, is_metric: bool = True) -> TrueKeyframes:
    """True keyframes along a wall; the map is ``map_scale`` times as large."""
    T, times_s = before_a_wall(*x_m), np.arange(float(len(x_m)))
    T_map = T.copy()
    T_map[:, :3, 3] *= map_scale
    depths = [np.float32(map_scale) * WALL] * len(x_m)
    truths = [Trajectory(times_s, T)]
    return true_keyframes(times_s, T_map, truths, CAMERA, depths, is_metric=is_metric, depth_is_true=False)


def loop(earlier: int, later: int, x_m: float, turned_rad: float = 0.0) -> ClosedLoop:
    return ClosedLoop(earlier, later, se3_exp(np.array([x_m, 0.0, 0.0, 0.0, turned_rad, 0.0])))


def test_a_loop_that_says_the_true_motion_is_true_at_any_scale_of_the_map() -> None:
    for scale in (0.25, 1.0, 4.0):
        truth = truth_of(0.0, 0.5, 5.0, 0.4, map_scale=scale)
        assert truth.scale == pytest.approx(1 / scale)
        assert truth.is_false(loop(0, 3, 0.4 * scale)) is False
        assert truth.is_false(loop(0, 3, 0.8 * scale)) is True
        assert truth.is_false(loop(0, 3, 0.4 * scale, np.radians(12.0))) is True


def test_a_loop_between_two_places_is_false() -> None:
    assert truth_of(0.0, 0.5, 5.0, 5.2).is_false(loop(0, 2, 0.0)) is True
    assert truth_of(0.0, 0.5, 5.0, 5.2).is_false(loop(0, 2, 5.0)) is True  # nothing was seen by both


def test_truth_of_any_scale_is_judged_in_metres_of_the_map() -> None:
    truth = truth_of(0.0, 0.5, 5.0, 0.4, map_scale=0.1, is_metric=False)
    assert truth.limit == pytest.approx(3.0)


def test_a_loop_without_true_poses_is_unknown() -> None:
    T, times_s = before_a_wall(0.0, 0.1, 0.2), np.array([0.0, 1.0, 2.0])
    pieces = [Trajectory(times_s[:1], T[:1]), Trajectory(times_s[1:2], T[1:2])]
    truth = true_keyframes(times_s, T, pieces, CAMERA, [WALL] * 3, is_metric=True, depth_is_true=True)
    assert truth.piece.tolist() == [0, 1, -1]
    assert truth.is_false(loop(0, 2, 0.2)) is None
    assert truth.is_false(loop(0, 1, 0.1)) is None  # the pieces have no common frame


def test_a_place_is_seen_again_only_after_another_one() -> None:
    truth = truth_of(0.0, 0.5, 1.0, 1.0, 0.5, 0.0, 5.0, 0.0)
    again = truth.same_earlier(1, 0.3).any(axis=0)
    assert again.tolist() == [False] * 7 + [True]
    assert not truth.same_earlier(8, 0.3).any()


def test_a_hall_seen_from_its_other_end_is_no_revisit() -> None:
    times_s, T = np.arange(4.0), before_a_wall(0.0, 5.0, 0.0, 0.3)
    opposite = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(70.0), 0.0]))
    T[2] = T[2] @ opposite  # the wall at its back may be in view by its depth alone
    truth = true_keyframes(
        times_s, T, [Trajectory(times_s, T)], CAMERA, [WALL] * 4, is_metric=True, depth_is_true=True
    )
    seen = TrueKeyframes(truth.piece, T, 1.0, truth.limit, np.array([[1, 0, 1, 1], [0, 1, 0, 0]] * 2))
    assert seen.same_earlier(1, 0.3)[0].tolist() == [False, False, False, True]


def test_true_false_and_missed_loops_are_counted() -> None:
    there_and_back = (0.0, 0.5, 5.0, 9.0, 0.2, 0.4, 9.0, 5.0)
    truth = truth_of(*there_and_back)
    nothing = np.zeros((8, 8), dtype=int)
    found = judge_loops([loop(0, 4, 0.2), loop(2, 4, 0.1)], truth, nothing, min_gap=2)
    assert (found["closed"], found["true"], found["false"], found["unknown"]) == (2, 1, 1, 0)
    assert found["false_loops"] == [[2, 4]]
    assert found["revisits"] == 1  # frames 4 to 7 each see an earlier place
    assert (found["by_loop"], found["found"]) == (1, 1)
    missed = judge_loops([loop(2, 4, 0.1)], truth, nothing, min_gap=2)
    assert (missed["by_loop"], missed["found"], missed["linked"]) == (0, 0, 0)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_injected_false_loops_are_offered_as_often_as_asked_and_refused(is_sensor: bool) -> None:
    world = World(TURN - 1, turn_drift=0.002, is_sensor=is_sensor, alone=True)
    false = FalseLoops(world.closer, world.map, 0.5, seed=0)
    for _ in range(TURN):
        world.grow()
    assert 5 <= len(false.pairs) <= 13
    closed = {(loop.edge.i, loop.edge.j) for loop in world.closer._loops}
    assert closed
    assert not closed & set(false.pairs)
    assert world.closer.refused >= len(false.pairs)
    assert world.turn_errors_rad().max() < 0.04


def test_tracking_finds_a_revisit_by_shared_landmarks() -> None:
    truth = truth_of(0.0, 0.5, 5.0, 9.0, 0.2, 0.4)
    shared = np.zeros((6, 6), dtype=int)
    shared[0, 4] = shared[4, 0] = 50
    found = judge_loops([], truth, shared, min_gap=2)
    assert (found["by_loop"], found["found"], found["linked"], found["seen_again"]) == (0, 1, 1, 2)
    shared[:] = 0
    shared[3, 4] = shared[4, 3] = 50  # of another place
    assert judge_loops([], truth, shared, min_gap=2)["found"] == 0


def test_runs_bridge_short_gaps_only() -> None:
    assert [run.tolist() for run in runs(np.array([3, 4, 6, 10, 11]))] == [[3, 4, 6], [10, 11]]
    assert runs(np.array([], dtype=int)) == []


def test_a_finished_tracker_tells_its_loops(tiny_room: Path) -> None:
    dataset = open_dataset(tiny_room)
    with Tracker(dataset.camera, SensorDepth()) as tracker:
        for frame in dataset:
            tracker.step(frame)
        tracker._active.integration.loops.refused += 2
        found = tracker.finish()
    assert closed_loops(tracker, range(len(found.keyframes))) == []
    assert found.statistics.loops_refused == 2
    assert covisibility(tracker, range(len(found.keyframes))).shape == (
        len(found.keyframes),
        len(found.keyframes),
    )


def test_a_room_is_rendered_run_with_and_without_loops_and_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "loops.json"
    small = ["--frames", "24", "--width", "160", "--height", "120"]
    wanted = ["--seeds", "1", *small, "--depth", "sensor", "--work", str(tmp_path), "-o", str(output)]
    assert loops.main(wanted) == 0
    rows = json.loads(output.read_text(encoding="utf-8"))["rows"]
    assert [(row["sequence"], row["depth"], row["loops"]) for row in rows] == [
        ("aliased-1-160x120-24", "sensor", "on"), ("aliased-1-160x120-24", "sensor", "off")
    ]  # fmt: skip
    assert rows[0]["false"] == 0
    printed = capsys.readouterr()
    assert "| aliased-1-160x120-24 | sensor | 0 | 100.0 |" in printed.out
    assert loops.main(wanted) == 0
    again = capsys.readouterr()
    assert again.out == printed.out
    assert "done" not in again.err


def test_nothing_to_run_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert loops.main(["--seeds", ""]) != 0
    assert capsys.readouterr().err == "error: nothing to run: name seeds, sequences or --data\n"
