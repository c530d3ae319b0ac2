# SPDX-License-Identifier: Apache-2.0
"""A run folder read back: figures, paths, keyframes, meshes."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.io import read_lines, read_tum_trajectory
from slamdepth.mapping.mesh import Mesh
from slamdepth.open3d_loader import import_open3d
from slamdepth.report.scene.file import SCENE_FILE, read_scene
from slamdepth.report.scene.model import Scene, SceneMap
from slamdepth.types import Trajectory


@dataclass(frozen=True)
class SavedRun:
    """A finished run.

    Attributes:
        folder: of the run.
        summary: the content of ``report.json``.
        scene: its maps with their paths; meshes are read by :meth:`with_meshes`.
        notes: what is missing, one line each.
    """

    folder: Path
    summary: dict[str, Any]
    scene: Scene
    notes: tuple[str, ...] = ()

    def map_folder(self, number: int) -> Path:
        """Where the files of a map are, 1 for the largest."""
        return map_folder(self.folder, number)

    def with_meshes(self) -> SavedRun:
        """The run with the mesh of each map that has one.

        Raises:
            DatasetError: a mesh is damaged.
            SlamdepthError: Open3D is not installed.
        """
        maps = tuple(
            replace(one, mesh=read_mesh(path))
            if (path := self.map_folder(one.number) / "mesh.ply").is_file()
            else one
            for one in self.scene.maps
        )
        return replace(self, scene=replace(self.scene, maps=maps))


def map_folder(folder: Path, number: int) -> Path:
    """Where the files of a map of a run are, 1 for the largest."""
    return folder if number == 1 else folder / "maps" / str(number)


def read_run(folder: Path) -> SavedRun:
    """Read a run folder; one of an older slamdepth, without ``scene.safetensors``, has no images.

    Raises:
        DatasetError: it is no folder of a finished run, or a file of it is damaged.
    """
    folder = folder.expanduser()
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such run folder")
    path = folder / "report.json"
    if not path.is_file():
        started = (folder / "trajectory_online.txt").is_file()
        what = "the run has not finished" if started else "no folder of 'slamdepth run'"
        raise DatasetError(f"{folder}: {what}: it has no report.json")
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        missing = {"sequence", "health", "frames", "tracked", "ate", "settings"} - set(summary)
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from error
    if missing:
        raise DatasetError(f"{path}: is no report of a run: it has no {', '.join(sorted(missing))}")
    saved = folder / SCENE_FILE
    if saved.is_file():
        scene = read_scene(saved)
        maps = tuple(replace(one, path=_path_of(folder, one.number)) for one in scene.maps)
        return SavedRun(folder, summary, replace(scene, maps=maps))
    numbers = range(1, len(summary.get("maps") or [1]) + 1)
    note = f"{folder}: made by an older slamdepth; without {SCENE_FILE} there are no images, loops and points"
    return SavedRun(folder, summary, Scene(tuple(_bare_map(folder, n) for n in numbers)), (note,))


def read_mesh(path: Path) -> Mesh:
    """Read ``mesh.ply`` of a run.

    Raises:
        DatasetError: it has no triangles or is damaged.
        SlamdepthError: Open3D is not installed.
    """
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        read = o3d.io.read_triangle_mesh(str(path))
    if len(read.triangles) == 0 or not np.isfinite(np.asarray(read.vertices)).all():
        raise DatasetError(f"{path}: holds no mesh that can be read")
    vertices = np.asarray(read.vertices, np.float32)
    colors = (
        np.asarray(read.vertex_colors, np.float32) if read.has_vertex_colors() else np.zeros_like(vertices)
    )
    return Mesh(vertices, np.asarray(read.triangles, np.int32), colors)


def read_poses(path: Path) -> Trajectory:
    """Read ``trajectory.txt`` or ``keyframes.txt`` of a run, which hold no pose where the run has none.

    Raises:
        DatasetError: the file is missing or damaged.
    """
    return read_tum_trajectory(path)[0] if read_lines(path) else Trajectory.empty()


def _path_of(folder: Path, number: int) -> Trajectory:
    return _poses_if_any(map_folder(folder, number) / "trajectory.txt")


def _poses_if_any(path: Path) -> Trajectory:
    return read_poses(path) if path.is_file() else Trajectory.empty()


def _bare_map(folder: Path, number: int) -> SceneMap:
    keyframes = _poses_if_any(map_folder(folder, number) / "keyframes.txt")
    return SceneMap(number, _path_of(folder, number), np.arange(len(keyframes)), keyframes)
