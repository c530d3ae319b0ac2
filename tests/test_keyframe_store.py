# SPDX-License-Identifier: Apache-2.0
"""Keyframes' images put away and taken back, and what a tracker holds in memory."""

from __future__ import annotations

import gc
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tracking_scene as scene
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from slamdepth.config import Config
from slamdepth.depth.sensor import SensorDepth
from slamdepth.mapping import landmarks
from slamdepth.mapping.keyframe_store import KeyframeStore, NamelessFile, StoredFrame, StoredPrediction
from slamdepth.mapping.packing import Numbers, pack_image, pack_measured, pack_predicted, unpack_image
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.known_size import rescaled
from slamdepth.tracking import frame_log
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, depth_factor=5000.0)


def image(seed: int = 0) -> NDArray[np.uint8]:
    """Smooth, as photographs are."""
    v, u = np.mgrid[:48, :64]
    return np.stack([2 * u + seed, 3 * v, u + v], axis=-1).astype(np.uint8)


def measured(seed: int = 0) -> NDArray[np.float32]:
    raw = np.random.default_rng(seed).integers(0, 65536, (48, 64)).astype(np.uint16)
    return raw.astype(np.float32) / np.float32(CAMERA.depth_factor)


@dataclass
class Held:
    frame: Frame
    prediction: DepthPrediction | None


def sensor_keyframe(seed: int) -> Held:
    frame = Frame(seed, seed / 30.0, image(seed), CAMERA, measured(seed))
    return Held(frame, replace(SensorDepth().predict(frame), sigma_log=None))


def predicted_keyframe(seed: int) -> Held:
    values = (1.0 + np.random.default_rng(seed).random((48, 64))).astype(np.float32)
    sigma = (0.1 * values).astype(np.float16)
    frame = Frame(seed, seed / 30.0, image(seed), CAMERA)
    return Held(frame, DepthPrediction(values, DepthKind.METRIC, sigma))


@given(
    arrays.arrays(np.uint16, arrays.array_shapes(min_dims=2, max_dims=2, max_side=9)),
    st.sampled_from([1.0, 1000.0, 5000.0, 1234.5]),
)
def test_depth_of_a_16_bit_image_comes_back_to_the_bit(raw: NDArray[np.uint16], per_m: float) -> None:
    depth_m = raw.astype(np.float32) / np.float32(per_m)
    packed = pack_measured(depth_m, per_m)
    assert packed.numbers is Numbers.UNITS
    np.testing.assert_array_equal(packed.unpacked(), depth_m)


@given(arrays.arrays(np.float32, arrays.array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_depth_from_anywhere_comes_back_to_the_bit(depth_m: NDArray[np.float32]) -> None:
    back = pack_measured(depth_m, 5000.0).unpacked()
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, depth_m)


@given(arrays.arrays(np.float32, (5, 7), elements=st.floats(2.0**-10, 2.0**10, width=32)))
def test_predicted_depth_keeps_half_precision(values: NDArray[np.float32]) -> None:
    back = pack_predicted(values).unpacked()
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, values, rtol=2.0**-11)
    halves = values.astype(np.float16)
    again = pack_predicted(halves).unpacked()
    assert again.dtype == np.float16
    np.testing.assert_array_equal(again, halves)


def test_smooth_depth_takes_an_eighth_of_the_room() -> None:
    v, u = np.mgrid[:480, :640]
    wall_m = np.rint((1.0 + 0.002 * u + 0.001 * v) * 5000.0).astype(np.float32) / np.float32(5000.0)
    assert len(pack_measured(wall_m, 5000.0).data) < wall_m.nbytes / 8


def test_an_image_comes_back_as_an_eye_sees_it() -> None:
    back = unpack_image(pack_image(image()))
    assert back.shape == image().shape
    assert back.dtype == np.uint8
    assert np.abs(back.astype(int) - image()).mean() < 3.0


def test_within_the_budget_nothing_is_put_away() -> None:
    store = KeyframeStore(budget_mib=1.0)
    keyframes = [sensor_keyframe(i) for i in range(12)]
    frames = [keyframe.frame for keyframe in keyframes]
    store.tidy(keyframes)
    assert all(keyframe.frame is frame for keyframe, frame in zip(keyframes, frames, strict=True))
    assert store.away_bytes == 0
    # depth is shared by frame and prediction, and counted once
    assert store.held_bytes == 12 * (48 * 64 * 3 + 48 * 64 * 4)


