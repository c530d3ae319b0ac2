# SPDX-License-Identifier: Apache-2.0
"""Several maps of one run: started where the camera stays lost, found again, and joined where they meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracking_scene import (
    CONFIG,
    SETTINGS,
    ConstantDepth,
    Run,
    colour_only,
    errors_m,
    frames,
    played,
    walk,
)

from slamdepth.config import Config, merge
from slamdepth.geometry import umeyama
from slamdepth.types import Frame, StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Floats

BLACK = 36  # frames: more than a second
LOST = TrackingStatus.LOST


def black(frame: Frame) -> Frame:
    return replace(frame, image_rgb=np.zeros_like(frame.image_rgb), depth_m=None)


def mirrored(frame: Frame) -> Frame:
    """Another place: nothing in it looks like the room."""
    assert frame.depth_m is not None
    return replace(frame, image_rgb=frame.image_rgb[:, ::-1].copy(), depth_m=frame.depth_m[:, ::-1].copy())


def there_and_back() -> list[Frame]:
    """The start of the walk, darkness, and from its middle back to the start."""
    return [*frames(range(16)), *[black(f) for f in frames([0] * BLACK)], *frames(range(44, 4, -1))]


def unrecognised_at_first(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    """Let no single frame be found in the first map, as where the view has changed too much."""
    for way in ("by_place", "by_registration"):
        monkeypatch.setattr(run.slam._atlas.active.relocaliser, way, lambda *_, **__: None)


def steps(run: Run, given: list[Frame]) -> list[StepResult]:
    run.results += [run.tracker.step(frame) for frame in given]
    return run.results


def sim3_error_m(trajectory: Trajectory, order: list[int]) -> tuple[float, float]:
    """Largest error after alignment with scale, and the scale; ``order`` are the frames of the walk."""
    n = np.rint(trajectory.timestamps_s * SETTINGS.fps).astype(int)
    truth, estimate = (T[:, :3, 3] for T in (walk()[1][[order[k] for k in n]], trajectory.T_world_camera))
    scale, R, t = umeyama(estimate, truth, with_scale=True)
    error: Floats = np.linalg.norm(scale * estimate @ R.T + t - truth, axis=1)
    return float(error.max()), scale


@pytest.mark.parametrize("predicted", [False, True])
def test_maps_that_meet_become_one(predicted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    given = played(there_and_back())
    run = Run([], ConstantDepth(depth_m=1.9, sigma_log=0.3)) if predicted else Run([])
    unrecognised_at_first(monkeypatch, run)
    results = steps(run, [colour_only(f) for f in given] if predicted else given)
    assert [r.map_id for r in results[16 + BLACK : 16 + BLACK + 3]] == [1, 1, 1]
    assert results[-1].map_id == 0
    assert [r.status for r in results].count(LOST) == BLACK
    made = run.finish()
    assert (made.statistics.maps_joined, len(made.others)) == (1, 0)
    assert made.statistics.tracked == len(given) - BLACK
    error_m, scale = sim3_error_m(made.trajectory, [f.index for f in given])
    assert error_m < (0.08 if predicted else 0.03)
    assert predicted or scale == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(made.trajectory.T_world_camera[0], np.eye(4), atol=1e-3)
    times_s = [keyframe.frame.timestamp_s for keyframe in made.keyframes]
    assert times_s == sorted(times_s)
    assert [keyframe.id for keyframe in made.keyframes] == list(range(len(times_s)))


def test_the_same_run_twice_joins_the_same_way(monkeypatch: pytest.MonkeyPatch) -> None:
    trajectories = []
    for _ in range(2):
        run = Run([])
        unrecognised_at_first(monkeypatch, run)
        steps(run, played(there_and_back()))
        trajectories.append(run.finish().trajectory.T_world_camera)
    np.testing.assert_array_equal(trajectories[0], trajectories[1])


def test_another_place_is_a_map_of_its_own() -> None:
    """Two seconds in the dark, elsewhere, and a cut back to the start: every visible frame is placed."""
    order = [*range(24), *[24] * 60, *range(24), *range(20, 44)]
    given = played(frames(order))
    given[24:84] = [black(f) for f in given[24:84]]
    given[84:108] = [mirrored(f) for f in given[84:108]]
    run = Run(given)
    placed = [r.T_world_camera is not None for r in run.results]
    assert placed == [not 24 <= k < 84 for k in range(len(given))]
    assert [r.map_id for r in run.results] == [0] * 84 + [1] * 24 + [0] * 24
    at_home = [r for r in run.results if r.map_id == 0]
    assert errors_m(at_home).max() < 0.05
    made = run.finish()
    assert (made.statistics.tracked, made.statistics.maps_joined) == (48, 0)
    (other,) = made.others
    assert other.statistics.tracked == 24
    assert other.trajectory.timestamps_s[0] == given[84].timestamp_s
    assert any("2 separate maps" in note for note in made.notes)


def test_a_single_map_stays_lost_elsewhere() -> None:
    config = Config.from_dict(merge(CONFIG.model_dump(), {"tracking": {"new_maps": False}}))
    given = played(frames([*range(16), *[16] * BLACK, *range(8)]))
    given[16:] = [*[black(f) for f in given[16 : 16 + BLACK]], *[mirrored(f) for f in given[16 + BLACK :]]]
    run = Run(given, config=config)
    assert [r.status for r in run.results[16:]] == [LOST] * (BLACK + 8)
    assert run.finish().others == ()


def test_a_young_map_that_fails_is_left_at_once_and_not_kept() -> None:
    """After four frames the recording is cut to another place: the second map needs no second's wait."""
    given = played(frames([*range(4), *range(20)]))
    given[4:] = [mirrored(f) for f in given[4:]]
    run = Run(given)
    assert [r.map_id for r in run.results] == [0] * 4 + [1] * 20
    assert all(r.T_world_camera is not None for r in run.results)
    made = run.finish()
    assert (made.statistics.tracked, made.others) == (20, ())
    assert any("4 frames lie in maps too small" in note for note in made.notes)


def test_a_map_waits_a_second_for_the_camera() -> None:
    given = played(frames([*range(16), *range(40)]))
    given[16:] = [mirrored(f) for f in given[16:]]
    results = Run(given).results
    statuses = [r.status is LOST for r in results[16:]]
    assert statuses == [True] * 30 + [False] * 10  # 30 frames a second


def test_poses_of_the_map_that_was_joined_are_in_the_older_ones_metres(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With depth three tenths too small in the second map, its path grows when it meets the first."""
    run = Run([], ConstantDepth(depth_m=1.9, sigma_log=0.3))
    unrecognised_at_first(monkeypatch, run)
    given = [colour_only(f) for f in played(there_and_back())]
    steps(run, given[: 16 + BLACK])
    run.slam._workers.depth._model.depth_m = 1.3  # type: ignore[attr-defined]
    results = steps(run, given[16 + BLACK :])
    joined = next(n for n in range(16 + BLACK, len(given)) if results[n].map_id == 0)
    first = path_scale(results[0], results[15])
    assert path_scale(results[joined], results[-1]) == pytest.approx(first, rel=0.15)
    assert path_scale(results[16 + BLACK], results[joined - 1]) < 0.8 * first


def path_scale(start: StepResult, end: StepResult) -> float:
    """Metres of the map between two frames that a true metre is."""
    assert start.T_world_camera is not None
    assert end.T_world_camera is not None
    true_m = np.linalg.norm(np.diff(walk()[1][[start.index, end.index], :3, 3], axis=0))
    return float(np.linalg.norm((end.T_world_camera - start.T_world_camera)[:3, 3]) / true_m)
