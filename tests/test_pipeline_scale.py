# SPDX-License-Identifier: Apache-2.0
"""The scale of a run: known sizes, ground truth, and what the report says about it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up import MadeUpDataset, pose
from tracking_scene import ConstantDepth

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given
from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit
from slamdepth.depth.scale_file import write_scale
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.geometry import se3_exp
from slamdepth.mapping.floor import find_floor
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.prediction_scale import check_scale_options, choose_prediction_scale
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.report import ScaleFacts, ScaleSource
from slamdepth.scale.camera_height import from_camera_height
from slamdepth.scale.known_size import from_baseline, from_ground_truth, rescaled
from slamdepth.scale.votes import robust_spread
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, RunStatistics, Trajectory

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
VOTES = (-0.1, -0.05, 0.0, 0.05, 0.1)


def config_of(**scale: object) -> Config:
    return Config.from_dict({"scale": scale})


def walk(count: int = 60, scale: float = 1.0) -> Trajectory:
    """A curve of 6 s, its first and last place 3 m apart."""
    t = np.linspace(0.0, 1.0, count)
    tangents = np.stack([3 * t, np.sin(6 * t), np.sin(3.1415926535 * t), 0.2 * t, 0.3 * t, 0 * t], axis=1)
    T = se3_exp(tangents)
    T[:, :3, 3] *= scale
    T[:, 1, 3] -= T[-1, 1, 3] * t
    return Trajectory(6.0 * t, T)


def room_depth(T_world_camera: np.ndarray, floor_m: float | None, desk_m: float | None) -> np.ndarray:
    """Depth of a wall 4 m ahead, a floor and a desk at heights below the first camera, gravity along y."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=2)
    rays = rays @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (3.5 - origin[2]) / rays[..., 2]
        if floor_m is not None:
            hit = (floor_m - origin[1]) / rays[..., 1]
            depth = np.where((hit > 0) & (hit < depth), hit, depth)
        if desk_m is not None:
            hit = (desk_m - origin[1]) / rays[..., 1]
            x, z = origin[0] + hit * rays[..., 0], origin[2] + hit * rays[..., 2]
            depth = np.where((hit > 0) & (np.abs(x) < 0.6) & (z > 1.0) & (z < 2.0), hit, depth)
    seen: np.ndarray = depth.astype(np.float32)
    return seen


def room(
    floor_m: float | None,
    desk_m: float | None = None,
    tilt_rad: float = 0.4,
    *,
    is_sensor: bool = True,
    scale_sigma_log: float | None = None,
) -> tuple[Keyframe, ...]:
    """Keyframes whose world is the first camera, looking down by ``tilt_rad``."""
    keyframes = []
    first = se3_exp(np.array([0, 0, 0, -tilt_rad, 0, 0]))
    for number in range(4):
        T_level_camera = se3_exp(np.array([0.1 * number, 0.02 * number, 0, -tilt_rad, 0.1 * number, 0]))
        depth_m = room_depth(T_level_camera, floor_m, desk_m)
        frame = StoredFrame(Frame(number, number / 10, np.zeros((240, 320, 3), np.uint8), CAMERA))
        prediction = StoredPrediction(
            DepthPrediction(depth_m, DepthKind.METRIC, is_sensor=is_sensor, scale_sigma_log=scale_sigma_log)
        )
        T = np.linalg.inv(first) @ T_level_camera
        keyframes.append(Keyframe(number, frame, T, np.zeros((0, 2)), 1.0, prediction, as_given))
    return tuple(keyframes)


def reconstruction_of(
    trajectory: Trajectory | None = None,
    keyframes: tuple[Keyframe, ...] = (),
    votes: tuple[float, ...] = VOTES,
) -> Reconstruction:
    points = np.random.default_rng(0).normal(size=(20, 3))
    statistics = RunStatistics(60, 60, scale_votes=votes)
    return Reconstruction(trajectory or walk(), keyframes, points, statistics=statistics)


class Network(ConstantDepth):
    name = "net"


def settled(
    made: Reconstruction, dataset: MadeUpDataset | None = None, **scale: object
) -> tuple[Reconstruction, ScaleFacts, tuple[str, ...]]:
    dataset, config = dataset or MadeUpDataset(5), config_of(**scale)
    before = choose_prediction_scale(dataset, Network(), config, range(5))
    return settle_scale(dataset, made, before, config)