def test_beyond_the_budget_the_oldest_are_put_away_and_come_back() -> None:
    each = 48 * 64 * (3 + 4)
    store = KeyframeStore(budget_mib=10 * each / 2**20)
    keyframes: list[Held] = []
    for i in range(15):
        keyframes.append(sensor_keyframe(i))
        store.tidy(keyframes)
        assert store.held_bytes <= 10 * each
    assert [isinstance(k.frame, StoredFrame) for k in keyframes] == 5 * [True] + 10 * [False]
    for i, keyframe in enumerate(keyframes):
        assert keyframe.frame.index == i
        assert keyframe.frame.timestamp_s == i / 30.0
        assert keyframe.frame.camera is CAMERA
        assert keyframe.prediction is not None
        assert keyframe.prediction.is_sensor
        assert keyframe.prediction.kind is DepthKind.METRIC
        assert keyframe.prediction.sigma_log is None
        np.testing.assert_array_equal(keyframe.frame.depth_m, measured(i))
        np.testing.assert_array_equal(keyframe.prediction.values, measured(i))
        assert np.abs(keyframe.frame.image_rgb.astype(int) - image(i)).mean() < 3.0


def test_the_newest_stay_whatever_the_budget() -> None:
    store = KeyframeStore(budget_mib=0.0)
    keyframes = [predicted_keyframe(i) for i in range(11)]
    values = keyframes[0].prediction.values if keyframes[0].prediction else None
    store.tidy(keyframes)
    assert sum(isinstance(k.prediction, StoredPrediction) for k in keyframes) == 3
    first = keyframes[0].prediction
    assert first is not None
    assert values is not None
    assert first.sigma_log is not None
    assert not first.is_sensor
    np.testing.assert_allclose(first.values, values, rtol=2.0**-11)
    np.testing.assert_array_equal(first.sigma_log, (0.1 * values).astype(np.float16))
    assert keyframes[0].frame.depth_m is None


def test_replacing_a_field_gives_a_plain_value() -> None:
    store = KeyframeStore(budget_mib=0.0)
    keyframes = [sensor_keyframe(i) for i in range(9)]
    store.tidy(keyframes)
    frame, prediction = keyframes[0].frame, keyframes[0].prediction
    assert isinstance(frame, StoredFrame)
    assert isinstance(prediction, StoredPrediction)
    plain = replace(frame, index=7)
    assert type(plain) is Frame
    assert plain.index == 7
    np.testing.assert_array_equal(plain.depth_m, measured(0))
    assert type(replace(prediction)) is DepthPrediction


@pytest.mark.skipif(not hasattr(tempfile, "_O_TMPFILE_WORKS"), reason="files have names on this system")
def test_the_file_has_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So nothing is left of it, be the process interrupted or killed."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    file = NamelessFile()
    place = file.put(b"depth")
    other = file.put(b"colour")
    assert list(tmp_path.iterdir()) == []
    assert (file.get(place), file.get(other)) == (b"depth", b"colour")
    assert file.size == 11
    opened = file._file
    del file
    gc.collect()
    assert opened.closed


def test_where_the_disk_takes_nothing_bytes_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "not-there"))
    file = NamelessFile()
    with caplog.at_level("WARNING", logger="slamdepth"):
        places = [file.put(b"depth"), file.put(b"colour")]
    assert [file.get(place) for place in places] == [b"depth", b"colour"]
    assert file.size == 0
    assert len(caplog.records) == 1  # not once for each keyframe
    assert "stay in memory" in caplog.text


def reconstruction(mib: float, change: scene.Change | None = None, model: Any = None) -> Reconstruction:
    config = Config.from_dict(
        {
            "features": {"count": 600},
            "map": {"keyframe_memory_mib": mib},
            "tracking": {"keyframe_overlap": 0.9, "keyframe_overlap_start": 0.9},
        }
    )
    run = scene.Run(scene.frames(range(0, scene.COUNT), change), model, config)
    return run.finish()


