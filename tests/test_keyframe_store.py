# SPDX-License-Identifier: Apache-2.0
"""Keyframes' images spilled to disk and read back, and the memory a tracker takes."""

from __future__ import annotations

import gc
import tempfile
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tracking_scene as scene
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from benchmarks.memory import TrackerMemory
from slamdepth.config import Config
from slamdepth.depth.sensor import SensorDepth
from slamdepth.mapping import map as map_module
from slamdepth.mapping.codec import Encoded, encode_half_precision, encode_image, encode_sensor_depth
from slamdepth.mapping.keyframe_store import KeyframeStore, StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.spill_file import SpillFile
from slamdepth.scale.known_size import rescaled
from slamdepth.tracking import frame_log
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, depth_factor=5000.0)
GRAVITY = np.array([0.0, 0.6, 0.8])


def image(seed: int = 0) -> NDArray[np.uint8]:
    """Smooth, as photographs are."""
    v, u = np.mgrid[:48, :64]
    return np.stack([2 * u + seed, 3 * v, u + v], axis=-1).astype(np.uint8)


def measured(seed: int = 0) -> NDArray[np.float32]:
    raw = np.random.default_rng(seed).integers(0, 65536, (48, 64)).astype(np.uint16)
    return np.asarray(raw.astype(np.float32) / np.float32(CAMERA.depth_factor))


@dataclass
class Stored:
    frame: StoredFrame
    prediction: StoredPrediction | None


def sensor_keyframe(seed: int) -> Stored:
    frame = Frame(seed, seed / 30.0, image(seed), CAMERA, measured(seed))
    prediction = replace(SensorDepth().predict(frame), sigma_log=None)
    return Stored(StoredFrame(frame), StoredPrediction(prediction))


def predicted_keyframe(seed: int) -> Stored:
    values = (1.0 + np.random.default_rng(seed).random((48, 64))).astype(np.float32)
    sigma: Any = (0.1 * values).astype(np.float16)
    frame = Frame(seed, seed / 30.0, image(seed), CAMERA, gravity=GRAVITY)
    prediction = DepthPrediction(values, DepthKind.METRIC, sigma, gravity=GRAVITY, gravity_share=0.7)
    return Stored(StoredFrame(frame), StoredPrediction(prediction))


def decoded(encoded: Encoded) -> NDArray[Any]:
    return encoded.decode(encoded.data)


@given(
    arrays.arrays(np.uint16, arrays.array_shapes(min_dims=2, max_dims=2, max_side=9)),
    st.sampled_from([1.0, 1000.0, 5000.0, 1234.5]),
)
def test_depth_of_a_16_bit_image_comes_back_to_the_bit(raw: NDArray[np.uint16], units_per_m: float) -> None:
    depth_m = raw.astype(np.float32) / np.float32(units_per_m)
    back = decoded(encode_sensor_depth(depth_m, units_per_m))
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, depth_m)


@given(arrays.arrays(np.float32, arrays.array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_any_float32_depth_comes_back_to_the_bit(depth_m: NDArray[np.float32]) -> None:
    back = decoded(encode_sensor_depth(depth_m, 5000.0))
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, depth_m)


@given(arrays.arrays(np.float32, (5, 7), elements=st.floats(2.0**-10, 2.0**10, width=32)))
def test_predicted_depth_keeps_half_precision(values: NDArray[np.float32]) -> None:
    back = decoded(encode_half_precision(values))
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, values.astype(np.float16).astype(np.float32))
    halves = values.astype(np.float16)
    again = decoded(encode_half_precision(halves))
    assert again.dtype == np.float16
    np.testing.assert_array_equal(again, halves)


def test_smooth_depth_takes_an_eighth_of_the_bytes() -> None:
    v, u = np.mgrid[:480, :640]
    wall_m = np.rint((1.0 + 0.002 * u + 0.001 * v) * 5000.0).astype(np.float32) / np.float32(5000.0)
    assert len(encode_sensor_depth(wall_m, 5000.0).data) < wall_m.nbytes / 8


