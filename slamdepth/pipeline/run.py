# SPDX-License-Identifier: Apache-2.0
"""The main job: one sequence in, one run folder out."""

from __future__ import annotations

import logging
import random
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.registry import create_depth_model
from slamdepth.depth.scale_file import write_scale
from slamdepth.errors import DatasetError, OutputError, SlamdepthError
from slamdepth.frontend.features import feature_weights
from slamdepth.io import write_text, write_tum_trajectory
from slamdepth.pipeline.folder import FILES, RunFolder, run_log, write_log_to
from slamdepth.pipeline.options import (
    ProgressCallback,
    RunOptions,
    RunProgress,
    RunResult,
    Stage,
)
from slamdepth.pipeline.prediction_scale import (
    PredictionScale,
    check_scale_options,
    choose_prediction_scale,
)
from slamdepth.pipeline.results import (
    judge_trajectory,
    keyframe_trajectory,
    score_depth,
    write_keyframe_mesh,
)
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.tracking import Tracked, track
from slamdepth.report import MeshCounts, MeshImage, ReportData, write_mesh_png, write_report

logger = logging.getLogger(__name__)


def run(
    options: RunOptions,
    config: Config,
    *,
    progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
) -> RunResult:
    """Track a sequence, mesh it, score it, and write everything into a run folder.

    Bad input leaves no folder behind. The random generators of Python, NumPy, OpenCV and,
    where it is used, torch are seeded from ``config.seed``.

    Args:
        options: which sequence, where to.
        config: every setting.
        progress: called after each frame and at each new stage.
        stop: set it, from any thread or a signal handler, to finish early with the frames
            tracked so far.

    Raises:
        InputError: the sequence, the camera, a setting or the output place is wrong.
        WeightsError: weights are missing or damaged.
        TrackingError: no frame could be placed.
        RunInterrupted: ``stop`` was set before the first frame.
    """
    tell = progress or (lambda state: None)
    stopped = stop or threading.Event()
    with run_log() as log:
        dataset = open_dataset(options.sequence, options.camera_file)
        wants_sensor = config.depth.name == "sensor"
        if wants_sensor and not dataset.has_depth:
            raise DatasetError(
                f"{dataset.path}: has no sensor depth (no depth images); run it with predicted depth: "
                "--depth dinov2"
            )
        indices = options.indices(len(dataset))
        check_scale_options(dataset, config, indices)
        folder = RunFolder.plan(options.output, dataset.name, overwrite=options.overwrite)
        seed_everything(config.seed)
        given = create_depth_model(
            config.depth.name, device=config.device, seed=config.seed, weights=config.depth.weights
        )
        scale = choose_prediction_scale(
            dataset,
            given,
            config,
            indices,
            progress=lambda done, total: tell(RunProgress(Stage.SCALING, done, total)),
            stop=stopped,
        )
        model = scale.applied_to(given)
        seed_torch(config.seed)
        tracker = _make_tracker(dataset, model, config)

        folder.create(_arguments(options))
        try:
            write_log_to(log, folder / "log.txt")
            write_text(folder / "config.yaml", _settings_text(options, config))
            if scale.fit is not None:
                write_scale(folder / "depth_scale.yaml", scale.fit)
            logger.info(
                "%s: %d of %d frames, depth by %s, %s features",
                dataset.path,
                len(indices),
                len(dataset),
                model.name,
                config.features.name if config.odometry == "orb" else "no",
            )
            tracked = track(
                dataset,
                indices,
                tracker,
                folder / "trajectory_online.txt",
                with_depth=wants_sensor,
                progress=tell,
                stop=stopped,
            )
        except SlamdepthError as error:
            if not isinstance(error, OutputError):  # of a full disk, say, what is there is worth keeping
                folder.discard()
            raise
        except BaseException:
            logger.debug("the run broke off", exc_info=True)
            raise
        return _finish(dataset, model, scale, tracked, folder, options, config, tell)


def _make_tracker(dataset: Dataset, model: DepthModel, config: Config) -> Any:
    from slamdepth.tracking import create_tracker

    return create_tracker(dataset.camera, depth_model=model, config=config)


def _finish(
    dataset: Dataset,
    model: DepthModel,
    scale: PredictionScale,
    tracked: Tracked,
    folder: RunFolder,
    options: RunOptions,
    config: Config,
    tell: ProgressCallback,
) -> RunResult:
    """Everything after tracking; the trajectory first, since it is what was asked for."""
    reconstruction, scale_facts, scale_notes = settle_scale(dataset, tracked.reconstruction, scale, config)
    write_tum_trajectory(folder / "trajectory.txt", reconstruction.trajectory)
    write_tum_trajectory(folder / "keyframes.txt", keyframe_trajectory(reconstruction))
    notes = [*dataset.notes, *tracked.notes, *scale_notes]

    mesh: MeshCounts | None = None
    images: tuple[MeshImage, ...] = ()
    if options.mesh:
        tell(RunProgress(Stage.MESHING))
        try:
            mesh, images, mesh_notes = write_keyframe_mesh(reconstruction, config, folder / "mesh.ply", tell)
        except SlamdepthError as error:
            mesh_notes = (f"no mesh: {error}",)
        for note in mesh_notes:
            logger.warning("%s", note)
        notes += mesh_notes
    if images:
        write_mesh_png(folder / "mesh.png", images)

    optional = (("mesh.ply", mesh), ("mesh.png", images), ("depth_scale.yaml", scale.fit))
    absent = {name for name, is_there in optional if not is_there}
    tell(RunProgress(Stage.SCORING))
    trajectory_score, score_notes = judge_trajectory(
        dataset, reconstruction.trajectory, is_measured=config.depth.name == "sensor"
    )
    notes += score_notes
    summary = write_report(
        folder.path,
        ReportData(
            sequence=dataset.name,
            depth_model=model.name,
            depth_is_measured=is_sensor(model),
            reconstruction=reconstruction,
            fps=tracked.fps,
            config=config,
            scale=scale_facts,
            weights=(*model.weights, *feature_weights(config.features)),
            steps=tracked.steps,
            trajectory_score=trajectory_score,
            depth_score=score_depth(dataset, reconstruction.keyframes),
            mesh=mesh,
            mesh_images=images,
            skipped_frames=tracked.skipped,
            notes=tuple(notes),
            options=_reported_options(options, tracked),
            files={name: what for name, what in FILES.items() if name not in absent},
        ),
    )
    logger.info("done: %s", folder.path)
    return RunResult(folder.path, summary, tracked.interrupted)


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
    return {**asked, "camera_file": options.camera_file is not None, "interrupted": tracked.interrupted}


def _arguments(options: RunOptions) -> list[str]:
    """What the command line was given beside the settings and the place of the results."""
    arguments = [str(options.sequence)]
    if options.camera_file is not None:
        arguments += ["--camera", str(options.camera_file)]
    if options.max_frames is not None:
        arguments += ["--max-frames", str(options.max_frames)]
    if options.stride != 1:
        arguments += ["--stride", str(options.stride)]
    return arguments if options.mesh else [*arguments, "--no-mesh"]


def _settings_text(options: RunOptions, config: Config) -> str:
    camera = "none" if options.camera_file is None else Path(options.camera_file).name
    lines = [
        "# The settings of this run; 'slamdepth run SEQ --config' reads them back. These are not read back:",
        f"# sequence: {Path(options.sequence).name}, --camera: {camera}",
        f"# stride: {options.stride}, max frames: {options.max_frames}, mesh: {options.mesh}",
        "# For the same run again give them anew; README.txt has the command.",
    ]
    return "\n".join(lines) + "\n" + config.to_yaml()
