# SPDX-License-Identifier: Apache-2.0
"""A mesh file against a reference: another file, or what the sensor of a sequence saw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from slamdepth.datasets import ReadOptions, open_dataset
from slamdepth.datasets.sequence import MAX_TIME_DIFFERENCE_S
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.evaluation import Surface, SurfaceScore, score_surface, vertex_errors_m
from slamdepth.evaluation.pose_alignment import align_by_poses
from slamdepth.evaluation.surface_file import read_surface
from slamdepth.io import read_tum_trajectory
from slamdepth.mapping.sensor_surface import SensorSurface
from slamdepth.pipeline.options import RunOptions
from slamdepth.pipeline.surface import sensor_reference, truth_of
from slamdepth.typing import Floats


class Alignment(str, Enum):
    """How the frame of a mesh is brought into that of its reference."""

    NONE = "none"
    SE3 = "se3"
    SIM3 = "sim3"


@dataclass(frozen=True)
class MeshQuestion:
    """What ``slamdepth evaluate-mesh`` was asked.

    Attributes:
        mesh: a mesh or point cloud file, or a run folder.
        reference: a mesh or point cloud file, or a sequence with sensor depth and ground truth.
        align: None takes ``sim3`` where there is a trajectory to align by, else ``none``.
        trajectory: of the world of the mesh; None takes that of the run folder.
        camera_file: a ``camera.yaml`` of the sequence.
        max_frames: of the sequence; None takes all.
        max_depth_m: depth of the sequence beyond it counts as unknown.
        reading: how the sequence is opened.
    """

    mesh: Path
    reference: Path
    align: Alignment | None = None
    trajectory: Path | None = None
    camera_file: Path | None = None
    max_frames: int | None = None
    max_depth_m: float = 4.0
    reading: ReadOptions | None = None


@dataclass(frozen=True)
class MeshEvaluation:
    """What it found.

    Attributes:
        score: of the aligned mesh.
        align: how it was aligned.
        T_reference_mesh: ``(4, 4)``; its rotation part is multiplied by the scale.
        estimate, reference: the two surfaces in the frame of the reference.
        accuracy_m, completion_m: distance ``(V,)`` of the vertices of each to the other; NaN where one of the
            estimate is not judged.
        cameras: true poses ``(N, 4, 4)`` of a sequence; None of a file.
        notes: what was guessed, one line each.
    """

    score: SurfaceScore
    align: Alignment
    T_reference_mesh: Floats
    estimate: Surface
    reference: Surface
    accuracy_m: Floats
    completion_m: Floats
    cameras: Floats | None
    notes: tuple[str, ...]


def evaluate_mesh(asked: MeshQuestion, progress: Callable[[int, int], None] | None = None) -> MeshEvaluation:
    """Score a mesh; frames are aligned by the poses of its run or not at all, never by fitting surfaces.

    Args:
        progress: called with (frames of the reference done, frames in all).

    Raises:
        InputError: a file or the sequence is wrong, or the alignment asked for is not possible.
        SlamdepthError: Open3D is not installed.
    """
    mesh, trajectory, notes = _files(asked)
    surface = read_surface(mesh)
    if asked.reference.is_dir():
        return _against_sequence(asked, surface, trajectory, notes, progress)
    if asked.align not in (None, Alignment.NONE) or asked.trajectory is not None:
        raise ConfigError(
            f"{asked.reference}: is no folder of a sequence, so there is no ground truth to align "
            "trajectories by; align the files beforehand and leave out --align and --trajectory"
        )
    truth = read_surface(asked.reference)
    return _evaluated(surface, truth, None, Alignment.NONE, np.eye(4), notes)


def _files(asked: MeshQuestion) -> tuple[Path, Path | None, list[str]]:
    """The mesh file, the file of the trajectory of its world where there is one, and notes."""
    if asked.mesh.is_dir():
        mesh = asked.mesh / "mesh.ply"
        if not mesh.is_file():
            raise DatasetError(f"{asked.mesh}: is a folder without mesh.ply, so it is no run with a mesh")
        return mesh, asked.trajectory or asked.mesh / "trajectory.txt", []
    if asked.trajectory is not None or asked.align is Alignment.NONE or not asked.reference.is_dir():
        return asked.mesh, asked.trajectory, []
    beside = asked.mesh.with_name("trajectory.txt")
    if not beside.is_file():
        return asked.mesh, None, []
    return asked.mesh, beside, ["aligned by the trajectory.txt next to the mesh; --trajectory names another"]


def _against_sequence(
    asked: MeshQuestion,
    surface: Surface,
    trajectory: Path | None,
    notes: list[str],
    progress: Callable[[int, int], None] | None,
) -> MeshEvaluation:
    dataset = open_dataset(asked.reference, asked.camera_file, asked.reading)
    align = asked.align or (Alignment.NONE if trajectory is None else Alignment.SIM3)
    T = np.eye(4)
    if align is not Alignment.NONE:
        if trajectory is None:
            raise ConfigError(
                f"--align {align.value} needs the trajectory of the mesh: name its run folder as MESH, or "
                "add --trajectory FILE"
            )
        if dataset.ground_truth is None:
            raise DatasetError(f"{dataset.path}: has no ground truth to align to")
        path, path_notes = read_tum_trajectory(trajectory, dataset.timestamps_s)
        found = align_by_poses(dataset.ground_truth, path, MAX_TIME_DIFFERENCE_S)
        T = found.se3 if align is Alignment.SE3 else found.sim3
        notes = [*notes, *path_notes]
    indices = RunOptions(asked.reference, max_frames=asked.max_frames).indices(len(dataset))
    seen = sensor_reference(dataset, indices, max_depth_m=asked.max_depth_m, progress=progress)
    return _evaluated(surface, truth_of(seen), seen, align, T, [*dataset.notes, *notes])


def _evaluated(
    surface: Surface,
    reference: Surface,
    seen: SensorSurface | None,
    align: Alignment,
    T: Floats,
    notes: list[str],
) -> MeshEvaluation:
    estimate = surface.moved(T)
    can_judge = None if seen is None else seen.can_judge
    return MeshEvaluation(
        score_surface(estimate, reference, can_judge),
        align,
        T,
        estimate,
        reference,
        vertex_errors_m(estimate, reference, can_judge),
        vertex_errors_m(reference, estimate),
        None if seen is None else seen.cameras,
        tuple(notes),
    )