# --- the floor -------------------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [5.0, 20.0, 33.0])
@pytest.mark.parametrize("desk_m", [None, 0.7])
def test_the_floor_is_found_below_a_tilted_camera(tilt_deg: float, desk_m: float | None) -> None:
    floor = find_floor(reconstruction_of(keyframes=room(1.4, desk_m, math.radians(tilt_deg))))
    assert floor is not None
    assert floor.height == pytest.approx(1.4, rel=0.01)
    assert floor.tilt_deg == pytest.approx(tilt_deg, abs=1.0)
    assert floor.keyframes == 4
    assert floor.sigma_log < 0.03


def test_no_floor_no_height() -> None:
    nothing = reconstruction_of(keyframes=room(None))
    assert find_floor(nothing) is None
    assert find_floor(reconstruction_of(keyframes=room(1.4, tilt_rad=math.radians(50)))) is None
    assert find_floor(reconstruction_of()) is None
    with pytest.raises(DatasetError, match="no floor was found below the camera"):
        from_camera_height(nothing, 1.4)


@pytest.mark.parametrize("tilt_deg", [20.0, 50.0, 70.0])
def test_known_gravity_finds_the_floor_however_the_camera_is_held(tilt_deg: float) -> None:
    tilt = math.radians(tilt_deg)
    gravity_w = se3_exp(np.array([0, 0, 0, -tilt, 0, 0]))[:3, :3].T @ np.array([0.0, 1.0, 0.0])
    made = replace(reconstruction_of(keyframes=room(1.4, None, tilt)), gravity_w=gravity_w)
    floor = find_floor(made)
    assert floor is not None
    assert floor.height == pytest.approx(1.4, rel=0.01)
    assert floor.tilt_deg < 1.0


@pytest.mark.parametrize("scale", [0.03, 0.5, 20.0])
def test_the_floor_of_a_map_of_any_size_is_as_far_away(scale: float) -> None:
    small = rescaled(reconstruction_of(keyframes=room(1.4, 0.7)), scale)
    found = from_camera_height(small, 1.4)
    assert found.factor == pytest.approx(1 / scale, rel=0.01)
    assert found.sigma_log is not None
    assert found.sigma_log < 0.05


# --- baselines and ground truth -----------------------------------------------------------


def test_a_baseline_gives_the_scale() -> None:
    found = from_baseline(walk(scale=0.5), 3.0, None)
    truth = walk().T_world_camera[:, :3, 3]
    assert np.linalg.norm(truth[-1] - truth[0]) == pytest.approx(3.0, abs=1e-6)
    half = walk(scale=0.5).T_world_camera[:, :3, 3]
    assert found.factor == pytest.approx(3.0 / np.linalg.norm(half[-1] - half[0]))
    between = from_baseline(walk(), 1.0, (1.0, 2.03))
    a, b = (np.array([np.interp(t, walk().timestamps_s, truth[:, i]) for i in range(3)]) for t in (1.0, 2.03))
    assert between.factor == pytest.approx(1.0 / np.linalg.norm(b - a), rel=1e-9)


def test_baselines_that_give_no_scale() -> None:
    loop = walk()
    there_and_back = Trajectory(
        np.linspace(0, 6, 120), np.concatenate([loop.T_world_camera, loop.T_world_camera[::-1]])
    )
    with pytest.raises(DatasetError, match="too close to give a scale"):
        from_baseline(there_and_back, 1.0, None)
    with pytest.raises(DatasetError, match=r"no frame was tracked within 0.5 s of 9\.000 s"):
        from_baseline(loop, 1.0, (0.0, 9.0))
    holes = Trajectory(loop.timestamps_s[[0, 1, 58, 59]], loop.T_world_camera[[0, 1, 58, 59]])
    with pytest.raises(DatasetError, match=r"of 3\.000 s"):
        from_baseline(holes, 1.0, (0.0, 3.0))


def test_the_ground_truth_gives_the_scale() -> None:
    found = from_ground_truth(walk(), replace(walk(), T_world_camera=scaled(walk(), 0.8)))
    assert found.factor == pytest.approx(1 / 0.8, rel=1e-6)
    assert (found.sigma_log or 0.0) < 1e-6


def scaled(trajectory: Trajectory, factor: float) -> np.ndarray:
    T: np.ndarray = trajectory.T_world_camera.copy()
    T[:, :3, 3] *= factor
    return T


# --- putting them together -----------------------------------------------------------------


