# SPDX-License-Identifier: Apache-2.0
"""Frames placed in a saved map, and runs that go on from one."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from saved_walk import tracked, walk_until
from tracking_scene import CAMERA, COUNT, frames, walk

from slamdepth import Map, MapLocaliser, Tracker
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import DatasetError, TrackingError
from slamdepth.geometry import invert
from slamdepth.tracking.saved_maps import same_lens
from slamdepth.types import Camera, Frame, TrackingStatus
from slamdepth.typing import Floats

HALF, QUARTER = 44, 16


@pytest.fixture(scope="module")
def half() -> Map:
    return walk_until(HALF)


@lru_cache
def half_with_images() -> Map:
    return tracked(frames(range(HALF)), with_images=True)[2]


def rmse_m(index: list[int], T_world_camera: Floats) -> float:
    return float(np.sqrt((errors_m(index, T_world_camera) ** 2).mean()))


def errors_m(index: list[int], T_world_camera: Floats) -> Floats:
    """Distances of poses in the map's world, which is the first camera of the walk, from the truth."""
    truth = walk()[1][index]
    return np.asarray(np.linalg.norm(T_world_camera[:, :3, 3] - truth[:, :3, 3], axis=1))


def test_frames_are_placed_in_the_map_and_the_map_stays(half: Map) -> None:
    before = {
        (group, name): array.copy() for group, arrays in half.groups.items() for name, array in arrays.items()
    }
    given = frames(range(HALF, HALF + 12))
    with MapLocaliser(half) as localiser:
        inside = localiser._map.map
        state = {name: getattr(inside.landmarks, name).copy() for name in vars(inside.landmarks)}
        results = [localiser.step(frame) for frame in given]
        trajectory = localiser.trajectory()
        assert all(np.array_equal(getattr(inside.landmarks, name), array) for name, array in state.items())
        assert len(inside.keyframes) == len(half)
    assert results[0].status is TrackingStatus.RELOCALISED
    assert len(trajectory) == len(given)
    assert errors_m([frame.index for frame in given], trajectory.T_world_camera).max() < 0.03
    assert all(0.0 < result.quality <= 1.0 for result in results)
    for (group, name), array in before.items():
        np.testing.assert_array_equal(half.groups[group][name], array)


@pytest.mark.parametrize("has_images", [False, True])
def test_frames_that_are_adjusted_together_are_nearer_to_the_truth(has_images: bool) -> None:
    saved = half_with_images()
    given = frames(range(HALF, HALF + 12))
    index = [frame.index for frame in given]
    with MapLocaliser(half_with_images() if has_images else saved.without_images()) as localiser:
        for frame in given:
            localiser.step(frame)
        placed = localiser.trajectory()
        landmarks = localiser._map.map.landmarks.position_w.copy()
        adjusted = localiser.finish()
        np.testing.assert_array_equal(localiser._map.map.landmarks.position_w, landmarks)
        np.testing.assert_array_equal(localiser.trajectory().T_world_camera, adjusted.T_world_camera)
    np.testing.assert_array_equal(adjusted.timestamps_s, placed.timestamps_s)
    before, after = (rmse_m(index, one.T_world_camera) for one in (placed, adjusted))
    assert after < 0.95 * before


def test_images_of_the_map_make_poses_more_exact() -> None:
    saved, given = half_with_images(), frames(range(0, COUNT, 6))
    errors = []
    for one in (saved.without_images(), saved):
        with MapLocaliser(one) as localiser:
            results = {frame.index: localiser.place(frame).T_world_camera for frame in given}
        found = {index: pose for index, pose in results.items() if pose is not None}
        errors.append(np.median(errors_m(list(found), np.stack(list(found.values())))))
    assert errors[1] < 0.8 * errors[0]


