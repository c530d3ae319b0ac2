# SPDX-License-Identifier: Apache-2.0
"""A run made up for the tests of its report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from surfaces import wall

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given
from slamdepth.evaluation import (
    AlignedScores,
    DepthScorer,
    Health,
    MapFacts,
    RunFacts,
    SurfaceScore,
    judge_run,
    score_surface,
    score_trajectory,
)
from slamdepth.geometry import se3_exp
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import (
    MapData,
    MeshCounts,
    ReportData,
    ScaleFacts,
    ScalePart,
    ScaleSource,
)
from slamdepth.types import (
    Camera,
    DepthKind,
    DepthPrediction,
    Frame,
    RunStatistics,
    StepResult,
    TrackingStatus,
    Trajectory,
    WeightsInfo,
)

COUNT = 80


CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)


SCALE = ScaleFacts(
    ScaleSource.CAMERA_HEIGHT,
    1.2,
    "Scale comes from the network.",
    uncertainty_log=0.03,
    keyframes=6,
    spread=0.1,
    parts=(
        ScalePart(ScaleSource.NETWORK, 1.0, 0.2, 0.02),
        ScalePart(ScaleSource.CAMERA_HEIGHT, 1.21, 0.03, 0.98, "a camera height of 1.4 m"),
        ScalePart(ScaleSource.MARKER, 3.0, None, 0.0, "a marker"),
    ),
)


def trajectory(noise: float = 0.0) -> Trajectory:
    t = np.arange(COUNT) / 30.0
    rng = np.random.default_rng(1)
    tangents = np.stack([np.sin(t), 0.1 * t, 0.5 * np.cos(t), 0.1 * t, 0.3 * t, 0 * t], axis=1)
    poses = se3_exp(tangents) @ se3_exp(noise * rng.normal(size=(COUNT, 6)))
    return Trajectory(100.0 + t, poses)


def keyframe(number: int, *, is_sensor: bool = False) -> Keyframe:
    rng = np.random.default_rng(number)
    image = rng.integers(0, 255, size=(24, 32, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 4.0, size=(24, 32)).astype(np.float32)
    depth[0] = 0.0
    frame = StoredFrame(Frame(number * 10, 100.0 + number / 3, image, CAMERA, depth))
    prediction = StoredPrediction(DepthPrediction(depth, DepthKind.METRIC, is_sensor=is_sensor))
    pose = trajectory().T_world_camera[number * 10]
    return Keyframe(number, frame, pose, np.zeros((1, 2)), 1.0 + 0.1 * number, prediction, as_given)


def surface_score(distance_m: float) -> SurfaceScore:
    """The score of a wall that far from the true one."""
    return score_surface(wall(2.0 + distance_m), wall(2.0))


def health_of(run: Reconstruction, steps: tuple[StepResult, ...] = ()) -> Health:
    others = tuple(MapFacts(one.trajectory, one.points_m, one.statistics) for one in run.others)
    return judge_run(
        RunFacts(steps, run.trajectory, run.points_m, run.statistics, depth_is_measured=False, others=others)
    )


def full_data() -> ReportData:
    truth, estimate = trajectory(), trajectory(noise=0.01)
    kept = np.r_[0:30, 40:COUNT]
    estimate = Trajectory(estimate.timestamps_s[kept], estimate.T_world_camera[kept])
    keyframes = tuple(keyframe(i) for i in range(6))
    scorer = DepthScorer(stride=1)
    for k in keyframes:
        truth_m = k.frame.load().depth_m
        assert truth_m is not None
        scorer.add(k.load_depth_m() * 1.1, truth_m)
    states = [TrackingStatus.INITIALISING, *[TrackingStatus.TRACKING] * 29, *[TrackingStatus.LOST] * 10]
    states += [TrackingStatus.RELOCALISED, *[TrackingStatus.TRACKING] * 39]
    steps = tuple(
        StepResult(i, 100.0 + i / 30, state, None, inliers=100 + i, is_keyframe=i % 10 == 0)
        for i, state in enumerate(states)
    )
    run = Reconstruction(
        trajectory=estimate,
        keyframes=keyframes,
        points_m=np.random.default_rng(0).normal(size=(500, 3)),
        notes=("the tracker's <note>",),
        statistics=RunStatistics(
            frames=COUNT,
            tracked=70,
            loop_closures=1,
            relocalisations=1,
            timings_ms={"features": 7.5, "depth": 180.0},
            timing_calls={"features": 80, "depth": 6},
        ),
    )
    return ReportData(
        sequence="room <1>",
        depth_model="dinov2",
        depth_is_measured=False,
        reconstruction=run,
        fps=12.5,
        config=Config(),
        scale=SCALE,
        health=health_of(run, steps),
        weights=(WeightsInfo("head & backbone", "ab" * 32, "some rooms", "Apache-2.0"),),
        steps=steps,
        trajectory_score=score_trajectory(truth, estimate),
        depth_score=scorer.score(),
        mesh=MeshCounts(1234, 5678),
        surface_scores=AlignedScores(surface_score(0.1), surface_score(0.03)),
        skipped_frames=2,
        notes=("3 rows dropped",),
        options={"stride": 1, "max_frames": None},
        files={"mesh.ply": "coloured mesh"},
    )


def several_maps_data() -> ReportData:
    """A run of 90 frames: 70 in the largest map, 6 and 4 in two that never met it, 10 without a pose."""
    data = full_data()
    others = []
    for first, count, factor in ((81, 6, 2.0), (87, 4, 0.5)):
        poses = trajectory().T_world_camera[:count].copy()
        poses[:, :3, 3] *= factor
        path = Trajectory(100.0 + np.arange(first, first + count) / 30.0, poses)
        others.append(
            Reconstruction(path, (), np.zeros((5, 3)), statistics=RunStatistics(frames=count, tracked=count))
        )
    placed = [
        StepResult(80 + n, 100.0 + n / 30, TrackingStatus.TRACKING, np.eye(4), 90, map_id=1 + (n > 86))
        for n in range(81, 91)
    ]
    run = replace(
        data.reconstruction,
        others=tuple(others),
        statistics=replace(data.reconstruction.statistics, frames=90, maps_joined=1),
    )
    steps = (*data.steps, *placed)
    scales = (SCALE, ScaleFacts(ScaleSource.VALUE, 1.5, "A number.", None))
    maps = tuple(MapData(one, scale) for one, scale in zip(others, scales, strict=True))
    return replace(data, reconstruction=run, steps=steps, others=maps, health=health_of(run, steps))


def bare_data() -> ReportData:
    """A run that was stopped before its first frame."""
    nothing = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    run = Reconstruction(nothing, (), np.empty((0, 3)))
    return ReportData(
        "empty",
        "sensor",
        True,
        run,
        0.0,
        Config(),
        ScaleFacts(ScaleSource.SENSOR, 1.0, "The sensor's."),
        health_of(run),
    )
