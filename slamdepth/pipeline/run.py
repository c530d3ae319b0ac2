# SPDX-License-Identifier: Apache-2.0
"""The main job: one sequence in, one run folder out."""

from __future__ import annotations

import logging
import random
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.config import Config, merge
from slamdepth.datasets import Dataset, ReadOptions, open_dataset
from slamdepth.datasets.addresses import without_secret
from slamdepth.datasets.sensor_depth import check_sensor_depth, lack_of_depth
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.metric import configured_model, with_chosen_model
from slamdepth.depth.scale_file import write_scale
from slamdepth.errors import DatasetError, OutputError, SlamdepthError
from slamdepth.frontend.features import feature_weights
from slamdepth.io import write_text
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapstore import Map, Session
from slamdepth.pipeline import checkpoint
from slamdepth.pipeline.camera import OpeningCamera, check_camera, settle_camera, use_view
from slamdepth.pipeline.checkpoint import Checkpoints, Latest, SequenceKeyframes, begin
from slamdepth.pipeline.dense import measure_depth
from slamdepth.pipeline.export import check_exports, export_results
from slamdepth.pipeline.folder import (
    EXPORTS,
    EXPORTS_CONTENT,
    FILES,
    MAP,
    MAP_CONTENT,
    MAPS,
    MAPS_CONTENT,
    RunFolder,
    run_log,
    write_log_to,
)
from slamdepth.pipeline.maps import finish_others, settle_others, write_mesh, write_trajectories
from slamdepth.pipeline.options import (
    CHECKPOINT_S,
    ProgressCallback,
    RunOptions,
    RunProgress,
    RunResult,
    RunStage,
)
from slamdepth.pipeline.prediction_scale import (
    PredictionScale,
    check_scale_options,
    choose_prediction_scale,
)
from slamdepth.pipeline.results import judge_health, judge_trajectory, score_depth
from slamdepth.pipeline.saved_maps import inherited_scale, start_map_notes, write_maps
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.surface import score_mesh
from slamdepth.pipeline.tracking import AnyTracker, Tracked, Watcher, track
from slamdepth.report import MeshCounts, MeshImage, ReportData, render_errors, write_report
from slamdepth.report.scene import SCENE_FILE, scene_of, write_scene
from slamdepth.tracking import Tracker

logger = logging.getLogger(__name__)


def run(
    sequence: str | Path,
    output: str | Path | None = None,
    *,
    depth: str | None = None,
    camera: str | Path | None = None,
    view_deg: float | None = None,
    config: Config | str | Path | None = None,
    max_frames: int | None = None,
    stride: int = 1,
    mesh: bool = True,
    overwrite: bool = False,
    start_map: str | Path | None = None,
    map_images: bool = False,
    checkpoint_s: float | None = None,
    reading: ReadOptions | None = None,
    export: Sequence[str] = (),
    progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
    watcher: Watcher | None = None,
) -> RunResult:
    """Track a sequence, mesh it, score it, and write everything into a run folder.

    It does what ``slamdepth run`` does, without printing. Bad input leaves no folder behind. The random
    generators of Python, NumPy, OpenCV and, where it is loaded, torch are seeded from ``config.seed``.

    Args:
        sequence: a video, a folder of images or of a known layout, a bag, or a live source such as
            ``camera:0`` or an address of RTSP; docs/inputs.md lists all.
        output: run folder. Default: ``runs/<sequence>-<time>``.
        depth: name of the depth model, see :func:`slamdepth.create_depth_model`; ``"sensor"`` takes the
            sequence's own depth. Default: as ``config`` says, which is ``"auto"`` unless changed.
        camera: a ``camera.yaml`` with the intrinsics. Default: as the sequence says; where it does not,
            they are found from the motion.
        view_deg: field of view in degrees across the longer side of an image, about which the focal length
            is looked for; instead of ``camera``.
        config: every other setting, or a YAML file with settings. Default: ``Config()``.
        max_frames: stop after this many frames. Default: all.
        stride: take every Nth frame.
        mesh: fuse the keyframes and write ``mesh.ply`` and ``cloud.ply``.
        overwrite: an earlier run in ``output`` may be replaced.
        start_map: a run folder (or the ``map`` in it) whose map this run goes on from and extends.
        map_images: keep the keyframes' images in ``map/``.
        checkpoint_s: seconds from one checkpoint to the next, see :func:`slamdepth.resume`; 0 writes none.
            Default: 15.
        reading: how the sequence is opened, such as the topic of a bag.
        export: formats to export the result to, into ``export/`` of the run folder; see :func:`export_run`.
        progress: called after each frame and at the start of each stage.
        stop: set it, from any thread or a signal handler, to finish early with the frames tracked so far.
        watcher: its ``saw(frame, result, tracker)`` is called after each frame, and must return at once.

    Returns:
        The folder, the figures of the report, and the reconstruction.

    Raises:
        InputError: the sequence, the camera, a setting or the output folder is wrong.
        WeightsError: weights are missing or damaged.
        TrackingError: no frame could be placed.
        RunInterrupted: ``stop`` was set before the first frame.
    """
    options = RunOptions(
        Path(sequence),
        None if output is None else Path(output),
        None if camera is None else Path(camera),
        max_frames,
        stride,
        mesh,
        overwrite,
        None if start_map is None else Path(start_map),
        map_images,
        CHECKPOINT_S if checkpoint_s is None else checkpoint_s,
        reading or ReadOptions(),
        tuple(export),
        view_deg,
    )
    return run_job(options, _settings(config, depth), progress, stop, watcher=watcher)


