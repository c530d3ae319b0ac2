# SPDX-License-Identifier: Apache-2.0
"""Feeding a tracker: frames in, results and the growing trajectory out."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from slamdepth.datasets import Dataset
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import TrajectoryWriter
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.checkpoint import Checkpoints, Progress
from slamdepth.pipeline.options import ProgressCallback, RunInterrupted, RunProgress, RunStage
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.tracking import Tracker
from slamdepth.tracking.snapshot import Watched
from slamdepth.types import Frame, StepResult

logger = logging.getLogger(__name__)

_ENDLESS = 10**12
"""More frames than any recording has."""
_FEWEST_JUDGED = 40
_WARNINGS = 5  # images named one by one before only their number is logged


class AnyTracker(Watched, Protocol):
    """What the pipeline needs of a tracker."""

    def prepare(self, frame: Frame) -> Any: ...

    def step(self, frame: Frame, prepared: Any = None) -> StepResult: ...

    def finish(self) -> Reconstruction: ...

    def __enter__(self) -> Any: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Watcher(Protocol):
    """Whoever watches a run, such as a viewer; must return at once."""

    def saw(self, frame: Frame, result: StepResult, tracker: Watched) -> None:
        """Called after each frame, in the thread of the tracker."""


@dataclass(frozen=True)
class Tracked:
    """A tracked sequence.

    Attributes:
        fps: frames over the wall time from the first step to the end of the optimisation.
        skipped: images that did not decode or are missing.
        steps: one result for each frame, in order.
        interrupted: True where it was stopped before the last frame.
        notes: for the report, one line each.
    """

    reconstruction: Reconstruction
    steps: tuple[StepResult, ...]
    fps: float
    skipped: int
    interrupted: bool
    notes: tuple[str, ...]


def track(
    dataset: Dataset,
    indices: Sequence[int],
    tracker: AnyTracker,
    online_path: Path,
    *,
    with_depth: bool,
    progress: ProgressCallback,
    stop: threading.Event,
    checkpoints: Checkpoints | None = None,
    before: Progress | None = None,
    watcher: Watcher | None = None,
) -> Tracked:
    """Feed the frames to ``tracker`` until the last one or until ``stop`` is set, and finish it.

    Args:
        checkpoints: writes them.
        before: what was done before the run was killed; the tracker has its state.

    Raises:
        DatasetError: more than half of the images do not decode.
        CameraError: the size of an image is not the camera's.
        RunInterrupted: ``stop`` was set before the first frame.
        OutputError: ``online_path`` cannot be written.
    """
    before = before or Progress()
    left = indices[len(indices) if before.is_complete else before.done :]
    # what is read ahead of a live source would be late
    capacity = 1 if dataset.is_live else 8
    reader = FramePrefetcher(dataset, left, with_depth=with_depth, prepare=tracker.prepare, capacity=capacity)
    run = _Run(reader, 0 if len(indices) > _ENDLESS else len(indices), before)
    progress(RunProgress(RunStage.TRACKING, before.done, run.total))
    with reader, TrajectoryWriter(online_path) as writer:
        online = _Online(writer)
        for step in run.steps:
            online.add(step)
        for item in reader:
            if stop.is_set():
                break
            if isinstance(item, ImageDecodeError):
                run.skip(item, dataset)
                continue
            run.start()
            result = tracker.step(item.frame, item.prepared)
            run.steps.append(result)
            online.add(result)
            if watcher is not None:
                watcher.saw(item.frame, result, tracker)
            if checkpoints is not None and checkpoints.is_due and isinstance(tracker, Tracker):
                _checkpoint(tracker, checkpoints, run)
            progress(run.state(result))
    run.is_interrupted = stop.is_set() and (run.done < run.total or not run.total)
    run.source_notes = [reader.ended] if reader.ended else []
    run.source_notes += dataset.close() if dataset.is_live else []
    if not run.steps:
        if stop.is_set():
            raise RunInterrupted("interrupted before the first frame; nothing was saved")
        raise DatasetError(reader.ended or f"{dataset.path}: none of the {run.total} images decodes")
    progress(replace(run.state(run.steps[-1]), stage=RunStage.OPTIMISING))
    if checkpoints is not None and isinstance(tracker, Tracker):
        tracker.complete()
        _checkpoint(tracker, checkpoints, run, is_complete=True)
    return _finished(tracker, run)


class _Run:
    """The frames of a run so far.

    Attributes:
        total: frames there are; 0 of a live source, which has no length.
        is_interrupted: it was stopped before the last frame.
        source_notes: what the source says of itself at its end.
    """

    def __init__(self, reader: FramePrefetcher, total: int, before: Progress) -> None:
        self.reader = reader
        self.total = total
        self.is_interrupted = False
        self.source_notes: list[str] = []
        self.steps = list(before.steps)
        self.skipped = before.skipped
        self.start_s: float | None = time.perf_counter() - before.elapsed_s if before.steps else None
        reader.read_s, reader.broken_depth_images = before.read_s, before.broken_depth_images

    @property
    def done(self) -> int:
        return len(self.steps) + self.skipped

    def start(self) -> None:
        """The first frame is there."""
        if self.start_s is None:
            self.start_s = time.perf_counter()

    @property
    def elapsed_s(self) -> float:
        """Since the first frame."""
        return 0.0 if self.start_s is None else time.perf_counter() - self.start_s

    def skip(self, error: ImageDecodeError, dataset: Dataset) -> None:
        """Count an image that cannot be read; refuse the sequence where half of them cannot."""
        self.skipped += 1
        _warn(error, self.skipped)
        if 2 * self.skipped > (self.total or max(_FEWEST_JUDGED, self.done)):
            raise DatasetError(
                f"{dataset.path}: more than half of the images do not decode "
                f"({self.skipped} of the first {self.done}); the last: {error}"
            )

    def so_far(self, *, is_complete: bool) -> Progress:
        """For a checkpoint."""
        return Progress(
            tuple(self.steps),
            self.skipped,
            self.reader.broken_depth_images,
            self.reader.read_s,
            self.elapsed_s,
            is_complete,
        )

    def state(self, result: StepResult) -> RunProgress:
        """For the progress bar."""
        return RunProgress(
            RunStage.TRACKING,
            self.done,
            self.total,
            len(self.steps) / max(1e-9, self.elapsed_s),
            result.status,
            result.keyframes,
            result.loop_closures,
        )

    def notes(self) -> list[str]:
        """What a reader of the result should know."""
        notes: list[str] = []
        if self.is_interrupted:
            of_all = f"interrupted after {self.done} of {self.total} frames"
            notes.append(of_all if self.total else f"stopped after {self.done} frames")
        notes += self.source_notes
        if self.skipped:
            of = self.total or self.done
            notes.append(f"{self.skipped} of {of} images do not decode or are missing, and were skipped")
        if self.reader.broken_depth_images:
            notes.append(f"{self.reader.broken_depth_images} depth images do not decode and were left out")
        return notes


def _finished(tracker: AnyTracker, run: _Run) -> Tracked:
    """Finish the tracker."""
    finish_s = time.perf_counter()
    reconstruction = tracker.finish()
    statistics = reconstruction.statistics
    frames = len(run.steps)
    timings_ms = {
        **statistics.timings_ms,
        "finish": 1e3 * (time.perf_counter() - finish_s),
        "decode": 1e3 * run.reader.read_s / max(1, frames),
    }
    notes = run.notes()
    for note in notes:
        logger.warning("%s", note)
    return Tracked(
        replace(
            reconstruction,
            statistics=replace(
                statistics,
                timings_ms=timings_ms,
                timing_calls={**statistics.timing_calls, "finish": 1, "decode": frames},
            ),
        ),
        tuple(run.steps),
        frames / run.elapsed_s,
        run.skipped,
        run.is_interrupted,
        tuple(notes),
    )


class _Online:
    """The growing trajectory file."""

    def __init__(self, file: TrajectoryWriter) -> None:
        self._file = file
        self._map_id = 0

    def add(self, result: StepResult) -> None:
        """Append a frame's pose, if it has one."""
        if result.T_world_camera is None:
            return
        if result.map_id != self._map_id:
            self._map_id = result.map_id
            self._file.comment(
                f"from here on in the world frame of map {self._map_id + 1}, as maps were started"
            )
        self._file.append(result.timestamp_s, result.T_world_camera)


def _checkpoint(tracker: Tracker, checkpoints: Checkpoints, run: _Run, *, is_complete: bool = False) -> None:
    """Write a checkpoint, unless a keyframe is between two stages; then one of the next frames will."""
    if tracker.is_quiet:
        checkpoints.write(tracker, run.so_far(is_complete=is_complete))


def _warn(error: ImageDecodeError, count: int) -> None:
    level = logging.WARNING if count <= _WARNINGS else logging.DEBUG
    if count == _WARNINGS + 1:
        logger.warning("further images that cannot be read are only counted")
    logger.log(level, "image skipped: %s", error)
