# SPDX-License-Identifier: Apache-2.0
"""Exports of a finished run: while it is in memory, or from its folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets import Dataset, ReadOptions, open_dataset
from slamdepth.datasets.addresses import without_secret
from slamdepth.datasets.readers.live import LiveReader
from slamdepth.depth.gravity_consensus import GravityConsensus
from slamdepth.errors import ConfigError, DatasetError, InputError, SlamdepthError
from slamdepth.export import (
    ExportRequest,
    ExportScene,
    ImageMode,
    View,
    export_format,
    write_export,
)
from slamdepth.export.registry import Progress
from slamdepth.export.write import check_place
from slamdepth.io import read_tum_trajectory
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map
from slamdepth.mapstore.map import is_map
from slamdepth.pipeline.camera import use_view
from slamdepth.pipeline.folder import EXPORTS, MAP, RunFolder, is_run, recorded_arguments
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.report.saved_run import map_folder, read_poses

logger = logging.getLogger(__name__)


def export_run(
    run: str | Path,
    to: str,
    output: str | Path | None = None,
    *,
    images: str = "undistorted",
    every_frame: bool = False,
    map_number: int = 1,
    recording: str | Path | None = None,
    camera: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Export a finished run to another tool's files.

    Args:
        run: the run folder.
        to: ``"colmap"``, ``"nerfstudio"``, ``"tum"``, ``"kitti"``, ``"euroc"``, ``"ply"``, ``"obj"``,
            ``"glb"`` or ``"rerun"``.
        output: folder of the export. Default: ``RUN/export/<to>``.
        images: ``"undistorted"``, ``"raw"`` or ``"none"``, for formats with images.
        every_frame: export the image of every frame that has a pose, not of keyframes alone.
        map_number: which map of the run, 1 for the largest.
        recording: what was run. Default: as the run's ``README.txt`` says.
        camera: a ``camera.yaml`` of the recording. Default: the camera that the run tracked with.
        overwrite: an earlier export in ``output`` may be replaced.
        progress: called with (images done, images in all).

    Returns:
        The folder of the export.

    Raises:
        InputError: ``run`` is no run folder, or lacks what the format needs; an option is wrong; the
            recording is missing or another one.
        OutputError: the folder cannot be written.
    """
    folder, kind, mode = Path(run).expanduser(), export_format(to), image_mode(images)
    if not is_run(folder):
        raise InputError(f"{folder}: is no run folder: it has no README.txt of 'slamdepth run'")
    place = check_place(
        default_place(folder, to, map_number) if output is None else Path(output), overwrite=overwrite
    )
    scene = scene_of_folder(folder, map_number, with_tracks=kind.has_images)
    dataset = None
    if kind.has_images and (mode is not ImageMode.NONE or scene.camera is None):
        dataset = _recording(folder, recording, camera)
        if scene.camera is not None and camera is None:
            dataset.camera = scene.camera  # the poses belong to it, whatever camera the recording has by now
    if every_frame:
        scene = scene.with_all_frames()
    request = ExportRequest(scene, dataset, mode, progress or (lambda done, total: None))
    return write_export(request, to, place, overwrite=overwrite)


def check_exports(names: Sequence[str]) -> None:
    """Refuse formats that do not exist or lack a package, before any work is done.

    Raises:
        ConfigError: one of them does.
    """
    for name in names:
        export_format(name)


def export_results(
    folder: RunFolder,
    dataset: Dataset,
    maps: Sequence[Reconstruction],
    scales: Sequence[str],
    names: Sequence[str],
    tell: ProgressCallback,
) -> tuple[str, ...]:
    """Write the exports that a run was asked for, of each of its maps; trouble becomes a note.

    Args:
        maps: the largest first.
        scales: what is said of the scale of each.
    """
    notes: list[str] = []
    for number, (one, scale) in enumerate(zip(maps, scales, strict=True), start=1):
        place = folder.make_map_folder(number)
        scene = ExportScene.of(
            one, dataset.name, mesh=place / "mesh.ply", cloud=place / "cloud.ply", scale=scale
        )
        scene = replace(scene, camera=dataset.camera)  # no keyframe has it where the run added none to a map
        request = ExportRequest(
            scene, dataset, tell=lambda done, total: tell(RunProgress(RunStage.EXPORTING, done, total))
        )
        for name in names:
            tell(RunProgress(RunStage.EXPORTING))
            try:
                write_export(request, name, default_place(folder.path, name, number), overwrite=True)
            except SlamdepthError as error:
                logger.warning("map %d is not exported to %s: %s", number, name, error)
                notes.append(f"map {number} is not exported to {name}: {error}")
    return tuple(notes)


def image_mode(name: str) -> ImageMode:
    """The mode called ``name``.

    Raises:
        ConfigError: there is none.
    """
    try:
        return ImageMode(name.lower())
    except ValueError as error:
        known = ", ".join(mode.value for mode in ImageMode)
        raise ConfigError(f"images must be one of {known}, got '{name}'") from error