def run_job(
    options: RunOptions,
    config: Config,
    progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
    begun: Begun | None = None,
    watcher: Watcher | None = None,
) -> RunResult:
    """Do a run from its start, or from where an earlier process left it.

    Args:
        progress, stop, watcher: see :func:`run`.
        begun: what that process left in the run folder ``options.output``.
    """
    tell = progress or (lambda state: None)
    stopped = stop or threading.Event()
    with run_log() as log:
        job = _prepare(options, config, tell, stopped, begun)
        with job.tracker:
            tracked = _track(job, log, tell, stopped, watcher)
        result = _finish(job, tracked, tell)
        checkpoint.remove(result.folder)
        return result


@dataclass(frozen=True)
class Begun:
    """A run that was killed.

    Attributes:
        sequence: what is known of its sequence.
        latest: its latest checkpoint; None where there is none.
    """

    sequence: dict[str, Any]
    latest: Latest | None


@dataclass(frozen=True)
class _Job:
    """A run whose input is checked; nothing is written yet.

    Attributes:
        indices: which frames of the dataset are tracked.
        about: what tells the sequence from others, see :func:`describe`; None of a live source.
        latest: the checkpoint that the run goes on from.
        camera: how the camera was found.
        model: the depth model as the tracker gets it, scaled where that was asked for.
    """

    options: RunOptions
    config: Config
    dataset: Dataset
    about: dict[str, Any] | None
    indices: range
    folder: RunFolder
    camera: OpeningCamera
    model: DepthModel
    scale: PredictionScale
    tracker: AnyTracker
    start_map: Map | None = None
    latest: Latest | None = None

    @property
    def depth_is_measured(self) -> bool:
        return is_sensor(self.model)


def _settings(config: Config | str | Path | None, depth: str | None) -> Config:
    """``config``, read where it is a file, with the depth model named ``depth``."""
    if not isinstance(config, Config):
        config = Config() if config is None else Config.from_yaml(config)
    if depth is None or depth == config.depth.name:
        return config
    return Config.from_dict(merge(config.model_dump(), {"depth": {"name": depth}}))


