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
from slamdepth.pipeline.options import ProgressCallback, RunInterrupted, RunProgress, RunStage
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.types import Frame, StepResult

logger = logging.getLogger(__name__)

_WARNINGS = 5  # images named one by one before only their number is logged


class AnyTracker(Protocol):
    """What the pipeline needs of a tracker."""

    def prepare(self, frame: Frame) -> Any: ...

    def step(self, frame: Frame, prepared: Any = None) -> StepResult: ...

    def finish(self) -> Reconstruction: ...

    def __enter__(self) -> Any: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


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
) -> Tracked:
    """Feed the frames to ``tracker`` until the last one or until ``stop`` is set, and finish it.

    Raises:
        DatasetError: more than half of the images do not decode.
        CameraError: the size of an image is not the camera's.
        RunInterrupted: ``stop`` was set before the first frame.
        OutputError: ``online_path`` cannot be written.
    """
    steps: list[StepResult] = []
    skipped = 0
    map_id = 0
    start_s: float | None = None
    total = len(indices)
    reader = FramePrefetcher(dataset, indices, with_depth=with_depth, prepare=tracker.prepare)
    progress(RunProgress(RunStage.TRACKING, 0, total))
    with reader, TrajectoryWriter(online_path) as online:
        for item in reader:
            if stop.is_set():
                break
            if isinstance(item, ImageDecodeError):
                skipped += 1
                _warn(item, skipped)
                if 2 * skipped > total:
                    raise DatasetError(
                        f"{dataset.path}: more than half of the images do not decode "
                        f"({skipped} of the first {skipped + len(steps)}); the last: {item}"
                    )
                continue
            if start_s is None:
                start_s = time.perf_counter()
            result = tracker.step(item.frame, item.prepared)
            steps.append(result)
            if result.T_world_camera is not None:
                if result.map_id != map_id:
                    map_id = result.map_id
                    online.comment(
                        f"from here on in the world frame of map {map_id + 1}, as maps were started"
                    )
                online.append(result.timestamp_s, result.T_world_camera)
            progress(_state(result, len(steps) + skipped, total, len(steps), start_s))
    if start_s is None:
        if stop.is_set():
            raise RunInterrupted("interrupted before the first frame; nothing was saved")
        raise DatasetError(f"{dataset.path}: none of the {total} images decodes")

    done = len(steps) + skipped
    state = _state(steps[-1], done, total, len(steps), start_s)
    progress(replace(state, stage=RunStage.OPTIMISING))
    finish_s = time.perf_counter()
    reconstruction = tracker.finish()
    statistics = reconstruction.statistics
    end_s = time.perf_counter()
    timings_ms = {
        **statistics.timings_ms,
        "finish": 1e3 * (end_s - finish_s),
        "decode": 1e3 * reader.read_s / max(1, len(steps)),
    }
    notes: list[str] = []
    if done < total:
        notes.append(f"interrupted after {done} of {total} frames")
    if skipped:
        notes.append(f"{skipped} of {total} images do not decode or are missing, and were skipped")
    if reader.broken_depth_images:
        notes.append(f"{reader.broken_depth_images} depth images do not decode and were left out")
    for note in notes:
        logger.warning("%s", note)
    return Tracked(
        replace(
            reconstruction,
            statistics=replace(
                statistics,
                timings_ms=timings_ms,
                timing_calls={**statistics.timing_calls, "finish": 1, "decode": len(steps)},
            ),
        ),
        tuple(steps),
        len(steps) / (end_s - start_s),
        skipped,
        done < total,
        tuple(notes),
    )


def _warn(error: ImageDecodeError, count: int) -> None:
    level = logging.WARNING if count <= _WARNINGS else logging.DEBUG
    if count == _WARNINGS + 1:
        logger.warning("further images that cannot be read are only counted")
    logger.log(level, "image skipped: %s", error)


def _state(result: StepResult, done: int, total: int, frames: int, start_s: float) -> RunProgress:
    return RunProgress(
        RunStage.TRACKING,
        done,
        total,
        frames / max(1e-9, time.perf_counter() - start_s),
        result.status,
        result.keyframes,
        result.loop_closures,
    )