def test_the_colours_of_an_image_come_back_nearly_as_they_were() -> None:
    back = decoded(encode_image(image()))
    assert back.shape == image().shape
    assert back.dtype == np.uint8
    assert np.abs(back.astype(int) - image()).mean() < 3.0


def test_within_the_budget_nothing_is_spilled() -> None:
    store = KeyframeStore(budget_mib=1.0)
    keyframes = [sensor_keyframe(i) for i in range(12)]
    frames = [keyframe.frame.load() for keyframe in keyframes]
    store.tidy(keyframes)
    assert all(keyframe.frame.load() is frame for keyframe, frame in zip(keyframes, frames, strict=True))
    assert store.spilled_bytes == 0
    # depth is shared by frame and prediction, and counted once
    assert store.resident_bytes == 12 * (48 * 64 * 3 + 48 * 64 * 4)


def test_beyond_the_budget_the_oldest_are_spilled_and_read_back() -> None:
    each = 48 * 64 * (3 + 4)
    store = KeyframeStore(budget_mib=10 * each / 2**20)
    keyframes: list[Stored] = []
    for i in range(15):
        keyframes.append(sensor_keyframe(i))
        store.tidy(keyframes)
        assert store.resident_bytes <= 10 * each
    assert [k.frame.is_spilled for k in keyframes] == 5 * [True] + 10 * [False]
    for i, keyframe in enumerate(keyframes):
        frame = keyframe.frame.load()
        assert (frame.index, frame.timestamp_s) == (i, i / 30.0)
        assert frame.camera is CAMERA
        np.testing.assert_array_equal(frame.depth_m, measured(i))
        assert np.abs(frame.image_rgb.astype(int) - image(i)).mean() < 3.0
        assert keyframe.prediction is not None
        prediction = keyframe.prediction.load()
        assert prediction.is_sensor
        assert prediction.kind is DepthKind.METRIC
        assert prediction.sigma_log is None
        np.testing.assert_array_equal(prediction.values, measured(i))


def test_the_depth_that_frame_and_prediction_share_is_written_once() -> None:
    one, two = SpillFile(), SpillFile()
    keyframe, frame = sensor_keyframe(0), sensor_keyframe(0).frame
    assert keyframe.prediction is not None
    keyframe.prediction._spill(one, keyframe.frame)
    keyframe.frame._spill(one)
    frame._spill(two)
    assert one.size == two.size > 0


def test_memory_does_not_decide_what_a_predicted_depth_is() -> None:
    values = (1.0 + np.random.default_rng(0).random((48, 64))).astype(np.float32)
    given = Frame(0, 0.0, image(), CAMERA), DepthPrediction(values, DepthKind.METRIC, 0.1 * values)
    stored = StoredFrame(given[0]), StoredPrediction(given[1])
    before = stored[1].load()
    np.testing.assert_allclose(before.values, values, rtol=5e-4)
    stored[1]._spill(SpillFile(), stored[0])
    after = stored[1].load()
    assert before.sigma_log is not None
    assert after.values.dtype == before.values.dtype == np.float32
    np.testing.assert_array_equal(after.values, before.values)
    np.testing.assert_array_equal(after.sigma_log, before.sigma_log)