def test_giving_rows_away_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks, "_LEAST_ROWS", 64)
    monkeypatch.setattr(frame_log, "_PRUNE_AT", 16)
    results, rows, pruned_at = [], [], []
    for compact_at in (10**9, 64):
        run = scene.Run([], scene.ConstantDepth())
        run.tracker._map._compact_at = compact_at
        for frame in scene.frames(change=scene.colour_only):
            run.tracker.step(frame)
        rows.append(run.tracker._map.size)
        pruned_at.append(run.tracker._log._prune_at)
        results.append(run.finish())
    assert rows[1] < 0.8 * rows[0]
    assert pruned_at[0] == 16 < pruned_at[1]
    plain, compact = results
    np.testing.assert_array_equal(plain.trajectory.T_world_camera, compact.trajectory.T_world_camera)
    np.testing.assert_array_equal(plain.points_m, compact.points_m)


@pytest.mark.parametrize("depth", ["sensor", "predicted"])
def test_a_run_with_nothing_in_memory_is_the_same_run(depth: str) -> None:
    if depth == "sensor":
        plain, away = reconstruction(1e3), reconstruction(0.0)
    else:
        plain, away = (reconstruction(mib, scene.colour_only, scene.ConstantDepth()) for mib in (1e3, 0.0))
    np.testing.assert_array_equal(plain.trajectory.T_world_camera, away.trajectory.T_world_camera)
    np.testing.assert_array_equal(plain.points_m, away.points_m)
    assert plain.statistics.scale_votes == away.statistics.scale_votes
    assert len(plain.keyframes) == len(away.keyframes) > 8
    assert isinstance(away.keyframes[0].frame, StoredFrame)
    for a, b in zip(plain.keyframes, away.keyframes, strict=True):
        assert a.depth_m.shape == a.frame.image_rgb.shape[:2]
        assert a.depth_m.dtype == b.depth_m.dtype == np.float32
        np.testing.assert_allclose(a.depth_m, b.depth_m, rtol=2e-3, atol=1e-6)
        assert a.depth_scale == b.depth_scale
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    twice = rescaled(away, 2.0).keyframes[0]
    np.testing.assert_array_equal(twice.depth_m, away.keyframes[0].depth_m * np.float32(2.0))
    np.testing.assert_array_equal(twice.T_world_camera[:3, 3], 2.0 * away.keyframes[0].T_world_camera[:3, 3])
    assert twice.depth_scale == 2.0 * away.keyframes[0].depth_scale
    np.testing.assert_array_equal(
        rescaled(rescaled(away, 2.0), 0.5).keyframes[0].depth_m, away.keyframes[0].depth_m
    )


def test_a_keyframe_and_a_frame_take_little() -> None:
    """What stays in memory of an old keyframe, and of an ordinary frame, has a bound."""
    config = Config.from_dict(
        {
            "map": {"keyframe_memory_mib": 0.0},
            "tracking": {"keyframe_overlap": 0.9, "keyframe_overlap_start": 0.9},
        }
    )
    run = scene.Run(scene.frames(), config=config)
    held = run.tracker.held()
    keyframes = run.results[-1].keyframes
    assert keyframes > 10
    features = config.features.count
    assert 0 < held.features < keyframes * features * 160
    assert 0 < held.frames < scene.COUNT * (128 + features * 20)
    assert held.points < 2 * 4096 * 256
    newest = 8 * 320 * 240 * (3 + 4)
    assert held.images == newest
    assert 0 < held.on_disk < (keyframes - 8) * 320 * 240 * 2


def test_going_back_and_forth_makes_few_keyframes() -> None:
    """Known ground is measured by the keyframes that were made there."""
    config = Config.from_dict(
        {
            "features": {"count": 600},
            "tracking": {"keyframe_overlap": 0.85, "keyframe_overlap_start": 0.9},
            "loops": {"min_gap": 4},
        }
    )
    there = list(range(scene.COUNT))
    order = [*there, *there[-2::-1], *there[1:], *there[-2::-1]]
    given = [
        replace(scene.walk()[0][i], index=n, timestamp_s=n / scene.SETTINGS.fps) for n, i in enumerate(order)
    ]
    run = scene.Run(given, config=config)
    assert all(result.T_world_camera is not None for result in run.results)
    first, last = run.results[scene.COUNT - 1].keyframes, run.results[-1].keyframes
    assert last <= first + 5  # 33 more where the last keyframe is what counts
    assert last <= 15