def _prepare(
    options: RunOptions,
    config: Config,
    tell: ProgressCallback,
    stop: threading.Event,
    begun: Begun | None,
) -> _Job:
    """Open and check everything that a run needs, what costs least first."""
    from slamdepth.tracking import create_tracker

    check_exports(options.exports)
    config = with_chosen_model(config)
    start_map = None if options.start_map is None else Map.load(options.start_map)
    dataset = open_dataset(options.sequence, options.camera_file, options.reading)
    if options.view_deg is not None:
        use_view(dataset, options.view_deg)
    indices = options.indices_of(dataset)
    if dataset.imu_path is not None and config.scale.imu is None:
        dataset.notes.append(f"inertial data is there, for scale and gravity: --imu {dataset.imu_path}")
    about = None if dataset.is_live else describe(dataset)
    check_scale_options(dataset, config, indices)
    if begun is not None and about != begun.sequence:
        raise DatasetError(
            f"{dataset.path}: is not the sequence that the run was tracking; name that one, or start the run "
            "again with --overwrite"
        )
    is_new = begun is None
    folder = RunFolder.plan(options.output, dataset.name, overwrite=options.overwrite or not is_new)
    seed_everything(config.seed)
    given = configured_model(config)
    if is_sensor(given):
        if not dataset.has_depth:
            raise DatasetError(
                f"{dataset.path}: {lack_of_depth(dataset)}; run it with predicted depth: --depth dinov2"
            )
        dataset.notes += check_sensor_depth(dataset, indices)
    camera = settle_camera(dataset, indices, given, config, tell, stop)
    if camera.prior is not None:
        seed_everything(config.seed)
    scale = choose_prediction_scale(
        dataset,
        given,
        config,
        indices,
        progress=lambda done, total: tell(RunProgress(RunStage.SCALING, done, total)),
        stop=stop,
    )
    model = scale.applied_to(given)
    seed_torch(config.seed)
    tracker = create_tracker(dataset.camera, depth_model=model, config=config, start_map=start_map)
    latest = None if begun is None else begun.latest
    if latest is not None and isinstance(tracker, Tracker):
        stored = SequenceKeyframes(dataset, folder.path, latest, with_depth=is_sensor(model))
        tracker.restore(latest.tracker, stored.read_frame, stored.read_prediction)
    return _Job(
        options, config, dataset, about, indices, folder, camera, model, scale, tracker, start_map, latest
    )


def describe(dataset: Dataset) -> dict[str, Any]:
    """What tells two sequences apart, as far as it is known without reading their images."""
    times_s = dataset.timestamps_s
    return {
        "frames": len(dataset),
        "first_s": float(times_s[0]),
        "last_s": float(times_s[-1]),
        "size": [dataset.camera.width, dataset.camera.height],
        "K": dataset.camera.K.ravel().tolist(),
    }


def _track(
    job: _Job, log: MemoryHandler, tell: ProgressCallback, stop: threading.Event, watcher: Watcher | None
) -> Tracked:
    """Make the run folder and feed the tracker; bad images leave no folder behind."""
    config, dataset, folder = job.config, job.dataset, job.folder
    latest = job.latest
    if latest is None:
        folder.create(_arguments(job.options))
        if job.about is not None:
            begin(folder.path, begun_run(job.options, config, job.about))
    # what a live source gave cannot be read again
    checkpoints = Checkpoints(folder.path, 0.0 if dataset.is_live else job.options.checkpoint_s)
    try:
        write_log_to(log, folder / "log.txt", goes_on=latest is not None)
        if latest is not None:
            checkpoints.go_on_from(latest)
            logger.info("going on from the checkpoint after %d frames", latest.progress.done)
        write_text(folder / "config.yaml", _settings_text(job.options, config))
        if job.scale.fit is not None:
            write_scale(folder / "depth_scale.yaml", job.scale.fit)
        logger.info(
            "%s: %s, depth by %s, %s features",
            dataset.path,
            "a live source" if dataset.is_live else f"{len(job.indices)} of {len(dataset)} frames",
            job.model.name,
            config.features.name if config.odometry == "orb" else "no",
        )
        return track(
            dataset,
            job.indices,
            job.tracker,
            folder / "trajectory_online.txt",
            with_depth=job.depth_is_measured,
            progress=tell,
            stop=stop,
            checkpoints=checkpoints,
            before=None if latest is None else latest.progress,
            watcher=watcher,
        )
    except SlamdepthError as error:
        # of a full disk, say, what is there is worth keeping, and so is what a killed run left
        if not isinstance(error, OutputError) and latest is None:
            folder.discard()
        raise
    except BaseException:
        logger.debug("the run broke off", exc_info=True)
        raise
    finally:
        checkpoints.close()