def test_images_read_again_after_a_kill_are_those_that_memory_would_have_kept() -> None:
    def made(seed: int) -> Stored:
        return Stored(StoredFrame(Frame(seed, seed / 30.0, image(seed), CAMERA)), None)

    def read_again(seed: int) -> Stored:
        reader = made(seed).frame.load
        return Stored(StoredFrame.of_saved(seed, seed / 30.0, CAMERA, read=reader), None)

    budget_mib = 10 * image().nbytes / 2**20
    store, other = KeyframeStore(budget_mib), KeyframeStore(budget_mib)
    unbroken, resumed = [made(i) for i in range(12)], [read_again(i) for i in range(12)]
    store.tidy(unbroken)
    other.restore(store.state(), resumed)
    for keyframes, keeps in ((unbroken, store), (resumed, other)):
        keyframes += [made(i) for i in range(12, 16)]
        keeps.tidy(keyframes)
    assert store.state() == other.state()
    assert [k.frame.is_spilled for k in unbroken] == 6 * [True] + 10 * [False]
    for one, two in zip(unbroken, resumed, strict=True):
        np.testing.assert_array_equal(one.frame.load().image_rgb, two.frame.load().image_rgb)
        assert one.frame.image_bytes() == two.frame.image_bytes()


def test_the_newest_stay_resident_whatever_the_budget() -> None:
    store = KeyframeStore(budget_mib=0.0)
    keyframes = [predicted_keyframe(i) for i in range(11)]
    store.tidy(keyframes)
    assert [k.prediction.is_spilled for k in keyframes if k.prediction] == 3 * [True] + 8 * [False]
    assert keyframes[0].frame.load().depth_m is None


def test_a_keyframe_knows_the_same_whether_it_is_spilled_or_not() -> None:
    resident, spilled = predicted_keyframe(0), predicted_keyframe(0)
    KeyframeStore(budget_mib=0.0).tidy([spilled, *(predicted_keyframe(i) for i in range(8))])
    for name in ("frame", "prediction"):
        one, other = getattr(resident, name), getattr(spilled, name)
        assert (one.is_spilled, other.is_spilled) == (False, True)
        for item in fields(one.load()):
            a, b = getattr(one.load(), item.name), getattr(other.load(), item.name)
            assert type(a) is type(b), item.name
            if item.name == "image_rgb":
                assert np.abs(a.astype(int) - b).mean() < 3.0
            elif isinstance(a, np.ndarray):
                assert a.dtype == b.dtype
                np.testing.assert_allclose(a, b, rtol=2.0**-11)
            else:
                assert a == b, item.name
    assert spilled.prediction is not None
    assert spilled.prediction.load().gravity_share == spilled.prediction.gravity_share == 0.7
    np.testing.assert_array_equal(spilled.frame.load().gravity, GRAVITY)
    assert spilled.frame.image_bytes() == resident.frame.image_bytes()


@pytest.mark.skipif(not hasattr(tempfile, "_O_TMPFILE_WORKS"), reason="files have names on this system")
def test_the_file_has_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So nothing is left of it, be the process interrupted or killed."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    file = SpillFile()
    spilled = [file.spill(encode_sensor_depth(measured(i), 5000.0)) for i in range(2)]
    assert list(tmp_path.iterdir()) == []
    for i in range(2):
        np.testing.assert_array_equal(spilled[i].load(), measured(i))
    assert file.size == sum(len(encode_sensor_depth(measured(i), 5000.0).data) for i in range(2))
    opened = file._file
    del file, spilled
    gc.collect()
    assert opened.closed


def test_where_the_disk_takes_nothing_bytes_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "not-there"))
    file = SpillFile()
    with caplog.at_level("WARNING", logger="slamdepth"):
        spilled = [file.spill(encode_sensor_depth(measured(i), 5000.0)) for i in range(2)]
    for i in range(2):
        np.testing.assert_array_equal(spilled[i].load(), measured(i))
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


def test_compacting_the_landmarks_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_module, "_COMPACT_FROM", 64)
    monkeypatch.setattr(frame_log, "_PRUNE_AT", 16)
    results, sizes, pruned_at = [], [], []
    for compact_at in (10**9, 64):
        run = scene.Run([], scene.ConstantDepth())
        run.slam._active.map._compact_at = compact_at
        for frame in scene.frames(change=scene.colour_only):
            run.tracker.step(frame)
        sizes.append(run.slam._active.map.size)
        pruned_at.append(run.slam._active.frames._prune_at)
        results.append(run.finish())
    assert sizes[1] < 0.8 * sizes[0]
    assert pruned_at[0] == 16 < pruned_at[1]
    sparse, compact = results
    np.testing.assert_array_equal(sparse.trajectory.T_world_camera, compact.trajectory.T_world_camera)
    np.testing.assert_array_equal(sparse.points_m, compact.points_m)


