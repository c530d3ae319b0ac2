# SPDX-License-Identifier: Apache-2.0
"""Images that repeat the one before, as webcams give where one comes too late."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from tracking_scene import CONFIG, Run, colour_only, covered, frames, poses_of, walk

from slamdepth.depth.sensor import SensorDepth
from slamdepth.frontend.repeated_images import has_same_depth, is_repeated
from slamdepth.io.tree import flattened, restored
from slamdepth.tracking import Tracker
from slamdepth.types import Frame, TrackingStatus

EVERY = 7  # frames, the last of which is repeated


def with_repeats(given: list[Frame]) -> list[Frame]:
    """Each ``EVERY``-th image comes twice, the second time halfway to the next."""
    half_s = 0.5 * (given[1].timestamp_s - given[0].timestamp_s)
    doubled: list[Frame] = []
    for n, frame in enumerate(given):
        doubled.append(frame)
        if n % EVERY == EVERY - 1:
            doubled.append(replace(frame, timestamp_s=frame.timestamp_s + half_s))
    return [replace(frame, index=n) for n, frame in enumerate(doubled)]


def test_a_copy_is_repeated_and_the_next_image_of_a_walk_is_not() -> None:
    images = [frame.image_rgb for frame in walk()[0]]
    assert all(is_repeated(image, image.copy()) for image in images[::8])
    assert not any(map(is_repeated, images[1:], images[:-1]))


@pytest.mark.parametrize("bare", [False, True])
def test_a_shift_of_a_pixel_and_the_noise_of_a_sensor_are_not_repeated(bare: bool) -> None:
    image = walk(bare=bare)[0][0].image_rgb
    noise = np.random.default_rng(0).normal(0.0, 1.0, image.shape)
    noisy = np.clip(image + np.rint(noise), 0, 255).astype(np.uint8)
    assert not is_repeated(np.roll(image, 1, axis=1), image)
    assert not is_repeated(noisy, image)


def test_what_an_encoder_changes_in_a_copy_is_no_motion() -> None:
    image = walk()[0][0].image_rgb
    changes = np.random.default_rng(0).random(image.shape) < 0.1
    assert is_repeated(np.where(changes, image ^ 1, image).astype(np.uint8), image)


def test_one_thing_that_moves_in_an_image_of_nothing_is_not_repeated() -> None:
    image = np.full((240, 320, 3), 200, dtype=np.uint8)
    moved = image.copy()
    moved[100:108, 100:108] = 90
    assert not is_repeated(moved, image)


def test_repeated_images_have_the_pose_before_and_disturb_no_other() -> None:
    given = frames()
    plain, repeating = Run(given), Run(with_repeats(given))
    is_repeat = np.arange(len(repeating.results)) % (EVERY + 1) == EVERY
    assert is_repeat.sum() == len(given) // EVERY
    poses = poses_of(repeating.results)
    # the map may have been adjusted between two images
    np.testing.assert_allclose(poses[is_repeat], poses[np.flatnonzero(is_repeat) - 1], atol=0.01)
    np.testing.assert_allclose(poses[~is_repeat], poses_of(plain.results), atol=0.01)
    repeats = [result for result, repeated in zip(repeating.results, is_repeat, strict=True) if repeated]
    assert {result.status for result in repeats} == {TrackingStatus.TRACKING}
    assert all(result.inliers > 0 and result.quality > 0.0 and not result.is_keyframe for result in repeats)
    result, before = repeating.finish(), plain.finish()
    assert result.statistics.tracked == len(result.trajectory) == len(given) + len(repeats)
    assert result.statistics.withdrawn == 0
    truth = walk()[1][:, :3, 3]
    errors = [
        float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - truth) ** 2, axis=1))))
        for poses in (result.trajectory.T_world_camera[~is_repeat], before.trajectory.T_world_camera)
    ]
    assert errors[0] < 1.5 * errors[1]
    final = result.trajectory.T_world_camera
    np.testing.assert_array_equal(final[is_repeat], final[np.flatnonzero(is_repeat) - 1])
    assert f"{len(repeats)} images repeat the one before, and have its pose" in result.notes
    assert len(before.notes) == len(result.notes) - 1


def test_a_repeated_image_is_withdrawn_with_the_one_that_it_repeats() -> None:
    run = Run(with_repeats(frames(range(20))))
    log = run.slam._active.frames
    times_s = [result.timestamp_s for result in run.results]
    assert not run.results[6].is_keyframe
    log.withdraw(times_s[6:7])
    kept_s = [time_s for time_s, _ in log.poses]
    assert kept_s == times_s[:6] + times_s[8:]
    assert log.withdrawn == 2
    result = run.finish()
    assert result.statistics.withdrawn == 2
    assert result.trajectory.timestamps_s.tolist() == kept_s


def test_a_sensor_that_sees_motion_is_believed_where_the_colour_image_is_late() -> None:
    first, later = walk()[0][0], walk()[0][10]
    late = replace(later, image_rgb=first.image_rgb)
    assert not has_same_depth(late, first)
    assert first.depth_m is not None
    assert has_same_depth(replace(later, depth_m=first.depth_m.copy()), first)
    assert has_same_depth(colour_only(late), colour_only(first))
    assert not has_same_depth(colour_only(late), first)


def test_a_repeated_image_of_a_lost_camera_has_no_pose() -> None:
    given = frames(range(12))
    lost = covered(given[10])
    run = Run([*given[:10], lost, replace(lost, index=11, timestamp_s=given[11].timestamp_s)])
    assert [result.T_world_camera is None for result in run.results[-2:]] == [True, True]


def test_a_restored_tracker_knows_the_last_image() -> None:
    given = with_repeats(frames(range(30)))
    at = EVERY  # the next one repeats the last before the checkpoint
    unbroken = Run(given)
    first = Run(given[:at])
    first.slam.is_quiet  # noqa: B018  # waits for the thread
    plain, arrays = flattened(first.slam.state())
    with Tracker(first.slam.camera, SensorDepth(), CONFIG) as second:
        second.restore(
            restored(json.loads(json.dumps(plain)), arrays),
            lambda index: given[index],
            lambda stored: SensorDepth().predict(stored.load()),
        )
        results = [second.step(frame) for frame in given[at:]]
        end = second.finish()
    np.testing.assert_array_equal(poses_of(results), poses_of(unbroken.results[at:]))
    whole = unbroken.finish()
    np.testing.assert_array_equal(end.trajectory.T_world_camera, whole.trajectory.T_world_camera)
    assert end.notes == whole.notes