def test_rescaling_multiplies_every_length_and_nothing_else() -> None:
    before = reconstruction_of(keyframes=room(1.4))
    copy = before.trajectory.T_world_camera.copy()
    after = rescaled(before, 2.0)
    np.testing.assert_array_equal(before.trajectory.T_world_camera, copy)
    np.testing.assert_array_equal(after.trajectory.T_world_camera, scaled(before.trajectory, 2.0))
    np.testing.assert_array_equal(after.points_m, 2 * before.points_m)
    for a, b in zip(after.keyframes, before.keyframes, strict=True):
        np.testing.assert_array_equal(a.load_depth_m(), 2 * b.load_depth_m())
        np.testing.assert_array_equal(a.T_world_camera[:3, 3], 2 * b.T_world_camera[:3, 3])
        np.testing.assert_array_equal(a.T_world_camera[:3, :3], b.T_world_camera[:3, :3])
        assert (a.depth_scale, a.prediction) == (2 * b.depth_scale, b.prediction)
    np.testing.assert_allclose(after.statistics.scale_votes, np.array(VOTES) + math.log(2))
    back = rescaled(after, 0.5)
    np.testing.assert_allclose(back.points_m, before.points_m)


def test_without_a_known_size_the_scale_is_the_networks_with_its_uncertainty() -> None:
    made, facts, notes = settled(reconstruction_of())
    assert (facts.source, facts.factor, facts.from_ground_truth) == (ScaleSource.NETWORK, 1.0, False)
    assert (facts.uncertainty_log, facts.interval) == (None, None)
    assert facts.spread == pytest.approx(robust_spread(np.array(VOTES)))
    assert "its accuracy is unknown, since the depth model states none" in facts.sentence
    assert (facts.keyframes, notes) == (5, ())
    assert "predicted by net" in facts.sentence
    assert "no sensor measured it" in facts.sentence
    np.testing.assert_array_equal(made.points_m, reconstruction_of().points_m)


def test_a_sensor_measures() -> None:
    before = choose_prediction_scale(MadeUpDataset(5), SensorDepth(), Config(), range(5))
    _, facts, _ = settle_scale(MadeUpDataset(5), reconstruction_of(votes=()), before, Config())
    assert (facts.source, facts.keyframes, facts.spread) == (ScaleSource.SENSOR, 0, None)
    assert "measured by the depth sensor" in facts.sentence


def test_a_known_baseline_dominates_and_the_report_says_how() -> None:
    made, facts, notes = settled(reconstruction_of(), baseline_m=3.6)
    assert facts.source is ScaleSource.BASELINE
    assert [part.source for part in facts.parts] == [ScaleSource.NETWORK, ScaleSource.BASELINE]
    assert facts.parts[1].weight > 0.95
    assert facts.parts[1].factor == pytest.approx(1.2, rel=1e-6)
    assert facts.factor == pytest.approx(1.2, rel=0.01)
    assert notes == ()
    places = made.trajectory.T_world_camera[:, :3, 3]
    assert np.linalg.norm(places[-1] - places[0]) == pytest.approx(3.0 * facts.factor, rel=1e-6)
    for text in ("inverse variance", "a baseline of 3.6 m", "depth predicted by net"):
        assert text in facts.sentence


def test_a_known_size_that_cannot_be_is_noted() -> None:
    _, facts, notes = settled(reconstruction_of(keyframes=room(1.4, scale_sigma_log=0.2)), baseline_m=30.0)
    assert "differ by a factor of 10" in notes[0]
    assert [part.weight for part in facts.parts] == [0.0, 1.0]  # what was measured outvotes the network
    _, facts, notes = settled(reconstruction_of(keyframes=room(None)), camera_height_m=1.4)
    assert facts.source is ScaleSource.NETWORK
    assert notes[0].startswith("no scale from the camera height: no floor was found")


def test_a_scale_from_ground_truth_says_so() -> None:
    dataset = MadeUpDataset(5)
    dataset.has_depth = False
    dataset.ground_truth = replace(walk(), T_world_camera=scaled(walk(), 1.5))
    made, facts, _ = settled(reconstruction_of(), dataset, depth="groundtruth")
    assert facts.source is ScaleSource.GROUND_TRUTH_TRAJECTORY
    assert facts.factor == pytest.approx(1.5, rel=1e-6)
    assert "SE(3) ATE is not a metric claim" in facts.sentence
    np.testing.assert_allclose(made.trajectory.T_world_camera, dataset.ground_truth.T_world_camera, atol=1e-6)

    dataset.ground_truth = Trajectory(walk().timestamps_s, np.tile(pose(0), (60, 1, 1)))
    _, facts, notes = settled(reconstruction_of(), dataset, depth="groundtruth")
    assert (facts.source, facts.from_ground_truth) == (ScaleSource.NETWORK, False)
    assert "no scale from the ground truth" in notes[0]


