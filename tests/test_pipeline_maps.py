# SPDX-License-Identifier: Apache-2.0
"""A run that ends in several maps: each has its files, its scale, its score and its verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call, leave_out_plots
from made_up import MadeUpDataset, TwoMapTracker, pose

from slamdepth.config import Config
from slamdepth.depth.scale import DepthScale, ScaleDomain
from slamdepth.geometry import invert
from slamdepth.io import read_tum_trajectory
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline import run
from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.pipeline.scale import scale_of_other, settle_scale
from slamdepth.report import ScaleSource
from slamdepth.tracking.tracker import Tracker
from slamdepth.types import Camera, RunStatistics, Trajectory

FRAMES = 24


@pytest.fixture(autouse=True)
def two_maps_and_no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    def create_tracker(camera: Camera, *, depth_model: Any, config: Config, start_map: None) -> Tracker:
        return TwoMapTracker(camera, depth_model=depth_model, config=config)

    monkeypatch.setattr("slamdepth.tracking.create_tracker", create_tracker)
    leave_out_plots(monkeypatch)


def test_each_map_has_files_score_and_verdict_of_its_own(tiny_room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    config = Config.from_dict({"map": {"voxel_size_m": 0.08}})
    result = run(tiny_room, folder, depth="sensor", config=config, max_frames=FRAMES)
    largest, _ = read_tum_trajectory(folder / "trajectory.txt")
    second, _ = read_tum_trajectory(folder / "maps" / "2" / "trajectory.txt")
    assert (len(largest), len(second)) == (TwoMapTracker.CUT, FRAMES - TwoMapTracker.CUT)
    (other,) = result.reconstruction.others
    np.testing.assert_allclose(other.trajectory.T_world_camera, second.T_world_camera, atol=1e-6)
    keyframes, _ = read_tum_trajectory(folder / "maps" / "2" / "keyframes.txt")
    assert len(keyframes) == len(other.keyframes)
    assert (folder / "maps" / "2" / "mesh.ply").is_file()
    assert not (folder / "maps" / "2" / "mesh.png").exists()
    summary = result.summary
    assert [one["frames"] for one in summary["maps"]] == [len(largest), len(second)]
    assert all(one["ate"]["se3"]["rmse_m"] < 0.02 for one in summary["maps"])
    assert summary["maps"][1]["mesh"]["triangles"] > 0
    assert summary["health"]["verdict"] == "not trustworthy"
    assert all("too short to judge" in one["headline"] for one in summary["health"]["maps"])
    readme = (folder / "README.txt").read_text()
    assert "each map that never met the largest" in readme
    assert "maps/" in (folder / "report.html").read_text(encoding="utf-8")


def test_a_later_run_with_one_map_leaves_no_other_map_behind(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    run(tiny_room, folder, depth="sensor", max_frames=FRAMES, mesh=False)
    assert not (folder / "maps" / "2" / "mesh.ply").exists()
    (folder / "maps" / "notes.txt").write_text("mine")
    monkeypatch.setattr("slamdepth.tracking.create_tracker", Tracker)
    run(tiny_room, folder, depth="sensor", max_frames=FRAMES, mesh=False, overwrite=True)
    assert [path.name for path in (folder / "maps").iterdir()] == ["notes.txt"]


def test_the_online_trajectory_says_where_another_frame_begins(tiny_room: Path, tmp_path: Path) -> None:
    run(tiny_room, tmp_path / "run", depth="sensor", max_frames=FRAMES, mesh=False)
    path = tmp_path / "run" / "trajectory_online.txt"
    lines = path.read_text().splitlines()
    assert lines[1 + TwoMapTracker.CUT] == "# from here on in the world frame of map 2, as maps were started"
    assert sum(line.startswith("#") for line in lines) == 2
    online, notes = read_tum_trajectory(path)
    assert (len(online), notes) == (FRAMES, [])
    from evo.tools import file_interface

    assert file_interface.read_tum_trajectory_file(str(path)).num_poses == FRAMES


def test_the_command_prints_a_line_for_each_map(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    folder = tmp_path / "run"
    done = call("run", tiny_room, "-o", folder, "--depth", "sensor", "--max-frames", FRAMES, "--no-mesh")
    assert done.returncode == 0, done.stderr
    assert "2 that never met: no common frame, each with its own scale" in done.stdout
    assert "map 1, the largest" in done.stdout
    assert "8 (33.3 %) frames" in done.stdout
    assert f"{folder}/maps\n" in done.stdout


def test_a_single_map_can_be_asked_for(tiny_room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    wanted = ("--depth", "sensor", "--max-frames", FRAMES, "--no-mesh", "--single-map")
    assert call("run", tiny_room, "-o", folder, *wanted).returncode == 0
    assert json.loads((folder / "report.json").read_text())["settings"]["tracking"]["new_maps"] is False
    assert Config.from_yaml(folder / "config.yaml").tracking.new_maps is False


# --- scale -----------------------------------------------------------------------------


def path_of(first: int, count: int) -> Trajectory:
    times_s = np.arange(first, first + count) / 10.0
    return Trajectory(times_s, np.array([pose(float(n)) for n in range(count)]))


def maps_of(*votes: tuple[float, ...]) -> Reconstruction:
    made = [
        Reconstruction(path_of(40 * n, 40), (), np.ones((3, 3)), statistics=RunStatistics(scale_votes=of))
        for n, of in enumerate(votes)
    ]
    return replace(made[0], others=tuple(made[1:]))


def test_a_known_size_rescales_the_largest_map_only() -> None:
    config = Config.from_dict({"scale": {"baseline_m": 78.0}})
    before = PredictionScale(ScaleSource.NETWORK, "depth predicted by x", None)
    found = maps_of((0.1, -0.1, 0.0), (0.2, -0.2, 0.0, 0.0))
    largest, facts, _ = settle_scale(MadeUpDataset(90), found, before, config)
    assert largest.trajectory.T_world_camera[-1, 0, 3] > 1.9 * 39
    assert largest.others == found.others
    other, own, notes = scale_of_other(MadeUpDataset(90), found.others[0], before, config)
    assert other is found.others[0]
    assert notes == ()
    assert (own.source, own.factor, own.keyframes) == (ScaleSource.NETWORK, 1.0, 4)
    assert (own.uncertainty_log, own.interval) == (None, None)
    assert (facts.uncertainty_log or 1.0) < 0.05
    assert "what was given to scale the largest map by says nothing of this one" in own.sentence


def test_a_factor_on_predictions_is_in_every_map() -> None:
    scale = DepthScale(1.5, 0.0, ScaleDomain.DEPTH)
    before = PredictionScale(ScaleSource.VALUE, "x times 1.5", None, scale=scale)
    _, own, _ = scale_of_other(MadeUpDataset(90), maps_of((), (0.1,)).others[0], before, Config())
    assert (own.factor, own.prediction_factor, own.uncertainty_log) == (1.5, 1.5, None)
    assert "largest" not in own.sentence


def test_the_truths_trajectory_scales_the_largest_map_only() -> None:
    dataset = MadeUpDataset(90)
    rng = np.random.default_rng(0)
    found = maps_of((), ())
    bent = found.trajectory.T_world_camera.copy()
    bent[:, :3, 3] += rng.normal(size=(40, 3))
    truth = bent.copy()
    truth[:, :3, 3] *= 3.0
    dataset.ground_truth = Trajectory(found.trajectory.timestamps_s, invert(invert(truth)))
    found = replace(found, trajectory=replace(found.trajectory, T_world_camera=bent))
    before = PredictionScale(ScaleSource.NETWORK, "x", None, wants_trajectory=True)
    largest, facts, _ = settle_scale(dataset, found, before, Config())
    assert facts.factor == pytest.approx(3.0)
    assert facts.from_ground_truth
    other, own, _ = scale_of_other(dataset, found.others[0], before, Config())
    assert (own.factor, own.from_ground_truth) == (1.0, False)
    assert other is found.others[0]
    assert largest.trajectory.T_world_camera[-1, 0, 3] == pytest.approx(3.0 * bent[-1, 0, 3])
