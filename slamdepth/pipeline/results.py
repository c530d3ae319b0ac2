# SPDX-License-Identifier: Apache-2.0
"""Mesh and scores of a finished reconstruction."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.datasets.sensor_depth import check_sensor_depth
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.evaluation import (
    DepthScore,
    DepthScorer,
    Health,
    MapFacts,
    RunFacts,
    TrajectoryScore,
    judge_run,
    score_trajectory,
)
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.report import MeshImage, ScaleFacts, render_mesh_images
from slamdepth.types import DepthKind, StepResult, Trajectory

logger = logging.getLogger(__name__)

_SENSOR_SCALE = 1.25  # a sensor's scale error stays below this factor and its inverse


def keyframe_trajectory(reconstruction: Reconstruction) -> Trajectory:
    """The keyframes' poses as a trajectory."""
    keyframes = reconstruction.keyframes
    poses = [keyframe.T_world_camera for keyframe in keyframes]
    return Trajectory(
        np.array([keyframe.frame.timestamp_s for keyframe in keyframes], dtype=np.float64),
        np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
        reconstruction.trajectory.is_metric,
    )


def write_keyframe_mesh(
    reconstruction: Reconstruction,
    config: Config,
    path: Path,
    progress: ProgressCallback,
    *,
    with_images: bool = True,
) -> tuple[Mesh | None, tuple[MeshImage, ...], tuple[str, ...]]:
    """Fuse the keyframes and write the mesh.

    Args:
        with_images: also render images of it.

    Returns:
        The mesh, or None where there is no surface and no file; images of it; and notes.

    Raises:
        OutputError: ``path`` cannot be written.
    """

    def report(done: int, total: int) -> None:
        progress(RunProgress(RunStage.MESHING, done, total))

    mesh = reconstruction.fuse_mesh(
        config.map.voxel_size_m,
        max_depth_m=config.map.max_depth_m,
        min_component_triangles=config.map.min_component_triangles,
        progress=report,
    )
    if len(mesh.triangles) == 0:
        return None, (), mesh.notes
    mesh.save(path)
    if with_images:
        progress(RunProgress(RunStage.DRAWING))
    images = render_mesh_images(mesh, reconstruction) if with_images else ()
    return mesh, images, mesh.notes


def write_measured_cloud(reconstruction: Reconstruction, config: Config, path: Path) -> tuple[str, ...]:
    """Write the measured points, if there are any, two to the edge of a voxel of the mesh; returns notes.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    cloud = reconstruction.measured_cloud(config.map.voxel_size_m / 2, max_depth_m=config.map.max_depth_m)
    if len(cloud):
        cloud.save(path)
    return cloud.notes


def judge_trajectory(
    dataset: Dataset, estimate: Trajectory, *, is_measured: bool = False
) -> tuple[TrajectoryScore | None, tuple[str, ...]]:
    """Score against the ground truth where there is one; a failure becomes a note.

    Args:
        is_measured: a sensor's depth made the map, so that its scale should be the truth's.
    """
    if dataset.ground_truth is None:
        return None, ()
    try:
        score = score_trajectory(dataset.ground_truth, estimate)
    except DatasetError as error:
        logger.warning("the trajectory is not scored: %s", error)
        return None, (f"the trajectory is not scored: {error}",)
    factor = score.sim3.scale
    if not is_measured or 1 / _SENSOR_SCALE <= factor <= _SENSOR_SCALE:
        return score, ()
    note = (
        f"a sensor measured the depth, yet the map would have to be multiplied by {factor:.3g} to fit the "
        "ground truth: check depth_factor and the intrinsics, and the unit of the ground truth"
    )
    logger.warning("%s", note)
    return score, (note,)


def judge_health(
    reconstruction: Reconstruction,
    steps: Sequence[StepResult],
    config: Config,
    scale: ScaleFacts,
    *,
    is_measured: bool,
    camera_is_guessed: bool = False,
) -> Health:
    """Whether the result can be trusted, by what the run knows of itself.

    Args:
        reconstruction: the largest map, with the others.
        steps: one for each frame, in order.
        scale: of the largest map.
        is_measured: a sensor measured the depth.
        camera_is_guessed: the focal length was guessed, and the motion does not show it.
    """
    health = judge_run(
        RunFacts(
            steps,
            reconstruction.trajectory,
            reconstruction.points_m,
            reconstruction.statistics,
            is_measured,
            config.tracking.min_inliers,
            tuple(MapFacts(one.trajectory, one.points_m, one.statistics) for one in reconstruction.others),
            scale_is_known=not scale.is_unknown,
            camera_is_guessed=camera_is_guessed,
        )
    )
    logger.info("verdict: %s. %s", health.verdict.value, health.headline)
    return health


def score_depth(
    dataset: Dataset, keyframes: tuple[Keyframe, ...]
) -> tuple[DepthScore | None, tuple[str, ...]]:
    """Compare the keyframes' predicted depth, as the tracker got it, with the sensor's; depth images that
    cannot be a sensor's become a note."""
    predicted = [
        keyframe
        for keyframe in keyframes
        if not keyframe.prediction.is_sensor and keyframe.prediction.kind is DepthKind.METRIC
    ]
    if not dataset.has_depth or not predicted:
        return None, ()
    try:
        notes = tuple(check_sensor_depth(dataset, [keyframe.frame.index for keyframe in predicted]))
    except DatasetError as error:
        logger.warning("predicted depth is not scored: %s", error)
        return None, (f"predicted depth is not scored: {error}",)
    scorer = DepthScorer()
    for keyframe in predicted:
        try:
            sensor_m = dataset.read(keyframe.frame.index, with_depth=True).depth_m
        except ImageDecodeError as error:
            logger.debug("depth of keyframe %d is not scored: %s", keyframe.id, error)
            continue
        if sensor_m is not None:
            scorer.add(keyframe.prediction.load().values, sensor_m)
    return scorer.score(), notes