def test_a_number_multiplies_and_claims_nothing() -> None:
    model = Network()
    before = choose_prediction_scale(MadeUpDataset(5), model, config_of(depth=1.5), range(5))
    predicted = before.applied_to(model).predict(MadeUpDataset(1).read(0))
    np.testing.assert_allclose(predicted.values, 3.0)
    _, facts, _ = settle_scale(MadeUpDataset(5), reconstruction_of(), before, Config())
    assert (facts.source, facts.factor, facts.uncertainty_log) == (ScaleSource.VALUE, 1.5, None)


def test_what_cannot_be_right_is_refused_before_the_run() -> None:
    dataset = MadeUpDataset(5)
    with pytest.raises(ConfigError, match="in metres already"):
        choose_prediction_scale(dataset, SensorDepth(), config_of(depth=2.0), range(5))
    times = config_of(baseline_m=1.0, baseline_between_s=(0.1, 7.0))
    with pytest.raises(
        ConfigError, match=r"--baseline-between 7\.000: the frames run from 0\.000 to 0\.400 s"
    ):
        check_scale_options(dataset, times, range(5))
    dataset.has_depth = False
    with pytest.raises(DatasetError, match="neither depth images nor a ground truth trajectory"):
        check_scale_options(dataset, config_of(depth="groundtruth"), range(5))
    Network.kind = DepthKind.AFFINE_INVERSE_DEPTH
    try:
        before = choose_prediction_scale(dataset, Network(), config_of(depth=2.0), range(5))
        with pytest.raises(ConfigError, match="a scale alone does not make it metric"):
            before.applied_to(Network())
    finally:
        Network.kind = DepthKind.METRIC


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ({"depth": -1.0}, "a factor must be a positive number"),
        ({"depth": "nan"}, "a factor must be a positive number"),
        ({"depth": True}, "a number, a file or 'groundtruth'"),
        ({"depth": "groundtruth", "camera_height_m": 1.0}, "exclude each other"),
        ({"baseline_between_s": [0, 1]}, "need its length"),
        ({"baseline_m": 1.0, "baseline_between_s": [1, 0]}, "must come before"),
        ({"camera_height_m": 0.0}, "scale.camera_height_m"),
    ],
)
def test_settings_out_of_range(scale: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config_of(**scale)


def test_files_survive_the_settings_file_from_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = Config.from_dict({"depth": {"weights": "head.st"}, "scale": {"depth": "s.yaml"}})
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    monkeypatch.chdir("/")
    again = Config.from_yaml(tmp_path / "config.yaml")
    assert again.depth.weights == str(tmp_path / "head.st")
    assert again.scale.depth == str(tmp_path / "s.yaml")
    for given in ("groundtruth", 0.5, "0.5"):
        kept = Config.from_dict({"scale": {"depth": given}})
        (tmp_path / "config.yaml").write_text(kept.to_yaml())
        assert Config.from_yaml(tmp_path / "config.yaml") == kept


def test_a_file_fitted_to_another_sequence_of_the_same_name_is_not_its_own(tmp_path: Path) -> None:
    dataset, model = MadeUpDataset(8), Network()
    choose = choose_prediction_scale
    scale = DepthScale(1.1, 0.0, ScaleDomain.DEPTH)
    fit = ScaleFit(
        scale, "made-up", "net", model.kind, model.weights, 0.01, None, 8, 100, 0.1, sequence_id(dataset)
    )
    own, other = tmp_path / "own.yaml", tmp_path / "other.yaml"
    write_scale(own, fit)
    write_scale(other, replace(fit, sequence_id=sequence_id(MadeUpDataset(9))))
    mine = choose(dataset, model, config_of(depth=str(own)), range(8))
    assert mine.from_ground_truth
    assert mine.how.endswith("fitted to the depth sensor of this very sequence")
    theirs = choose(dataset, model, config_of(depth=str(other)), range(8))
    assert not theirs.from_ground_truth
    assert theirs.how.endswith("fitted to the depth sensor of made-up, another sequence")
    assert theirs.sigma_log is None