def test_a_long_recording_is_adjusted_by_some_of_its_frames(
    half: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    from slamdepth.tracking import frame_adjustment

    given = frames(range(HALF, HALF + 12))
    index = [frame.index for frame in given]
    found = []
    for most in (600, 5):
        monkeypatch.setattr(frame_adjustment, "_MOST", most)
        with MapLocaliser(half) as localiser:
            for frame in given:
                localiser.step(frame)
            found.append(localiser.finish().T_world_camera)
    assert rmse_m(index, found[1]) < 1.5 * rmse_m(index, found[0])


def with_damaged_images(saved: Map, count: int) -> Map:
    """A map whose first ``count`` images do not decode."""
    images = dict(saved.groups["images"])
    images["jpeg"] = images["jpeg"].copy()
    images["jpeg"][: images["first_byte"][count]] = 0
    return replace(saved, groups={**saved.groups, "images": images})


def test_a_damaged_image_of_the_map_is_named_once_and_left_out(caplog: pytest.LogCaptureFixture) -> None:
    saved, given = half_with_images(), frames(range(4))
    every, index = len(saved.groups["images"]["keyframe"]), [frame.index for frame in given]
    poses = []
    for count in (0, 1, every):
        caplog.clear()
        with MapLocaliser(with_damaged_images(saved, count)) as localiser:
            for frame in given:
                localiser.step(frame)
            placed = localiser.finish()
            named = [
                record.message for record in caplog.records if "the map's image of frame" in record.message
            ]
            assert len(named) == len(set(named)) == localiser.damaged_images <= count
            assert (localiser.damaged_images > 0) is (count > 0)
        assert len(placed) == len(given)
        assert rmse_m(index, placed.T_world_camera) < 0.02
        poses.append(placed.T_world_camera)
    assert not np.array_equal(poses[1], poses[2])  # keypoints are still aligned in the other images


def test_a_camera_that_was_scaled_to_the_size_of_the_map_is_that_of_the_map() -> None:
    saved = half_with_images()
    camera = replace(saved.camera, fx=517.3, fy=516.5, cx=318.6, cy=255.3)
    scaled = camera.scaled(4032, 3024).scaled(camera.width, camera.height)
    assert scaled != camera  # by rounding
    assert same_lens(scaled, camera)
    assert not same_lens(replace(camera, fx=camera.fx + 0.01), camera)
    assert not same_lens(replace(camera, width=camera.width + 1), camera)
    again = saved.camera.scaled(4032, 3024).scaled(saved.camera.width, saved.camera.height)
    with MapLocaliser(saved, again) as localiser:
        assert localiser.has_images
    with MapLocaliser(saved, replace(again, fx=again.fx + 1.0)) as localiser:
        assert not localiser.has_images


def test_a_lost_camera_is_found_again(half: Map) -> None:
    def grey(frame: Frame) -> Frame:
        return replace(frame, image_rgb=np.full_like(frame.image_rgb, 90))

    given = [*frames(range(4)), *frames(range(4, 8), grey), *frames(range(20, 24))]
    with MapLocaliser(half) as localiser:
        found = [localiser.step(frame).T_world_camera is not None for frame in given]
    assert found == [True] * 4 + [False] * 4 + [True] * 4


def test_single_images_are_placed_in_any_order(half: Map) -> None:
    given = frames([30, 2, 17])
    with MapLocaliser(half) as localiser:
        results = [localiser.place(frame) for frame in given]
    poses = np.stack([result.T_world_camera for result in results if result.T_world_camera is not None])
    assert errors_m([30, 2, 17], poses).max() < 0.03


def test_another_room_has_no_place(half: Map) -> None:
    from slamdepth.synth.sequence import SynthSettings, render_frames

    settings = SynthSettings(frames=64, width=320, height=240, seed=11)
    given = [frame for frame, _ in render_frames(settings, range(0, 64, 8))]
    with MapLocaliser(half) as localiser:
        assert all(localiser.step(frame).T_world_camera is None for frame in given)
        assert len(localiser.trajectory()) == 0


def test_images_of_another_camera_are_placed_as_well(half: Map) -> None:
    import cv2

    zoomed = Camera(320, 240, CAMERA.fx * 1.25, CAMERA.fy * 1.25, CAMERA.cx, CAMERA.cy)

    def zoom(frame: Frame) -> Frame:
        map_1, map_2 = cv2.initUndistortRectifyMap(
            CAMERA.K, np.zeros(5), np.eye(3), zoomed.K, (320, 240), cv2.CV_32FC1
        )
        image = np.asarray(cv2.remap(frame.image_rgb, map_1, map_2, cv2.INTER_LINEAR), np.uint8)
        return replace(frame, image_rgb=image, camera=zoomed, depth_m=None)

    given = frames(range(10, 20), zoom)
    with MapLocaliser(half, zoomed) as localiser:
        for frame in given:
            localiser.step(frame)
        trajectory = localiser.trajectory()
    assert len(trajectory) == len(given)
    assert errors_m([frame.index for frame in given], trajectory.T_world_camera).max() < 0.03


def test_a_closed_localiser_places_nothing(half: Map) -> None:
    localiser = MapLocaliser(half)
    localiser.close()
    with pytest.raises(TrackingError):
        localiser.step(frames([0])[0])


def test_a_run_goes_on_from_a_map_and_extends_it() -> None:
    begun = walk_until(QUARTER)
    given = frames(range(QUARTER - 4, COUNT))
    tracker, result, grown = tracked(given, begun)
    assert tracker.is_in_start_map
    assert len(result.trajectory) == len(given)
    index = [frame.index for frame in given]
    assert errors_m(index, result.trajectory.T_world_camera).max() < 0.03
    assert len(grown) > len(begun)
    assert [session.name for session in grown.sessions] == ["walk", "walk"]
    assert len(grown.trajectory(0)) == len(begun.trajectory(0))
    assert len(grown.trajectory(1)) == len(given)
    # keyframes of the map are not of this run
    assert {keyframe.frame.index for keyframe in result.keyframes} <= set(index)
    with MapLocaliser(grown) as localiser:
        assert localiser.place(frames([COUNT - 1])[0]).T_world_camera is not None


def test_a_map_that_grows_keeps_the_images_that_it_had() -> None:
    begun = tracked(frames(range(QUARTER)), with_images=True)[2]
    grown = tracked(frames(range(QUARTER - 4, COUNT)), begun, with_images=True)[2]
    was, now = begun.groups["images"], grown.groups["images"]
    assert len(now["keyframe"]) == len(grown)
    old = len(was["jpeg"])
    np.testing.assert_array_equal(now["jpeg"][:old], was["jpeg"])
    assert not tracked(frames(range(QUARTER - 4, COUNT)), begun)[2].has_images


def test_a_run_that_never_meets_its_map_says_so(half: Map) -> None:
    from slamdepth.synth.sequence import SynthSettings, render_frames

    settings = SynthSettings(frames=64, width=320, height=240, seed=11, fps=12.0)
    given = [replace(frame, camera=CAMERA) for frame, _ in render_frames(settings, range(40))]
    tracker, result, alone = tracked(given, half)
    assert not tracker.is_in_start_map
    assert len(result.trajectory) >= 10
    assert len(alone.sessions) == 1
    assert set(alone.groups["keyframes"]["session"].tolist()) == {0}


def test_a_run_with_another_kind_of_depth_or_features_is_refused(half: Map) -> None:
    from tracking_scene import ConstantDepth

    from slamdepth import Config

    with pytest.raises(DatasetError, match="that of a sensor, and this run's would be that of a network"):
        Tracker(CAMERA, ConstantDepth(), start_map=half)
    sift = Config.from_dict({"features": {"name": "sift"}})
    with pytest.raises(DatasetError, match=r"features.name orb, and this run asks for sift"):
        Tracker(CAMERA, SensorDepth(), sift, start_map=half)


def test_the_world_of_a_map_is_its_first_camera(half: Map) -> None:
    np.testing.assert_allclose(half.T_world_camera[0], np.eye(4), atol=1e-9)
    poses = half.trajectory().T_world_camera
    assert errors_m(list(range(HALF)), poses).max() < 0.03
    assert np.isfinite(invert(poses)).all()