def default_place(run: Path, name: str, map_number: int) -> Path:
    """Where an export of a run lies unless another folder is named."""
    return run / EXPORTS / (name if map_number == 1 else f"{name}-map{map_number}")


def scene_of_folder(folder: Path, map_number: int = 1, *, with_tracks: bool = True) -> ExportScene:
    """The scene of a run folder.

    Args:
        map_number: 1 for the largest map.
        with_tracks: read keypoints and landmarks of the saved map, where there is one.

    Raises:
        InputError: a file is missing or damaged, or there is no such map.
    """
    place = map_folder(folder, map_number)
    if map_number < 1 or not place.is_dir():
        raise InputError(f"{folder}: has no map {map_number}")
    report = _report(folder)
    trajectory, _ = read_tum_trajectory(place / "trajectory.txt")
    keyframes = read_poses(place / "keyframes.txt")  # none where the run added none to a map
    maps = report.get("maps") or [{}]
    scale = (maps[map_number - 1] if map_number <= len(maps) else {}).get("scale") or {}
    readout_ms = (report.get("rolling_shutter") or {}).get("readout_ms")
    mesh, cloud = place / "mesh.ply", place / "cloud.ply"
    scene = ExportScene(
        str(report.get("sequence", folder.name)),
        trajectory,
        tuple(
            View(*row) for row in zip(keyframes.timestamps_s.tolist(), keyframes.T_world_camera, strict=True)
        ),
        readout_s=1e-3 * float(readout_ms or 0.0),
        scale=str(scale.get("sentence", "not known")),
        mesh=mesh if mesh.is_file() else None,
        cloud=cloud if cloud.is_file() else None,
    )
    return with_saved_map(scene, Map.load(place / MAP)) if with_tracks and is_map(place / MAP) else scene


def with_saved_map(scene: ExportScene, saved: Map) -> ExportScene:
    """A scene with camera, keypoints, landmarks and gravity of a saved map in the same world.

    Of a map of several recordings, only the views of the latest are exported: its images are at hand.
    """
    keyframes, landmarks = saved.groups["keyframes"], saved.groups["landmarks"]
    seen = np.flatnonzero(landmarks["alive"] & (landmarks["observations"] >= 2))
    rows = np.full(len(landmarks["alive"]) + 1, -1)  # the last is that of no landmark
    rows[seen] = np.arange(len(seen))
    pose_s = set(scene.trajectory.timestamps_s.tolist())
    views = []
    for n in np.flatnonzero(keyframes["session"] == len(saved.sessions) - 1).tolist():
        time_s = float(keyframes["timestamp_s"][n])
        if time_s in pose_s:
            own = slice(*keyframes["first_feature"][n : n + 2].tolist())
            views.append(
                View(
                    time_s,
                    saved.T_world_camera[n],
                    keyframes["raw_px"][own],
                    rows[keyframes["landmark"][own]],
                )
            )
    gravity, graph = GravityConsensus(), saved.groups["graph"]
    gravity.restore(
        {"gravity_w": graph["gravity_w"], "confidence": graph["gravity_confidence"], "queries": 0}
    )
    return replace(
        scene,
        views=tuple(sorted(views, key=lambda view: view.timestamp_s)),
        camera=saved.camera,
        points_m=saved.points_m,
        readout_s=saved.shutter[0],
        gravity_w=gravity.in_world(),
    )


def _report(folder: Path) -> dict[str, Any]:
    path = folder / "report.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: missing: the run did not end; run it again") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not isinstance(report, dict):
        raise InputError(f"{path}: is no report of a run")
    return report


def _recording(folder: Path, recording: str | Path | None, camera: str | Path | None) -> Dataset:
    """The recording of a run, with the camera that it was run with."""
    arguments = recorded_arguments(folder)
    given = dict(pairwise(arguments))
    if camera is None:
        camera = given.get("--camera")
    reading = ReadOptions(
        given.get("--topic"), given.get("--depth-topic"), follow_links="--follow-links" in arguments
    )
    path = Path(recording) if recording is not None else Path(arguments[0]) if arguments else None
    if path is None:
        raise InputError(f"{folder}: does not say what was run: name it by --recording")
    if LiveReader().matches(path):
        raise InputError(
            f"{without_secret(str(path))}: is a live source, whose images are not kept: use --images none"
        )
    try:
        dataset = open_dataset(path, camera, reading)
    except DatasetError as error:
        if recording is not None or path.exists():
            raise
        raise InputError(
            f"{path}: the recording of this run is not there: start in the folder that the run was started "
            "in, or name it by --recording"
        ) from error
    if camera is None and "--fov" in given:
        use_view(dataset, float(given["--fov"]))
    return dataset
