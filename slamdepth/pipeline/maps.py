# SPDX-License-Identifier: Apache-2.0
"""The files and figures of each map of a run: the largest one, and those that never met it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.errors import SlamdepthError
from slamdepth.io import write_tum_trajectory
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.dense import measure_depth
from slamdepth.pipeline.folder import RunFolder
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.pipeline.results import (
    judge_trajectory,
    keyframe_trajectory,
    write_keyframe_mesh,
    write_measured_cloud,
)
from slamdepth.pipeline.scale import scale_of_other
from slamdepth.report import MapData, MeshCounts, MeshImage, write_mesh_png

logger = logging.getLogger(__name__)


def settle_others(
    dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale, config: Config
) -> tuple[tuple[MapData, ...], tuple[str, ...]]:
    """The maps that never met the largest one at their final scale, and notes on what failed.

    Args:
        reconstruction: the largest map, as the tracker returned it.
        before: what was applied to the predictions the maps were made of.
    """
    found: list[MapData] = []
    notes: list[str] = []
    for number, other in enumerate(reconstruction.others, start=2):
        settled, facts, lines = scale_of_other(dataset, other, before, config)
        logger.info("scale of map %d: %s", number, facts.sentence)
        found.append(MapData(settled, facts))
        notes += _of_map(number, lines)
    return tuple(found), tuple(notes)


def write_trajectories(folder: RunFolder, maps: Sequence[Reconstruction]) -> None:
    """Write ``trajectory.txt`` and ``keyframes.txt`` of each map into its folder.

    Raises:
        OutputError: one of them cannot be written.
    """
    for number, one in enumerate(maps, start=1):
        place = folder.make_map_folder(number)
        write_tum_trajectory(place / "trajectory.txt", one.trajectory)
        write_tum_trajectory(place / "keyframes.txt", keyframe_trajectory(one))


def write_mesh(
    folder: RunFolder, number: int, reconstruction: Reconstruction, config: Config, tell: ProgressCallback
) -> tuple[Mesh | None, tuple[MeshImage, ...], tuple[str, ...]]:
    """Write ``mesh.ply`` and ``cloud.ply`` of one map, and ``mesh.png`` of the largest.

    Args:
        number: of the map, 1 for the largest.

    Returns:
        The mesh, images of it, and notes; trouble becomes a note.
    """
    tell(RunProgress(RunStage.MESHING))
    mesh: Mesh | None = None
    images: tuple[MeshImage, ...] = ()
    place = folder.make_map_folder(number)
    try:
        mesh, images, notes = write_keyframe_mesh(
            reconstruction, config, place / "mesh.ply", tell, with_images=number == 1
        )
        notes += write_measured_cloud(reconstruction, config, place / "cloud.ply")
    except SlamdepthError as error:
        notes = (f"no mesh: {error}",)
    notes = _of_map(number, notes)
    for note in notes:
        logger.warning("%s", note)
    if images:
        write_mesh_png(place / "mesh.png", images)
    return mesh, images, notes


def finish_others(
    dataset: Dataset,
    others: Sequence[MapData],
    config: Config,
    folder: RunFolder,
    tell: ProgressCallback,
    *,
    mesh: bool,
    is_measured: bool,
) -> tuple[tuple[MapData, ...], tuple[Mesh | None, ...], tuple[str, ...]]:
    """Mesh and score the maps that never met the largest one.

    Args:
        mesh: write their ``mesh.ply`` and ``cloud.ply``.
        is_measured: a sensor measured the depth.

    Returns:
        The maps with size of the mesh and score, their meshes, and notes.
    """
    found: list[MapData] = []
    meshes: list[Mesh | None] = []
    notes: list[str] = []
    for number, one in enumerate(others, start=2):
        made: Mesh | None = None
        if mesh:
            dense = measure_depth(dataset, one.reconstruction, config, tell)
            made, _, lines = write_mesh(folder, number, dense, config, tell)
            one = replace(one, mesh=MeshCounts.of(made), reconstruction=dense)
            notes += lines
        score, lines = judge_trajectory(dataset, one.reconstruction.trajectory, is_measured=is_measured)
        found.append(replace(one, trajectory_score=score))
        meshes.append(made)
        notes += _of_map(number, lines)
    return tuple(found), tuple(meshes), tuple(notes)


def _of_map(number: int, notes: Sequence[str]) -> tuple[str, ...]:
    """Notes that name the map, unless it is the largest."""
    return tuple(notes) if number == 1 else tuple(f"map {number}: {note}" for note in notes)
