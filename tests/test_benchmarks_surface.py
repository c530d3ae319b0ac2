# SPDX-License-Identifier: Apache-2.0
"""The benchmark of meshes: depth edges, stated deviations, rows and their table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import surface
from benchmarks.surface_depth import EdgeCounts, depth_edges, scaled_predictions, score_keyframes
from slamdepth.datasets import open_dataset
from slamdepth.mapping.dense_depth import DenseDepth, store_dense_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.spill_file import SpillFile
from slamdepth.types import DepthKind, DepthPrediction, Trajectory
from slamdepth.typing import Floats32


def box_before_wall(column: int = 150) -> Floats32:
    """A box at 1 m before a wall at 2 m; its left edge is at ``column``."""
    depth = np.full((240, 320), 2.0, np.float32)
    depth[60:180, column:250] = 1.0
    return depth


def edges_f1(depth_m: Floats32, truth_m: Floats32) -> float:
    counts = EdgeCounts()
    counts.add(depth_m, truth_m)
    return counts.f1


def test_an_edge_is_the_nearer_side_of_a_jump() -> None:
    rows, columns = np.nonzero(depth_edges(box_before_wall()))
    assert len(rows) == 2 * 120 + 2 * 100 - 4
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (60, 179, 150, 249)
    assert not depth_edges(np.linspace(1.0, 3.0, 320, dtype=np.float32)[None].repeat(240, 0)).any()


def test_edges_count_within_a_pixel_at_any_scale() -> None:
    truth = box_before_wall()
    assert edges_f1(truth, truth) == edges_f1(1.3 * truth, truth) == 1.0
    assert edges_f1(box_before_wall(149), truth) == 1.0
    assert edges_f1(box_before_wall(140), truth) == pytest.approx(1 - 120 / 440, abs=0.03)


def test_an_edge_smeared_to_a_slope_is_not_found() -> None:
    import cv2

    truth = box_before_wall()
    assert edges_f1(np.asarray(cv2.GaussianBlur(truth, (0, 0), 8), np.float32), truth) == 0.0


def test_edges_next_to_unknown_depth_do_not_count() -> None:
    truth = box_before_wall()
    truth[:, 145:150] = 0.0
    assert edges_f1(box_before_wall(147), truth) == pytest.approx(1.0, abs=0.02)


def keyframes_of(room: Path, factor: float, sigma_log: float) -> list[Keyframe]:
    """Exact depth times ``factor``, as a network would predict it with a deviation of ``sigma_log``."""
    found = []
    dataset = open_dataset(room)
    for number, index in enumerate((0, 20)):
        frame = dataset.read(index, with_depth=True)
        assert frame.depth_m is not None
        sigma = np.full_like(frame.depth_m, sigma_log)
        prediction = DepthPrediction(factor * frame.depth_m, DepthKind.METRIC, sigma)
        found.append(
            Keyframe(
                number, StoredFrame(frame), np.eye(4), np.zeros((0, 2)), 0.5, StoredPrediction(prediction),
                lambda prediction: prediction.values,
            )
        )  # fmt: skip
    return found


PATH = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))


def test_depth_of_keyframes_is_scored_against_the_sensor(tiny_room: Path) -> None:
    room = open_dataset(tiny_room)
    scored = score_keyframes(
        room, Reconstruction(PATH, tuple(keyframes_of(tiny_room, 1.1, 0.06)), np.zeros((0, 3))), 1.0
    )
    assert scored is not None
    assert scored["abs_rel"] == pytest.approx(0.1, abs=1e-3)
    assert scored["median"] == pytest.approx(0.1, abs=1e-3)
    assert (scored["within_5"], scored["within_1_sigma"], scored["within_2_sigma"]) == (0.0, 0.0, 1.0)
    assert scored["edge_f1"] == pytest.approx(1.0, abs=0.01)  # half precision moves a jump of just 7 %
    assert scored["keyframes"] == 2
    assert scored["measured"] is None
    exact = score_keyframes(
        room, Reconstruction(PATH, tuple(keyframes_of(tiny_room, 1.1, 0.06)), np.zeros((0, 3))), 1 / 1.1
    )
    assert exact is not None
    assert exact["abs_rel"] == pytest.approx(0.0, abs=1e-3)


def test_dense_depth_is_scored_at_its_own_pixels(tiny_room: Path) -> None:
    room, keyframes = open_dataset(tiny_room), keyframes_of(tiny_room, 1.1, 0.06)
    camera = room.camera.scaled(room.camera.width // 2, room.camera.height // 2)
    for n, keyframe in enumerate(keyframes):
        truth_m = keyframe.frame.load().depth_m
        assert truth_m is not None
        depth_m = truth_m[1::2, 1::2] * np.float32(1.02)  # where a pixel of half the size is looked up
        image = np.zeros((*depth_m.shape, 3), np.uint8)
        sigma, measured = np.full_like(depth_m, 0.03), np.zeros(depth_m.shape, np.bool_)
        measured[:, : depth_m.shape[1] // 2] = True
        dense = DenseDepth(camera, image, depth_m, sigma, measured)
        keyframes[n] = replace(keyframe, dense=store_dense_depth(dense, SpillFile()))
    times_s = np.array([keyframe.frame.timestamp_s for keyframe in keyframes])
    path = Trajectory(times_s, np.tile(np.eye(4), (2, 1, 1)))
    scored = score_keyframes(room, Reconstruction(path, tuple(keyframes), np.zeros((0, 3))), 1.0)
    assert scored is not None
    assert scored["median"] == pytest.approx(0.02, abs=5e-3)
    assert scored["median_measured"] == pytest.approx(0.02, abs=5e-3)
    assert scored["measured"] == pytest.approx(0.5, abs=0.05)
    assert scored["within_1_sigma"] is not None
    assert scored["within_1_sigma"] > 0.8


def test_the_network_alone_is_its_prediction_times_a_factor(tiny_room: Path) -> None:
    keyframes = keyframes_of(tiny_room, 2.0, 0.1)
    alone = scaled_predictions(keyframes)
    np.testing.assert_allclose(alone[0].load_depth_m(), 0.5 * keyframes[0].load_depth_m())


def test_rows_are_the_modes_that_the_settings_know() -> None:
    assert surface.dense_modes()[0] == "off"
    assert surface.row_names()[0] == "dense=off"
    with pytest.raises(SystemExit):
        surface.parse(["--rows", "dense=absent"])


def test_rows_with_exact_depth_are_nearly_exact(tiny_room: Path) -> None:
    """The depth model is the sensor, so that no weights are needed."""
    bench = surface.Bench(open_dataset(tiny_room), "sensor")
    rows = [
        {"sequence": "tiny", "row": name, **bench.row(name)} for name in ("dense=off", "Open3D at our poses")
    ]
    assert [row["align"] for row in rows] == ["se3", "sim3"]
    for row in rows:  # the path is so short that its scale errs by 3 %
        assert row[row["align"]]["within"]["10cm"]["f_score"] > 0.9
    assert rows[0]["se3"]["within"]["5cm"]["f_score"] > 0.9
    assert rows[0]["depth"]["edge_f1"] == 1.0
    text = surface.table(rows)
    assert len(text.splitlines()) == 4
    assert "| tiny | dense=off | " in text