def begun_run(options: RunOptions, config: Config, about: dict[str, Any]) -> dict[str, Any]:
    """What it takes to do a run again."""
    asked = asdict(options)
    paths = ("sequence", "camera_file", "start_map")
    return {
        "options": {
            **{name: value for name, value in asked.items() if name not in (*paths, "output", "overwrite")},
            **{name: None if asked[name] is None else str(Path(asked[name]).absolute()) for name in paths},
        },
        "config": config.model_dump(mode="json"),
        "sequence": about,
    }


def _finish(job: _Job, tracked: Tracked, tell: ProgressCallback) -> RunResult:
    """Everything after tracking; the trajectory first, since it is what was asked for."""
    config, dataset, folder, scale = job.config, job.dataset, job.folder, job.scale
    reconstruction, scale_facts, scale_notes = settle_scale(
        dataset, tracked.reconstruction, scale, config, tell
    )
    camera = check_camera(dataset, job.camera, job.tracker)
    others, other_notes = settle_others(dataset, tracked.reconstruction, scale, config)
    reconstruction = replace(reconstruction, others=tuple(one.reconstruction for one in others))
    maps = (reconstruction, *reconstruction.others)
    write_trajectories(folder, maps)
    scale_facts = inherited_scale(scale_facts, job.tracker, 0, job.start_map)
    write_maps(
        folder,
        job.tracker,
        Session(dataset.name, job.model.name),
        (tracked.reconstruction, *tracked.reconstruction.others),
        maps,
        (scale_facts, *(one.scale for one in others)),
        with_images=job.options.map_images,
    )
    notes = [*dataset.notes, *tracked.notes, *scale_notes, *other_notes]
    notes += start_map_notes(job.tracker, job.start_map)
    mesh: Mesh | None = None
    mesh_images: tuple[MeshImage, ...] = ()
    if job.options.mesh:
        reconstruction = measure_depth(dataset, reconstruction, config, tell)
        mesh, mesh_images, mesh_notes = write_mesh(folder, 1, reconstruction, config, tell)
        notes += mesh_notes
    is_measured = job.depth_is_measured
    others, other_meshes, other_notes = finish_others(
        dataset,
        others,
        config,
        folder,
        tell,
        mesh=job.options.mesh,
        is_measured=is_measured,
    )
    notes += other_notes

    notes += export_results(
        folder,
        dataset,
        (reconstruction, *(one.reconstruction for one in others)),
        (scale_facts.sentence, *(one.scale.sentence for one in others)),
        job.options.exports,
        tell,
    )

    tell(RunProgress(RunStage.SCORING))
    trajectory_score, score_notes = judge_trajectory(
        dataset, reconstruction.trajectory, is_measured=is_measured
    )
    depth_score, depth_notes = score_depth(dataset, reconstruction.keyframes)
    surface_scores, errors_m, surface_notes = score_mesh(
        dataset,
        job.indices[: len(tracked.steps) + tracked.skipped],
        mesh,
        reconstruction.trajectory,
        lambda done, total: tell(RunProgress(RunStage.COMPARING, done, total)),
        is_measured=is_measured,
    )
    if mesh is not None and errors_m is not None:
        mesh_images += render_errors(mesh, errors_m, reconstruction)
    optional = (
        ("mesh.ply", mesh),
        ("cloud.ply", (folder / "cloud.ply").is_file()),
        ("mesh.png", mesh_images),
        ("depth_scale.yaml", scale.fit),
    )
    absent = {name for name, is_there in optional if not is_there}
    files = {name: what for name, what in FILES.items() if name not in absent}
    if (folder / MAP).is_dir():
        files[f"{MAP}/"] = MAP_CONTENT
    files |= {MAPS: MAPS_CONTENT} if others else {}
    files |= {EXPORTS: EXPORTS_CONTENT} if (folder / EXPORTS).is_dir() else {}
    tell(RunProgress(RunStage.REPORTING))
    scene = scene_of(
        replace(reconstruction, others=tuple(one.reconstruction for one in others)),
        (mesh, *other_meshes),
        (trajectory_score, *(one.trajectory_score for one in others)),
    )
    write_scene(folder / SCENE_FILE, scene)
    summary = write_report(
        folder.path,
        ReportData(
            sequence=dataset.name,
            depth_model=job.model.name,
            depth_is_measured=is_measured,
            reconstruction=reconstruction,
            fps=tracked.fps,
            config=config,
            scale=scale_facts,
            health=judge_health(
                reconstruction,
                tracked.steps,
                config,
                scale_facts,
                is_measured=is_measured,
                camera_is_guessed=camera.is_a_guess,
            ),
            camera=camera,
            weights=(*job.model.weights, *feature_weights(config.features)),
            steps=tracked.steps,
            trajectory_score=trajectory_score,
            depth_score=depth_score,
            mesh=MeshCounts.of(mesh),
            surface_scores=surface_scores,
            others=others,
            mesh_images=mesh_images,
            scene=scene,
            skipped_frames=tracked.skipped,
            readable_frames=len(dataset),
            promised_frames=getattr(dataset, "frames_promised", len(dataset)),
            notes=(*notes, *score_notes, *depth_notes, *surface_notes),
            options=_reported_options(job.options, tracked),
            files=files,
        ),
    )
    logger.info("done: %s", folder.path)
    return RunResult(folder.path, summary, reconstruction, tracked.interrupted)


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and OpenCV, which libraries draw from."""
    import cv2

    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - for libraries that still use it
    cv2.setRNGSeed(seed % 2**31)


def seed_torch(seed: int) -> None:
    """Seed torch where a depth model has loaded it; loading it here would take seconds."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)


