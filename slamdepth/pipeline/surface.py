# SPDX-License-Identifier: Apache-2.0
"""Scores of a mesh against what the sequence's own depth sensor saw from the true poses."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.datasets.base import read_sound
from slamdepth.datasets.sensor_depth import check_sensor_depth, lack_of_depth
from slamdepth.datasets.sequence import MAX_TIME_DIFFERENCE_S
from slamdepth.errors import DatasetError, ImageDecodeError, SlamdepthError
from slamdepth.evaluation.pose_alignment import PoseAlignment, align_by_poses, poses_at
from slamdepth.evaluation.surface import CUT_M, AlignedScores, Surface, score_surface, vertex_errors_m
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.sensor_surface import SensorFrame, SensorSurface, fuse_sensor
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

logger = logging.getLogger(__name__)

REFERENCE_FRAMES = 100
"""A reference is made of this many frames, spread evenly over the sequence."""

_VOXEL_M = 0.02
_MAX_DEPTH_M = 4.0  # beyond it, a Kinect errs by more than 2 cm


def sensor_reference(
    dataset: Dataset,
    indices: Sequence[int] | None = None,
    *,
    voxel_m: float = _VOXEL_M,
    max_depth_m: float = _MAX_DEPTH_M,
    frames: int = REFERENCE_FRAMES,
    progress: Callable[[int, int], None] | None = None,
) -> SensorSurface:
    """The surface that the sensor of ``dataset`` saw, in the world of its ground truth.

    Args:
        indices: frames to take it from; None: all.
        voxel_m: edge of a voxel of its TSDF.
        max_depth_m: depth beyond it counts as unknown.
        frames: at most this many, spread evenly.
        progress: called with (frames done, frames in all).

    Raises:
        DatasetError: there is no sensor depth, no ground truth, or no surface in them.
        SlamdepthError: Open3D is not installed.
    """
    if not dataset.has_depth:
        raise DatasetError(
            f"{dataset.path}: {lack_of_depth(dataset)}, so there is no surface to compare with"
        )
    if dataset.ground_truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth, so its depth cannot be put together")
    numbers = np.asarray(range(len(dataset)) if indices is None else indices, np.int64)
    check_sensor_depth(dataset, numbers.tolist())
    rows, poses = poses_at(dataset.ground_truth, dataset.timestamps_s[numbers], MAX_TIME_DIFFERENCE_S)
    posed = numbers[rows]
    if len(posed) == 0:
        raise DatasetError(f"{dataset.path}: no image has a ground truth pose of its time")
    chosen = np.unique(np.linspace(0, len(posed) - 1, min(frames, len(posed))).round().astype(int))
    read: list[SensorFrame] = []
    for done, k in enumerate(chosen.tolist(), start=1):
        try:
            frame, _ = read_sound(dataset, int(posed[k]), with_depth=True)
        except ImageDecodeError as error:
            logger.debug("frame %d is no part of the reference: %s", posed[k], error)
            continue
        finally:
            if progress is not None:
                progress(done, len(chosen))
        if frame.depth_m is not None:
            read.append(SensorFrame(frame.depth_m, frame.camera, poses[k]))
    surface = fuse_sensor(read, voxel_m, max_depth_m, CUT_M)
    if len(surface.triangles) == 0:
        raise DatasetError(f"{dataset.path}: its sensor depth within {max_depth_m:g} m holds no surface")
    return surface


def score_mesh(
    dataset: Dataset,
    indices: Sequence[int],
    mesh: Mesh | None,
    trajectory: Trajectory,
    progress: Callable[[int, int], None] | None = None,
    *,
    is_measured: bool = False,
) -> tuple[AlignedScores | None, Floats | None, tuple[str, ...]]:
    """Score a run's mesh where the sequence has sensor depth and ground truth; trouble becomes a note.

    Args:
        indices: frames of the run.
        mesh: in the world of the run.
        trajectory: of the run, by which it is aligned.
        progress: called with (frames of the reference done, frames in all).
        is_measured: a sensor measured the run's depth, so that its scale stays as it is.

    Returns:
        The scores; the distance ``(V,)`` in true metres of each vertex to what the sensor saw, aligned with
        scale unless it is measured, NaN where it cannot be judged; and notes.
    """
    if mesh is None or dataset.ground_truth is None or not dataset.has_depth:
        return None, None, ()
    try:
        alignment = align_by_poses(dataset.ground_truth, trajectory, MAX_TIME_DIFFERENCE_S)
        reference = sensor_reference(dataset, indices, progress=progress)
        scores = score_against(reference, surface_of(mesh), alignment)
    except SlamdepthError as error:
        logger.warning("the mesh is not scored: %s", error)
        return None, None, (f"the mesh is not scored: {error}",)
    aligned = surface_of(mesh).moved(alignment.se3 if is_measured else alignment.sim3)
    return scores, vertex_errors_m(aligned, truth_of(reference), reference.can_judge), ()


def score_against(reference: SensorSurface, surface: Surface, alignment: PoseAlignment) -> AlignedScores:
    """Score a surface of a run's world, aligned without and with scale.

    Raises:
        DatasetError: nothing of it lies where the reference can judge.
    """
    se3, sim3 = (
        score_surface(surface.moved(T), truth_of(reference), reference.can_judge)
        for T in (alignment.se3, alignment.sim3)
    )
    return AlignedScores(se3, sim3)


def truth_of(reference: SensorSurface) -> Surface:
    """The reference as a surface to score against."""
    return Surface(reference.vertices_m, reference.triangles.astype(np.int64))


def surface_of(mesh: Mesh) -> Surface:
    """A mesh as a surface to score."""
    return Surface(mesh.vertices_m, mesh.triangles.astype(np.int64))
