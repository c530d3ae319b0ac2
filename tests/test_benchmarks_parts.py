# SPDX-License-Identifier: Apache-2.0
"""Parts of the SLAM benchmark: rows, vocabulary, cached depth, medians, tables, failures."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from benchmarks import tables
from benchmarks.depth_cache import DepthCache
from benchmarks.jobs import Job, run_job
from benchmarks.orb_vocabulary import train_tree, train_vocabulary_file, write_tree
from benchmarks.orbslam3 import OrbSlam3, _read, settings_text
from benchmarks.rows import ABLATIONS, NONE, SYSTEMS, Row, config_of, plan_ablation, plan_rows
from benchmarks.slam import training_images
from benchmarks.summary import summarise
from benchmarks.system import Estimate
from benchmarks.worker import score
from slamdepth.config import Config
from slamdepth.datasets import open_dataset
from slamdepth.errors import ConfigError
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, Trajectory, WeightsInfo

if TYPE_CHECKING:
    from numpy.typing import NDArray


class HalfDepth:
    """Predicts half of what the sensor measured."""

    name = "half"
    kind = DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self) -> None:
        self.calls = 0

    def predict(self, frame: Frame) -> DepthPrediction:
        self.calls += 1
        value = np.float32(1.5 + 0.1 * frame.index)
        return DepthPrediction(np.full(frame.image_rgb.shape[:2], value), self.kind)


def helix(count: int = 60) -> Trajectory:
    t = np.arange(count) / 30.0
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = np.stack([np.cos(t), np.sin(t), 0.3 * t], axis=1)
    return Trajectory(100.0 + t, T)


def entry(label: str, **medians: float) -> dict[str, Any]:
    row = {"sequence": "room", "label": label, "depth": "sensor", "status": "ok", "message": "", "notes": []}
    return {**row, "figures": medians, "spread": {}}


def test_each_row_is_unique_and_its_settings_are_valid() -> None:
    for rows in (plan_rows(list(SYSTEMS), ["sensor", "dinov2"]), plan_ablation(["sensor", "dinov2"])):
        assert len({(row.label, row.depth) for row in rows}) == len(rows)
        for row in rows:
            if row.is_ours:
                assert config_of(row).depth.name == row.depth


def test_every_row_of_an_ablation_has_its_own_settings() -> None:
    rows = plan_ablation(["sensor"])
    assert config_of(rows[0]) == Config.from_dict({"depth": {"name": "sensor"}})
    assert len({config_of(row).to_yaml() for row in rows}) == len(rows)
    assert len(rows) > len(ABLATIONS) - 4  # those that are the default are left out


def test_the_naive_row_is_fed_predictions_and_says_so() -> None:
    rows = plan_rows(["orbslam3"], ["sensor", "dinov2"])
    assert [(row.depth, row.needs_sensor, row.needs_predictions) for row in rows] == [
        (NONE, False, False),
        ("sensor", True, False),
        ("dinov2", False, True),
    ]
    assert "as if a sensor's" in rows[2].note
    assert not plan_rows(["slamdepth"], ["dinov2"])[0].needs_predictions


def test_each_feature_is_a_row_of_ours_and_of_nobody_else() -> None:
    features = [{"name": "orb"}, {"name": "sift"}, {"name": "aliked", "weights": "/home/me/aliked.onnx"}]
    rows = plan_rows(["slamdepth", "kiss-icp"], ["sensor"], features)
    assert [row.label for row in rows] == ["slamdepth", "slamdepth, sift", "slamdepth, aliked", "KISS-ICP"]
    assert rows[:1] + rows[3:] == plan_rows(["slamdepth", "kiss-icp"], ["sensor"])
    assert [config_of(row).features.name for row in rows[:3]] == ["orb", "sift", "aliked"]
    assert config_of(rows[2]).features.weights == "/home/me/aliked.onnx"
    published = summarise("room", rows[2], [])
    assert published["settings"] == {"features": {"name": "aliked", "weights": "aliked.onnx"}}
    assert config_of(rows[2]).features.weights == "/home/me/aliked.onnx"


def test_an_unknown_setting_of_a_row_is_named() -> None:
    with pytest.raises(ConfigError, match=r"row 'odd': unknown setting 'loops\.on'"):
        config_of(Row("odd", "slamdepth", "sensor", {"loops": {"on": True}}))


def _descriptors() -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(0)
    centres = rng.integers(0, 256, (40, 32), dtype=np.uint8)
    images = []
    for _ in range(6):
        words = centres[rng.integers(0, 40, 200)].copy()
        words[np.arange(200), rng.integers(0, 32, 200)] ^= np.uint8(1)
        images.append(words)
    return images


def test_the_vocabulary_file_is_a_tree_of_dbow2(tmp_path: Path) -> None:
    nodes = train_tree(_descriptors(), branches=4, depth=3)
    write_tree(tmp_path / "v.txt", nodes, branches=4, depth=3)
    text = (tmp_path / "v.txt").read_text()
    assert not text.endswith("\n")  # DBoW2 would take an empty line for a node
    lines = text.splitlines()
    assert lines[0] == "4 3 0 0"
    rows = [line.split() for line in lines[1:]]
    assert all(len(row) == 2 + 32 + 1 for row in rows)
    parents, leaf = np.array([[int(row[0]), int(row[1])] for row in rows]).T
    assert np.all(parents < np.arange(1, len(rows) + 1))  # a parent comes before its children
    has_children = np.isin(np.arange(1, len(rows) + 1), parents)
    np.testing.assert_array_equal(leaf == 1, ~has_children)
    assert np.bincount(parents).max() <= 4
    depth = np.zeros(len(rows) + 1, dtype=int)
    for number, parent in enumerate(parents, start=1):
        depth[number] = depth[parent] + 1
    assert depth.max() <= 3
    assert all(0 <= int(byte) <= 255 for row in rows for byte in row[2:34])
    assert all(float(row[34]) >= 0 for row in rows)


def test_the_same_descriptors_give_the_same_vocabulary() -> None:
    first, second = (train_tree(_descriptors(), branches=4, depth=3, seed=1) for _ in range(2))
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.word, b.word)


def test_images_of_the_sequence_train_where_there_are_no_others(tiny_room: Path) -> None:
    images = training_images(tiny_room.parent, [open_dataset(tiny_room)])
    assert len(images) == 4
    assert all(path.parent.name == "rgb" for path in images)


def test_orbslam3_gets_the_camera_of_the_sequence() -> None:
    text = settings_text(Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.26, -0.95, -0.005, 0.003, 1.16)))
    assert text.startswith("%YAML:1.0\n")
    for line in ("Camera1.fx: 517.300000000", "Camera1.k3: 1.160000000", "Camera.width: 640"):
        assert line in text.splitlines()


def test_orbslam3_trajectories_are_snapped_to_the_frames(tmp_path: Path) -> None:
    times = np.array([1305031452.791720, 1305031452.823674, 1305031452.859642])
    rows = [f"{t * 1e9:.6f} {i} 0 0 0 0 0 1" for i, t in enumerate(times)]
    (tmp_path / "f.txt").write_text("\n".join([*rows, rows[-1]]) + "\n")  # it repeats a frame at times
    trajectory = _read(tmp_path / "f.txt", times, False)
    assert trajectory is not None
    assert not trajectory.is_metric
    np.testing.assert_allclose(trajectory.timestamps_s, times, atol=1e-6)
    np.testing.assert_allclose(trajectory.T_world_camera[:, 0, 3], [0, 1, 2])
    assert _read(tmp_path / "missing.txt", times, False) is None


def test_cached_depth_is_what_was_predicted_and_made_once(tiny_room: Path, tmp_path: Path) -> None:
    dataset, model = open_dataset(tiny_room), HalfDepth()
    cache = DepthCache.of(tmp_path, dataset, model)
    assert cache.fill(dataset, model, range(0, 6, 2)) == 3
    assert cache.fill(dataset, model, range(0, 6, 2)) == 0
    assert model.calls == 3
    depth = cache.read(4)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, 1.9, rtol=1e-3)
    with pytest.raises(FileNotFoundError):
        cache.read(1)


def test_other_weights_have_another_cache(tiny_room: Path, tmp_path: Path) -> None:
    dataset, first, second = open_dataset(tiny_room), HalfDepth(), HalfDepth()
    second.weights = (WeightsInfo("head", "ab" * 32, "rooms", "MIT"),)
    assert DepthCache.of(tmp_path, dataset, first) != DepthCache.of(tmp_path, dataset, second)


def test_depth_without_unit_is_refused_for_peers(tiny_room: Path, tmp_path: Path) -> None:
    dataset, model = open_dataset(tiny_room), HalfDepth()
    model.kind = DepthKind.AFFINE_INVERSE_DEPTH
    with pytest.raises(ConfigError, match="not metric"):
        DepthCache.of(tmp_path, dataset, model).fill(dataset, model, [0])


def test_a_trajectory_without_scale_is_scored_after_scaling() -> None:
    truth = helix()
    T = truth.T_world_camera.copy()
    T[:, :3, 3] *= 0.25
    notes: list[str] = []
    figures = score(truth, Estimate(replace(truth, T_world_camera=T, is_metric=False)), notes)
    assert "ate_se3_m" not in figures
    assert figures["scale"] == pytest.approx(4.0)
    assert figures["ate_sim3_m"] == pytest.approx(0.0, abs=1e-9)
    assert figures["rpe_m_per_s"] == pytest.approx(0.0, abs=1e-9)
    metric = score(truth, Estimate(replace(truth, T_world_camera=T), keyframes=truth), notes)
    assert metric["ate_se3_m"] > 0.1
    assert metric["ate_sim3_keyframes_m"] == pytest.approx(0.0, abs=1e-9)
    assert notes == []


def test_median_and_extremes_over_the_good_runs() -> None:
    def good(ate: float) -> dict[str, Any]:
        return {"status": "ok", "frames": 9, "figures": {"ate_se3_m": ate}, "notes": []}

    bad = {"status": "failed", "message": "crashed with SIGSEGV"}
    row = summarise("room", Row("x", "open3d", "sensor"), [good(3.0), bad, good(1.0), good(1.5)])
    assert row["status"] == "ok"
    assert (row["runs"], row["figures"], row["spread"]) == (3, {"ate_se3_m": 1.5}, {"ate_se3_m": [1.0, 3.0]})
    assert row["notes"] == ["1 of 4 runs failed: crashed with SIGSEGV"]
    failed = summarise("room", Row("x", "open3d", "sensor"), [bad])
    assert (failed["status"], failed["message"], failed["figures"]) == ("failed", "crashed with SIGSEGV", {})


def test_a_table_shows_median_and_spread_and_trouble() -> None:
    row = {**entry("ours", tracked=1.0, fps=30.0), "spread": {"fps": [29.0, 33.0]}}
    lost = {**entry("theirs"), "status": "not installed", "message": "not installed: pip install '.[bench]'"}
    machine = {"cores": 2, "cpu": "A", "gpu": None, "instructions": ["avx2"]}
    begun = {"hardware": machine, "versions": {"commit": "0123456789abc"}}
    text = tables.markdown({"environment": begun, "rows": [row, lost]})
    assert text.startswith("2 cores of A (AVX2, no bfloat16); 012345678.\n")
    assert "| ours | sensor | 100.0 | 30.0 ±2.0 |" in text
    assert "| theirs: not installed: pip install '.[bench]' | sensor | - | - |" in text


def test_changes_know_what_is_better() -> None:
    old = {"rows": [entry("a", fps=30.0, ate_se3_m=0.020, scale=1.0), entry("gone", fps=1.0)]}
    new = {"rows": [entry("a", fps=20.0, ate_se3_m=0.010, scale=1.2), entry("b", fps=9.0)]}
    moved = {key: verdict for _, _, key, _, _, verdict in tables.changes(old, new)}
    assert moved == {"fps": -1, "ate_se3_m": 1, "scale": 0}
    same = {key: verdict for _, _, key, _, _, verdict in tables.changes(old, old)}
    assert set(same.values()) == {0}


def test_a_sequence_that_is_gone_is_a_failed_run(tmp_path: Path) -> None:
    result = run_job(Job(str(tmp_path / "gone"), Row("x", "open3d", "sensor")))
    assert result["status"] == "failed"
    assert "gone" in result["message"]


def test_a_run_that_takes_too_long_is_given_up(tiny_room: Path) -> None:
    result = run_job(Job(str(tiny_room), Row("x", "slamdepth", "sensor")), timeout_s=0.01)
    assert result == {"status": "failed", "message": "stopped after 0.01 s"}


def test_a_crash_is_a_failed_run_with_its_last_words() -> None:
    row = Row("x", "slamdepth", "sensor", {"seed": 0})
    broken = replace(Job("", row), stride="two")  # type: ignore[arg-type]
    result = run_job(broken)
    assert result["status"] == "failed"
    assert result["message"]


@pytest.mark.data
@pytest.mark.skipif(find_spec("pyorbslam3") is None, reason="pip install '.[bench]' for ORB-SLAM3")
def test_orbslam3_tracks_with_a_vocabulary_trained_here(data_dir: Path, tmp_path: Path) -> None:
    sequence = data_dir / "rgbd_dataset_freiburg1_rpy"
    if not sequence.is_dir():
        pytest.skip(f"{sequence.name} is absent")
    vocabulary = tmp_path / "vocabulary.txt"
    images = training_images(sequence, [open_dataset(sequence)])
    train_vocabulary_file(images, vocabulary)
    job = Job(str(sequence), Row("x", "orbslam3", "sensor"), max_frames=60, vocabulary=str(vocabulary))
    result = run_job(job, timeout_s=120)
    assert result["status"] == "ok", result["message"]
    assert result["frames"] == 60
    assert result["figures"]["tracked"] > 0.8
    assert result["figures"]["ate_se3_m"] < 0.1


def test_the_peer_is_never_imported_by_the_package() -> None:
    assert OrbSlam3.__module__ == "benchmarks.orbslam3"
    assert "pyorbslam3" not in sys.modules