def _reported_options(options: RunOptions, tracked: Tracked) -> dict[str, object]:
    """The options without paths: a report is passed on, folders of a machine are not."""
    asked = asdict(options)
    for name in ("sequence", "output", "overwrite", "camera_file", "start_map", "checkpoint_s"):
        asked.pop(name)
    usual = asdict(ReadOptions())
    reading = {name: value for name, value in asked.pop("reading").items() if value != usual[name]}
    asked |= {"reading": reading} if reading else {}
    return {
        **asked,
        "camera_file": options.camera_file is not None,
        "start_map": options.start_map is not None,
        "interrupted": tracked.interrupted,
    }


def _arguments(options: RunOptions) -> list[str]:
    """What the command line was given, without the settings and the run folder."""
    arguments = [without_secret(str(options.sequence))]
    if options.camera_file is not None:
        arguments += ["--camera", str(options.camera_file)]
    if options.view_deg is not None:
        arguments += ["--fov", f"{options.view_deg:g}"]
    if options.max_frames is not None:
        arguments += ["--max-frames", str(options.max_frames)]
    if options.stride != 1:
        arguments += ["--stride", str(options.stride)]
    if options.exports:
        arguments += ["--export", ",".join(options.exports)]
    if options.start_map is not None:
        arguments += ["--map", str(options.start_map)]
    if options.map_images:
        arguments.append("--map-images")
    arguments += options.reading.arguments()
    return arguments if options.mesh else [*arguments, "--no-mesh"]


def _settings_text(options: RunOptions, config: Config) -> str:
    camera = "none" if options.camera_file is None else Path(options.camera_file).name
    lines = [
        "# The settings of this run; 'slamdepth run SEQ --config' reads them back. These are not read back:",
        f"# sequence: {Path(without_secret(str(options.sequence))).name}, --camera: {camera}",
        f"# stride: {options.stride}, max frames: {options.max_frames}, mesh: {options.mesh}",
        "# For the same run again, give them again; README.txt has the command.",
    ]
    return "\n".join(lines) + "\n" + config.to_yaml()
