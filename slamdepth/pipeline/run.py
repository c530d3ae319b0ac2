# SPDX-License-Identifier: Apache-2.0
"""The main job: one sequence in, one run folder out."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from logging.handlers import MemoryHandler
from pathlib import Path

from slamdepth.config import Config, merge
from slamdepth.datasets import ReadOptions
from slamdepth.depth.scale_file import write_scale
from slamdepth.errors import OutputError, SlamdepthError
from slamdepth.io import write_text
from slamdepth.pipeline import checkpoint
from slamdepth.pipeline.asked import arguments_of, begun_run, settings_text
from slamdepth.pipeline.checkpoint import Checkpoints, begin
from slamdepth.pipeline.conclude import conclude
from slamdepth.pipeline.folder import (
    run_log,
    write_log_to,
)
from slamdepth.pipeline.job import Begun, Job, prepare
from slamdepth.pipeline.options import (
    CHECKPOINT_S,
    ProgressCallback,
    RunOptions,
    RunResult,
)
from slamdepth.pipeline.tracking import Tracked, Watcher, track

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
        job = prepare(options, config, tell, stopped, begun)
        with job.tracker:
            tracked = _track(job, log, tell, stopped, watcher)
        result = conclude(job, tracked, tell)
        checkpoint.remove(result.folder)
        return result


def _settings(config: Config | str | Path | None, depth: str | None) -> Config:
    """``config``, read where it is a file, with the depth model named ``depth``."""
    if not isinstance(config, Config):
        config = Config() if config is None else Config.from_yaml(config)
    if depth is None or depth == config.depth.name:
        return config
    return Config.from_dict(merge(config.model_dump(), {"depth": {"name": depth}}))


def _track(
    job: Job, log: MemoryHandler, tell: ProgressCallback, stop: threading.Event, watcher: Watcher | None
) -> Tracked:
    """Make the run folder and feed the tracker; bad images leave no folder behind."""
    config, dataset, folder = job.config, job.dataset, job.folder
    latest = job.latest
    if latest is None:
        folder.create(arguments_of(job.options))
        if job.about is not None:
            begin(folder.path, begun_run(job.options, config, job.about))
    # what a live source gave cannot be read again
    checkpoints = Checkpoints(folder.path, 0.0 if dataset.is_live else job.options.checkpoint_s)
    try:
        write_log_to(log, folder / "log.txt", goes_on=latest is not None)
        if latest is not None:
            checkpoints.go_on_from(latest)
            logger.info("going on from the checkpoint after %d frames", latest.progress.done)
        write_text(folder / "config.yaml", settings_text(job.options, config))
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
