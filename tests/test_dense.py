# SPDX-License-Identifier: Apache-2.0
"""Dense depth of keyframes from many views, on a wall whose depth is known exactly."""

from __future__ import annotations

from dataclasses import replace

import dense_scene as scene
import numpy as np
import pytest
from numpy.typing import NDArray

from slamdepth.dense import EFFORTS, DenseEffort, densify
from slamdepth.errors import ConfigError
from slamdepth.mapping.dense_depth import DenseDepth
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.types import Trajectory

EFFORT = DenseEffort(160, 6, ((0.4, 33),))


def _dense(reconstruction: Reconstruction) -> list[DenseDepth]:
    found = [keyframe.dense for keyframe in reconstruction.keyframes]
    return [one.load() for one in found if one is not None]


def _errors(walk: scene.Walk, dense: list[DenseDepth]) -> NDArray[np.float64]:
    """Absolute log error ``(K, h, w)`` of the depth of all keyframes."""
    truth = [scene.depth_m(kf.T_world_camera[0, 3]) for kf in walk.reconstruction.keyframes]
    return np.array([np.abs(np.log(one.depth_m / true)) for one, true in zip(dense, truth, strict=True)])


def test_depth_is_measured_where_prediction_waves() -> None:
    walk = scene.walk()
    dense = _dense(densify(walk.reconstruction, walk, EFFORT))
    assert len(dense) == 7
    before = np.abs(np.log(walk.error))
    errors = _errors(walk, dense)
    measured = np.array([one.is_measured for one in dense])
    assert measured.mean() > 0.6
    assert np.median(before) > 0.03
    assert np.median(errors[measured]) < 0.004
    assert np.quantile(errors[measured], 0.95) < 0.03


def test_deviation_tells_the_size_of_errors() -> None:
    walk = scene.walk()
    dense = _dense(densify(walk.reconstruction, walk, EFFORT))
    off = _errors(walk, dense) / np.array([one.sigma_log for one in dense])
    assert (off < 1.0).mean() > 0.6
    assert (off < 2.0).mean() > 0.9


def test_nothing_is_measured_on_a_blank_wall_and_prediction_stays() -> None:
    walk = scene.walk(textured=False)
    dense = _dense(densify(walk.reconstruction, walk, EFFORT))
    before = np.abs(np.log(walk.error))
    assert np.median(_errors(walk, dense)) < 1.2 * np.median(before)
    assert min(one.sigma_log.min() for one in dense) > 0.04


def test_sensor_depth_stays_and_its_holes_are_filled_where_views_agree() -> None:
    walk = scene.walk(is_sensor=True)
    dense = _dense(densify(walk.reconstruction, walk, EFFORT))
    given = np.array([kf.prediction.load().values for kf in walk.reconstruction.keyframes])
    depth = np.array([one.depth_m for one in dense])
    measured = np.array([one.is_measured for one in dense])
    known = given > 0
    np.testing.assert_allclose(depth[known], given[known], rtol=1e-3)  # stored to three digits
    assert (measured == (depth > 0)).all()
    filled = measured & ~known
    assert filled[:, :, scene.CAMERA.width // 2 :].mean() > 0.3
    truth = np.array([scene.depth_m(kf.T_world_camera[0, 3]) for kf in walk.reconstruction.keyframes])
    assert np.median(np.abs(np.log(depth[filled] / truth[filled]))) < 0.01


def test_same_input_gives_the_same_bytes() -> None:
    walk = scene.walk()
    first, second = (_dense(densify(walk.reconstruction, walk, EFFORT)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.depth_m.tobytes() == b.depth_m.tobytes()
        assert a.sigma_log.tobytes() == b.sigma_log.tobytes()


def test_images_that_do_not_decode_are_left_out() -> None:
    walk = scene.walk()
    walk.broken = (1, 2, 4, 5, 7, 8)
    dense = _dense(densify(walk.reconstruction, walk, EFFORT))
    measured = np.array([one.is_measured for one in dense])
    assert np.median(_errors(walk, dense)[measured]) < 0.006


def test_keyframe_without_depth_has_no_dense_depth() -> None:
    walk = scene.walk()
    told: list[tuple[int, ...]] = []
    keyframes = list(walk.reconstruction.keyframes)
    keyframes[2] = replace(keyframes[2], in_metres=lambda given: np.zeros_like(given.values))
    made = densify(
        replace(walk.reconstruction, keyframes=tuple(keyframes)),
        walk,
        EFFORT,
        lambda *steps: told.append(steps),
    )
    assert [kf.dense is None for kf in made.keyframes] == [n == 2 for n in range(7)]
    assert told[-1][0] == told[-1][1]


def test_keyframes_of_another_trajectory_are_left_as_they_are() -> None:
    walk = scene.walk()
    other = Trajectory(walk.timestamps_s + 100.0, walk.reconstruction.trajectory.T_world_camera)
    given = replace(walk.reconstruction, trajectory=other)
    assert densify(given, walk, EFFORT) is given


def test_too_little_to_compare_changes_nothing() -> None:
    walk = scene.walk()
    one = replace(walk.reconstruction, keyframes=walk.reconstruction.keyframes[:1])
    assert densify(one, walk, EFFORT) is one


def test_camera_that_stands_still_keeps_its_prediction() -> None:
    walk = scene.walk()
    still = replace(walk.reconstruction.trajectory, T_world_camera=np.tile(np.eye(4), (19, 1, 1)))
    keyframes = tuple(replace(kf, T_world_camera=np.eye(4)) for kf in walk.reconstruction.keyframes)
    made = densify(replace(walk.reconstruction, trajectory=still, keyframes=keyframes), walk, EFFORT)
    given = walk.reconstruction.keyframes[0].prediction.load().values
    np.testing.assert_allclose(_dense(made)[0].depth_m, given, rtol=2e-3)


def test_keyframes_alone_are_views_too() -> None:
    walk = scene.walk()
    dense = _dense(densify(walk.reconstruction, effort=EFFORT))
    measured = np.array([one.is_measured for one in dense])
    assert np.median(_errors(walk, dense)[measured]) < 0.006


def test_unknown_effort_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"effort must be one of fast, best, got 'slow'"):
        densify(scene.walk().reconstruction, effort="slow")


def test_progress_ends_at_its_total() -> None:
    walk = scene.walk()
    told: list[tuple[int, int]] = []
    densify(walk.reconstruction, walk, EFFORT, lambda done, all_: told.append((done, all_)))
    assert told[-1][0] == told[-1][1]
    assert [done for done, _ in told] == list(range(1, len(told) + 1))


def test_depth_follows_the_scale_of_its_map() -> None:
    walk = scene.walk()
    made = densify(walk.reconstruction, walk, EFFORT)
    keyframe = made.keyframes[3]
    twice = keyframe.rescaled(2.0)
    assert keyframe.dense is not None
    assert twice.dense is not None
    np.testing.assert_allclose(twice.dense.load().depth_m, 2.0 * keyframe.dense.load().depth_m)


@pytest.mark.parametrize("name", sorted(EFFORTS))
def test_every_effort_measures(name: str) -> None:
    walk = scene.walk()
    dense = _dense(densify(walk.reconstruction, walk, name))
    measured = np.array([one.is_measured for one in dense])
    assert np.median(_errors(walk, dense)[measured]) < 0.005
