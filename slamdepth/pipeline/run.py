# SPDX-License-Identifier: Apache-2.0
"""The main job: one sequence in, one run folder out."""

from __future__ import annotations

import logging
import random
import sys
import threading
from dataclasses import asdict, dataclass, replace
from logging.handlers import MemoryHandler
from pathlib import Path

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
from slamdepth.pipeline.dense import measure_depth
from slamdepth.pipeline.folder import FILES, MAPS, MAPS_CONTENT, RunFolder, run_log, write_log_to
from slamdepth.pipeline.maps import finish_others, settle_others, write_mesh, write_trajectories
from slamdepth.pipeline.options import (
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
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.surface import score_mesh
from slamdepth.pipeline.tracking import AnyTracker, Tracked, track
from slamdepth.report import MeshCounts, MeshImage, ReportData, render_errors, write_report

logger = logging.getLogger(__name__)


def run(
    sequence: str | Path,
    output: str | Path | None = None,
    *,
    depth: str | None = None,
    camera: str | Path | None = None,
    config: Config | str | Path | None = None,
    max_frames: int | None = None,
    stride: int = 1,
    mesh: bool = True,
    overwrite: bool = False,
    reading: ReadOptions | None = None,
    progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
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
        camera: a ``camera.yaml`` with the intrinsics. Default: as the sequence says.
        config: every other setting, or a YAML file with settings. Default: ``Config()``.
        max_frames: stop after this many frames. Default: all.
        stride: take every Nth frame.
        mesh: fuse the keyframes and write ``mesh.ply`` and ``cloud.ply``.
        overwrite: an earlier run in ``output`` may be replaced.
        reading: how the sequence is opened, such as the topic of a bag.
        progress: called after each frame and at the start of each stage.
        stop: set it, from any thread or a signal handler, to finish early with the frames tracked so far.

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
        reading or ReadOptions(),
    )
    settings = _settings(config, depth)
    tell = progress or (lambda state: None)
    stopped = stop or threading.Event()
    with run_log() as log:
        job = _prepare(options, settings, tell, stopped)
        with job.tracker:
            tracked = _track(job, log, tell, stopped)
        return _finish(job, tracked, tell)


@dataclass(frozen=True)
class _Job:
    """A run whose input is checked; nothing is written yet.

    Attributes:
        indices: which frames of the dataset are tracked.
        model: the depth model as the tracker gets it, scaled where that was asked for.
    """

    options: RunOptions
    config: Config
    dataset: Dataset
    indices: range
    folder: RunFolder
    model: DepthModel
    scale: PredictionScale
    tracker: AnyTracker

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


def _prepare(options: RunOptions, config: Config, tell: ProgressCallback, stop: threading.Event) -> _Job:
    """Open and check everything that a run needs, what costs least first."""
    from slamdepth.tracking import create_tracker

    config = with_chosen_model(config)
    dataset = open_dataset(options.sequence, options.camera_file, options.reading)
    indices = options.indices_of(dataset)
    if dataset.imu_path is not None and config.scale.imu is None:
        dataset.notes.append(f"inertial data is there, for scale and gravity: --imu {dataset.imu_path}")
    check_scale_options(dataset, config, indices)
    folder = RunFolder.plan(options.output, dataset.name, overwrite=options.overwrite)
    seed_everything(config.seed)
    given = configured_model(config)
    if is_sensor(given):
        if not dataset.has_depth:
            raise DatasetError(
                f"{dataset.path}: {lack_of_depth(dataset)}; run it with predicted depth: --depth dinov2"
            )
        dataset.notes += check_sensor_depth(dataset, indices)
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
    tracker = create_tracker(dataset.camera, depth_model=model, config=config)
    return _Job(options, config, dataset, indices, folder, model, scale, tracker)


def _track(job: _Job, log: MemoryHandler, tell: ProgressCallback, stop: threading.Event) -> Tracked:
    """Make the run folder and feed the tracker; bad images leave no folder behind."""
    config, dataset, folder = job.config, job.dataset, job.folder
    folder.create(_arguments(job.options))
    try:
        write_log_to(log, folder / "log.txt")
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
        )
    except SlamdepthError as error:
        if not isinstance(error, OutputError):  # of a full disk, say, what is there is worth keeping
            folder.discard()
        raise
    except BaseException:
        logger.debug("the run broke off", exc_info=True)
        raise


def _finish(job: _Job, tracked: Tracked, tell: ProgressCallback) -> RunResult:
    """Everything after tracking; the trajectory first, since it is what was asked for."""
    config, dataset, folder, scale = job.config, job.dataset, job.folder, job.scale
    reconstruction, scale_facts, scale_notes = settle_scale(
        dataset, tracked.reconstruction, scale, config, tell
    )
    others, other_notes = settle_others(dataset, tracked.reconstruction, scale, config)
    reconstruction = replace(reconstruction, others=tuple(one.reconstruction for one in others))
    write_trajectories(folder, (reconstruction, *reconstruction.others))
    notes = [*dataset.notes, *tracked.notes, *scale_notes, *other_notes]
    mesh: Mesh | None = None
    mesh_images: tuple[MeshImage, ...] = ()
    if job.options.mesh:
        reconstruction = measure_depth(dataset, reconstruction, config, tell)
        mesh, mesh_images, mesh_notes = write_mesh(folder, 1, reconstruction, config, tell)
        notes += mesh_notes
    is_measured = job.depth_is_measured
    others, other_notes = finish_others(
        dataset,
        others,
        config,
        folder,
        tell,
        mesh=job.options.mesh,
        is_measured=is_measured,
    )
    notes += other_notes

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
    tell(RunProgress(RunStage.REPORTING))
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
            health=judge_health(reconstruction, tracked.steps, config, scale_facts, is_measured=is_measured),
            weights=(*job.model.weights, *feature_weights(config.features)),
            steps=tracked.steps,
            trajectory_score=trajectory_score,
            depth_score=depth_score,
            mesh=MeshCounts.of(mesh),
            surface_scores=surface_scores,
            others=others,
            mesh_images=mesh_images,
            skipped_frames=tracked.skipped,
            readable_frames=len(dataset),
            promised_frames=getattr(dataset, "frames_promised", len(dataset)),
            notes=(*notes, *score_notes, *depth_notes, *surface_notes),
            options=_reported_options(job.options, tracked),
            files={**files, MAPS: MAPS_CONTENT} if others else files,
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
    for name in ("sequence", "output", "overwrite", "camera_file"):
        asked.pop(name)
    usual = asdict(ReadOptions())
    reading = {name: value for name, value in asked.pop("reading").items() if value != usual[name]}
    asked |= {"reading": reading} if reading else {}
    return {**asked, "camera_file": options.camera_file is not None, "interrupted": tracked.interrupted}


def _arguments(options: RunOptions) -> list[str]:
    """What the command line was given, without the settings and the run folder."""
    arguments = [without_secret(str(options.sequence))]
    if options.camera_file is not None:
        arguments += ["--camera", str(options.camera_file)]
    if options.max_frames is not None:
        arguments += ["--max-frames", str(options.max_frames)]
    if options.stride != 1:
        arguments += ["--stride", str(options.stride)]
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
