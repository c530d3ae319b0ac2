# SPDX-License-Identifier: Apache-2.0
"""Trajectory scores: exact cases, an independent computation, and evo's own commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from slamdepth.errors import DatasetError
from slamdepth.evaluation import MAX_DIFFERENCE_S, score_trajectory
from slamdepth.geometry import invert, rotation_angle_rad, se3_exp, so3_exp, transform, umeyama
from slamdepth.io import read_tum_trajectory, write_tum_trajectory
from slamdepth.types import Trajectory


def wavy(count: int = 90, rate_hz: float = 30.0, start_s: float = 1000.0) -> Trajectory:
    """A smooth path in all three axes with rotation."""
    t = np.arange(count) / rate_hz
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(t), 0.3 * np.cos(2 * t), 0.5 * t], axis=1)
    poses[:, :3, :3] = so3_exp(np.stack([0.2 * np.sin(t), 0.4 * t, 0.1 * np.cos(t)], axis=1))
    return Trajectory(start_s + t, poses)


def perturbed(trajectory: Trajectory, scale: float = 1.0, noise: float = 0.01, seed: int = 0) -> Trajectory:
    """The trajectory scaled, moved to another world, and shaken."""
    rng = np.random.default_rng(seed)
    poses = trajectory.T_world_camera.copy()
    poses[:, :3, 3] *= scale
    poses = se3_exp(np.array([3.0, -1.0, 2.0, 0.5, 1.0, -0.7])) @ poses
    poses = poses @ se3_exp(rng.normal(scale=noise, size=(len(trajectory), 6)))
    return Trajectory(trajectory.timestamps_s.copy(), poses)


def test_a_moved_copy_has_no_error() -> None:
    score = score_trajectory(wavy(), perturbed(wavy(), noise=0.0))
    assert score.se3.rmse_m < 1e-12
    assert score.sim3.scale == pytest.approx(1.0, abs=1e-12)
    assert score.per_frame.trans_rmse_m < 1e-12
    assert score.per_frame.rot_rmse_deg < 1e-9
    assert score.matched == score.estimate_poses == score.truth_poses == 90


def test_scale_is_what_the_estimate_must_be_multiplied_by() -> None:
    score = score_trajectory(wavy(), perturbed(wavy(), scale=0.5, noise=0.0))
    assert score.sim3.scale == pytest.approx(2.0, rel=1e-12)
    assert score.sim3.rmse_m < 1e-12
    assert score.se3.rmse_m > 0.1
    assert score.se3.scale == 1.0


def test_agrees_with_an_independent_computation() -> None:
    truth, estimate = wavy(), perturbed(wavy(), scale=0.8)
    score = score_trajectory(truth, estimate)
    p, q = truth.T_world_camera[:, :3, 3], estimate.T_world_camera[:, :3, 3]
    for error, with_scale in ((score.se3, False), (score.sim3, True)):
        scale, R, t = umeyama(q, p, with_scale)
        distances = np.linalg.norm(scale * q @ R.T + t - p, axis=1)
        np.testing.assert_allclose(error.errors_m, distances, atol=1e-10)
        np.testing.assert_allclose(transform(error.T_truth_estimate, q), scale * q @ R.T + t, atol=1e-10)
        assert error.rmse_m == pytest.approx(np.sqrt(np.mean(distances**2)), abs=1e-10)
        assert error.mean_m == pytest.approx(distances.mean(), abs=1e-10)
        assert error.median_m == pytest.approx(np.median(distances), abs=1e-10)
        assert error.max_m == pytest.approx(distances.max(), abs=1e-10)
        assert error.scale == pytest.approx(scale, abs=1e-10)

    assert score.per_second is not None
    for relative, delta in ((score.per_frame, 1), (score.per_second, 30)):
        truth_motion = invert(truth.T_world_camera[:-delta]) @ truth.T_world_camera[delta:]
        motion = invert(estimate.T_world_camera[:-delta]) @ estimate.T_world_camera[delta:]
        error_motion = invert(truth_motion) @ motion
        trans = np.linalg.norm(error_motion[:, :3, 3], axis=1)
        rot = np.degrees(rotation_angle_rad(error_motion[:, :3, :3]))
        assert relative.delta_frames == delta
        assert relative.trans_rmse_m == pytest.approx(np.sqrt(np.mean(trans**2)), abs=1e-10)
        assert relative.rot_rmse_deg == pytest.approx(np.sqrt(np.mean(rot**2)), abs=1e-8)
        np.testing.assert_array_equal(relative.end_indices, np.arange(delta, 90))


def test_inputs_are_not_changed() -> None:
    truth, estimate = wavy(), perturbed(wavy())
    before = truth.T_world_camera.copy(), estimate.T_world_camera.copy()
    score_trajectory(truth, estimate)
    np.testing.assert_array_equal(truth.T_world_camera, before[0])
    np.testing.assert_array_equal(estimate.T_world_camera, before[1])


def test_association_is_to_the_nearest_time_within_the_limit() -> None:
    truth = wavy(count=300, rate_hz=100.0)
    estimate = Trajectory(truth.timestamps_s[::4] + 0.003, truth.T_world_camera[::4])
    score = score_trajectory(truth, estimate)
    assert (score.matched, score.truth_poses) == (75, 300)
    np.testing.assert_allclose(score.truth_m, score.estimate_m)
    late = Trajectory(estimate.timestamps_s + 60.0, estimate.T_world_camera)
    with pytest.raises(DatasetError, match=r"within 0\.01 s .*same recording"):
        score_trajectory(truth, late)
    apart = Trajectory(truth.timestamps_s[::10] + 0.005, truth.T_world_camera[::10])
    with pytest.raises(DatasetError, match="no pose"):
        score_trajectory(truth, apart, max_difference_s=0.004)


def test_lost_frames_are_counted_not_hidden() -> None:
    truth = wavy()
    kept = np.r_[0:40, 70:90]
    estimate = Trajectory(truth.timestamps_s[kept], truth.T_world_camera[kept])
    score = score_trajectory(truth, estimate)
    assert (score.matched, score.estimate_poses, score.truth_poses) == (60, 60, 90)


def test_rate_comes_from_the_estimate_or_from_the_caller() -> None:
    truth = wavy(rate_hz=10.0)
    found = score_trajectory(truth, truth).per_second
    given = score_trajectory(truth, truth, fps=14.6).per_second
    assert found is not None
    assert given is not None
    assert (found.delta_frames, given.delta_frames) == (10, 15)
    assert score_trajectory(truth, truth, fps=200.0).per_second is None


def test_to_dict_is_json_with_nulls() -> None:
    score = score_trajectory(wavy(count=12), perturbed(wavy(count=12)))
    figures = json.loads(json.dumps(score.to_dict()))
    assert figures["ate"]["se3"]["rmse_m"] == score.se3.rmse_m
    assert figures["ate"]["sim3"]["scale"] == score.sim3.scale
    assert figures["rpe"]["per_frame"]["rot_rmse_deg"] == score.per_frame.rot_rmse_deg
    assert figures["rpe"]["per_second"]["trans_rmse_m"] is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses_is_one_clear_error(count: int) -> None:
    truth = wavy()
    few = Trajectory(truth.timestamps_s[:count], truth.T_world_camera[:count])
    with pytest.raises(DatasetError, match="poses"):
        score_trajectory(truth, few)
    with pytest.raises(DatasetError, match="poses"):
        score_trajectory(few, truth)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
def test_a_camera_that_stood_still_or_ran_straight_is_one_clear_error(
    direction: tuple[float, float, float],
) -> None:
    truth = wavy()
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] = np.linspace(0, 1, len(truth))[:, None] * np.array(direction)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DatasetError, match="do not determine an alignment"):
            score_trajectory(Trajectory(truth.timestamps_s, poses), truth)
        with pytest.raises(DatasetError, match="do not determine an alignment"):
            score_trajectory(truth, Trajectory(truth.timestamps_s, poses))


def test_poses_that_are_no_poses_are_refused() -> None:
    truth = wavy()
    for value, message in ((np.nan, "1 poses that are not finite"), (2.0, "not orthonormal")):
        poses = truth.T_world_camera.copy()
        poses[7, 0, 0] = value
        with pytest.raises(DatasetError, match=f"estimate has .*{message}"):
            score_trajectory(truth, Trajectory(truth.timestamps_s, poses))


def test_scoring_touches_no_home_folder(tmp_path: Path) -> None:
    """evo's tools write settings into the home folder; the part used here must not."""
    code = (
        "import sys, numpy as np\n"
        "from slamdepth.evaluation import score_trajectory\n"
        "assert not any(m.split('.')[0] == 'evo' for m in sys.modules)\n"
        "from slamdepth.types import Trajectory\n"
        "T = np.tile(np.eye(4), (9, 1, 1)); T[:, :3, 3] = np.random.default_rng(0).normal(size=(9, 3))\n"
        "score_trajectory(Trajectory(np.arange(9.0), T), Trajectory(np.arange(9.0), T))\n"
        "assert 'evo.tools.settings' not in sys.modules and 'matplotlib' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "HOME": str(tmp_path)})
    assert list(tmp_path.iterdir()) == []


RUN_EVO = """
import json, sys
from evo.cli import entry_points
for command, *arguments in json.load(sys.stdin):
    sys.argv = ["evo_" + command, *arguments]
    getattr(entry_points, command)()
"""


def run_evo(calls: list[tuple[str, ...]], home: Path) -> list[dict[str, float]]:
    """Statistics that evo's own commands save, in full precision; one process runs all of them."""
    results = [home / f"{number}.zip" for number in range(len(calls))]
    commands = [
        (command, "tum", *arguments, "--silent", "--no_warnings", "--save_results", str(result))
        for (command, *arguments), result in zip(calls, results, strict=True)
    ]
    environment = {**os.environ, "HOME": str(home), "MPLBACKEND": "Agg", "MPLCONFIGDIR": str(home)}
    done = subprocess.run(
        [sys.executable, "-c", RUN_EVO],
        input=json.dumps(commands), env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return [saved_by_evo(result) for result in results]


def saved_by_evo(result: Path) -> dict[str, float]:
    with zipfile.ZipFile(result) as archive:
        stats: dict[str, float] = json.loads(archive.read("stats.json"))
        if "alignment_transformation_sim3.npy" in archive.namelist():
            with archive.open("alignment_transformation_sim3.npy") as file:
                stats["scale"] = float(np.cbrt(np.linalg.det(np.load(file)[:3, :3])))
    return stats


def assert_agrees_with_evo(truth_file: Path, estimate_file: Path, home: Path, *options: str) -> None:
    truth, _ = read_tum_trajectory(truth_file)
    estimate, _ = read_tum_trajectory(estimate_file)
    limit = float(options[1]) if options else MAX_DIFFERENCE_S
    score = score_trajectory(truth, estimate, max_difference_s=limit)
    assert score.per_second is not None
    files = (str(truth_file), str(estimate_file), *options)
    second = ("--delta", str(score.per_second.delta_frames), "--delta_unit", "f", "--all_pairs")
    absolute = [("ape", *files, flag) for flag in ("-a", "-as")]
    relative = [
        ("rpe", *files, "-r", relation, *span)
        for span in ((), second)
        for relation in ("trans_part", "angle_deg")
    ]
    ape_se3, ape_sim3, *rpe = run_evo(absolute + relative, home)
    for stats, error in ((ape_se3, score.se3), (ape_sim3, score.sim3)):
        assert error.rmse_m == pytest.approx(stats["rmse"], abs=1e-9)
        assert error.mean_m == pytest.approx(stats["mean"], abs=1e-9)
        assert error.median_m == pytest.approx(stats["median"], abs=1e-9)
        assert error.max_m == pytest.approx(stats["max"], abs=1e-9)
        assert error.scale == pytest.approx(stats["scale"], abs=1e-9)
    for drift, (trans, rot) in ((score.per_frame, rpe[:2]), (score.per_second, rpe[2:])):
        assert drift.trans_rmse_m == pytest.approx(trans["rmse"], abs=1e-9)
        assert drift.rot_rmse_deg == pytest.approx(rot["rmse"], abs=1e-9)


def test_agrees_with_evos_own_commands(tmp_path: Path) -> None:
    truth = wavy(count=400, rate_hz=100.0)
    shaken = perturbed(truth, scale=0.9)
    kept = np.r_[2:200:3, 230:400:3]
    estimate = Trajectory(shaken.timestamps_s[kept] + 0.002, shaken.T_world_camera[kept])
    write_tum_trajectory(tmp_path / "truth.txt", truth)
    write_tum_trajectory(tmp_path / "estimate.txt", estimate)
    (tmp_path / "home").mkdir()
    assert_agrees_with_evo(
        tmp_path / "truth.txt", tmp_path / "estimate.txt", tmp_path / "home", "--t_max_diff", "0.02"
    )


@pytest.mark.data
def test_agrees_with_evos_own_commands_on_a_real_ground_truth(tmp_path: Path, data_dir: Path) -> None:
    truth_file = data_dir / "rgbd_dataset_freiburg1_rpy" / "groundtruth.txt"
    truth, _ = read_tum_trajectory(truth_file)
    shaken = perturbed(truth, scale=1.2, noise=0.005)
    write_tum_trajectory(
        tmp_path / "estimate.txt",
        Trajectory(shaken.timestamps_s[100:2100:3] + 0.001, shaken.T_world_camera[100:2100:3]),
    )
    (tmp_path / "home").mkdir()
    assert_agrees_with_evo(truth_file, tmp_path / "estimate.txt", tmp_path / "home")