def test_what_old_frames_saw_is_forgotten_at_little_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = scene.Run(scene.frames())
    monkeypatch.setattr(frame_log, "_REMEMBERED", 5)
    forgotten = scene.Run(scene.frames())
    assert forgotten.slam._active.frames.size_bytes < 0.3 * kept.slam._active.frames.size_bytes
    whole, part = (run.finish().trajectory for run in (kept, forgotten))
    np.testing.assert_array_equal(part.timestamps_s, whole.timestamps_s)
    apart_m = np.linalg.norm(part.T_world_camera[:, :3, 3] - whole.T_world_camera[:, :3, 3], axis=1)
    assert apart_m.max() < 0.015


@pytest.mark.parametrize("depth", ["sensor", "predicted"])
def test_the_memory_budget_does_not_change_the_run(depth: str) -> None:
    if depth == "sensor":
        resident, spilled = reconstruction(1e3), reconstruction(0.0)
    else:
        resident, spilled = (
            reconstruction(mib, scene.colour_only, scene.ConstantDepth()) for mib in (1e3, 0.0)
        )
    np.testing.assert_array_equal(resident.trajectory.T_world_camera, spilled.trajectory.T_world_camera)
    np.testing.assert_array_equal(resident.points_m, spilled.points_m)
    assert resident.statistics.scale_votes == spilled.statistics.scale_votes
    assert len(resident.keyframes) == len(spilled.keyframes) > 8
    assert spilled.keyframes[0].frame.is_spilled
    for a, b in zip(resident.keyframes, spilled.keyframes, strict=True):
        depth_m = a.load_depth_m()
        assert depth_m.shape == a.frame.load().image_rgb.shape[:2]
        assert depth_m.dtype == b.load_depth_m().dtype == np.float32
        np.testing.assert_allclose(depth_m, b.load_depth_m(), rtol=2e-3, atol=1e-6)
        assert a.depth_scale == b.depth_scale
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    twice = rescaled(spilled, 2.0).keyframes[0]
    np.testing.assert_array_equal(twice.load_depth_m(), spilled.keyframes[0].load_depth_m() * np.float32(2.0))
    np.testing.assert_array_equal(
        twice.T_world_camera[:3, 3], 2.0 * spilled.keyframes[0].T_world_camera[:3, 3]
    )
    assert twice.depth_scale == 2.0 * spilled.keyframes[0].depth_scale
    np.testing.assert_array_equal(
        rescaled(rescaled(spilled, 2.0), 0.5).keyframes[0].load_depth_m(), spilled.keyframes[0].load_depth_m()
    )


def test_the_memory_of_a_keyframe_and_of_a_frame_is_bounded() -> None:
    """What stays in memory of an old keyframe, and of an ordinary frame, has a bound."""
    config = Config.from_dict(
        {
            "map": {"keyframe_memory_mib": 0.0},
            "tracking": {"keyframe_overlap": 0.9, "keyframe_overlap_start": 0.9},
        }
    )
    run = scene.Run(scene.frames(), config=config)
    memory = TrackerMemory.of(run.slam)
    keyframes = run.results[-1].keyframes
    assert keyframes > 10
    features = config.features.count
    mib = 2**20
    assert 0 < memory.features * mib < keyframes * features * 160
    assert 0 < memory.observations * mib < scene.COUNT * (128 + features * 20)
    assert 0 < memory.landmarks * mib < 2 * 4096 * 256
    newest = 8 * 320 * 240 * (3 + 4)
    assert memory.images * mib == newest
    assert 0 < memory.on_disk * mib < (keyframes - 8) * 320 * 240 * 3


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
