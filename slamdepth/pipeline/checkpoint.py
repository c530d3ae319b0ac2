# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a run: after ``kill -9`` it goes on from the last one.

The tracker is saved when nothing is under way in it, so what goes on from there is what would have gone on.
The state is copied between two frames, and written to disk by another thread. Images of keyframes are read
again from the sequence; predicted depth is kept as keyframes keep it, in half precision.
"""

from __future__ import annotations

import json
import logging
import mmap
import os
import shutil
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth._version import __version__
from slamdepth.datasets import Dataset
from slamdepth.datasets.base import read_sound
from slamdepth.errors import DatasetError, OutputError
from slamdepth.io import write_json
from slamdepth.io.tensors import decode_tensors, encode_tensors, read_checked, write_bytes
from slamdepth.io.tree import Tree, flattened, restored
from slamdepth.mapping.codec import decode_half_precision, encode_half_precision
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.pipeline.steps import steps_of, steps_state
from slamdepth.tracking import Tracker
from slamdepth.types import DepthKind, DepthPrediction, Frame, StepResult

logger = logging.getLogger(__name__)

FOLDER = "checkpoint"
VERSION = 3
_RUN, _LATEST, _DEPTH, _STATE = "run.json", "latest.json", "depth.bin", "state-{}.safetensors"
_SHARE = 0.02  # of the time that may be spent on checkpoints


@dataclass(frozen=True)
class Progress:
    """How far a run was.

    Attributes:
        steps: results of the frames so far.
        skipped: images that did not decode.
        broken_depth_images: depth images that did not.
        read_s, elapsed_s: seconds spent on reading and since the first frame.
        is_complete: no frame is to follow: the run was finishing.
    """

    steps: tuple[StepResult, ...] = ()
    skipped: int = 0
    broken_depth_images: int = 0
    read_s: float = 0.0
    elapsed_s: float = 0.0
    is_complete: bool = False

    @property
    def done(self) -> int:
        """Frames that need not be read again."""
        return len(self.steps) + self.skipped


class Checkpoints:
    """Writes checkpoints of a tracker into a run folder.

    A checkpoint is due ``every_s`` seconds after the last one, and at most two per cent of the time is spent
    on them. Where the disk takes no more, the run goes on without.

    Args:
        run_folder: of the run.
        every_s: 0 writes none.
    """

    def __init__(self, run_folder: Path, every_s: float) -> None:
        self._folder = run_folder / FOLDER
        self._every_s = every_s
        self._is_on = every_s > 0
        self._next_s = time.monotonic() + every_s
        self._number = 0
        self._depths: dict[int, tuple[int, int, int]] = {}
        self._depth_bytes = 0
        self._pool = ThreadPoolExecutor(1, "slamdepth-checkpoint")
        self._writing: Future[None] | None = None
        self._spent_s = 0.0

    def go_on_from(self, latest: Latest) -> None:
        """Continue the numbers and the depth file of an earlier process."""
        self._number = latest.number
        self._depths = dict(latest.depths)
        self._depth_bytes = latest.depth_bytes
        with (self._folder / _DEPTH).open("ab") as file:
            file.truncate(latest.depth_bytes)

    @property
    def is_due(self) -> bool:
        """Whether it is time for the next one."""
        if not self._is_on or time.monotonic() < self._next_s:
            return False
        return self._writing is None or self._writing.done()

    def write(self, tracker: Tracker, now: Progress) -> None:
        """Write a checkpoint of a quiet tracker, while the run goes on.

        Args:
            now: how far the run is.
        """
        if not self._is_on:
            return
        start_s = time.monotonic()
        self._finish_writing()
        state = tracker.state()
        new = [
            (frame.index, stored)
            for frame, stored in tracker.keyframes
            if stored is not None and not stored.is_sensor and frame.index not in self._depths
        ]
        tree = {
            "tracker": state,
            "steps": steps_state(now.steps),
            "progress": [
                now.skipped,
                now.broken_depth_images,
                now.read_s,
                now.elapsed_s,
                now.is_complete,
            ],
        }
        plain, arrays = flattened(tree)
        data = encode_tensors(arrays, {"tree": plain})
        self._writing = self._pool.submit(self._write, data, new, now.done)
        spent_s = time.monotonic() - start_s
        self._spent_s += spent_s
        logger.debug(
            "checkpoint after %d frames: %.0f ms, %.1f MB; %.1f s in all",
            now.done,
            1e3 * spent_s,
            1e-6 * len(data),
            self._spent_s,
        )
        self._next_s = time.monotonic() + max(self._every_s, spent_s / _SHARE)

    def _finish_writing(self) -> None:
        """Wait for the thread; where it failed, no more checkpoints are written."""
        writing, self._writing = self._writing, None
        if writing is None:
            return
        try:
            writing.result()
        except (OSError, OutputError) as error:
            self._is_on = False
            logger.warning("no more checkpoints are written, the run goes on: %s", error)

    def _write(self, data: bytes, new: list[tuple[int, StoredPrediction]], done: int) -> None:
        with (self._folder / _DEPTH).open("ab") as file:
            for index, stored in new:
                prediction = stored.load()
                parts = [encode_half_precision(prediction.values).data]
                if prediction.sigma_log is not None:
                    parts.append(encode_half_precision(prediction.sigma_log).data)
                lengths = [len(part) for part in parts] + [0] * (2 - len(parts))
                file.write(b"".join(parts))
                self._depths[index] = self._depth_bytes, lengths[0], lengths[1]
                self._depth_bytes += sum(lengths)
            file.flush()
            os.fsync(file.fileno())
        number = self._number + 1
        name = _STATE.format(number)
        sha256 = write_bytes(self._folder / name, data)
        write_json(
            self._folder / _LATEST,
            {
                "version": VERSION,
                "slamdepth": __version__,
                "number": number,
                "frames": done,
                "state": name,
                "sha256": sha256,
                "depth_bytes": self._depth_bytes,
                "depths": [[index, *place] for index, place in self._depths.items()],
            },
        )
        with suppress(OSError):
            (self._folder / _STATE.format(self._number)).unlink(missing_ok=True)
        self._number = number

    def close(self) -> None:
        """Wait for the thread and end it; checkpoints stay."""
        self._finish_writing()
        self._pool.shutdown(wait=True)


@dataclass(frozen=True)
class Latest:
    """The latest checkpoint of a run, read.

    Attributes:
        tracker: state of the tracker.
        progress: how far the run was.
        number: of the checkpoint.
        depths: place of each keyframe's depth in the file: first byte, bytes of values, bytes of deviations.
        depth_bytes: size of that file.
    """

    tracker: Tree
    progress: Progress
    number: int
    depths: dict[int, tuple[int, int, int]]
    depth_bytes: int


def read_latest(run_folder: Path) -> Latest | None:
    """The latest checkpoint of a run; None where it was killed before the first one.

    Raises:
        DatasetError: it is damaged or of another version; names the file.
    """
    folder = run_folder / FOLDER
    path = folder / _LATEST
    if not path.is_file():
        return None
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["version"] != VERSION:
            raise DatasetError(
                f"{path}: has version {about['version']}, and this slamdepth goes on from version {VERSION}; "
                "start the run again with --overwrite"
            )
        data = read_checked(folder / about["state"], about["sha256"])
        arrays, header = decode_tensors(data)
        tree = restored(header["tree"], arrays)
        progress = Progress(steps_of(tree["steps"]), *tree["progress"])
        depths = {index: (first, values, sigmas) for index, first, values, sigmas in about["depths"]}
        return Latest(tree["tracker"], progress, about["number"], depths, about["depth_bytes"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path}: is damaged: {error}; start the run again with --overwrite") from error


class SequenceKeyframes:
    """Images of keyframes from the sequence, and their predictions from the checkpoint.

    Args:
        dataset: the sequence.
        with_depth: the keyframes' depth is its sensor's.
        run_folder: of the run.
        latest: its checkpoint.
    """

    def __init__(self, dataset: Dataset, run_folder: Path, latest: Latest, *, with_depth: bool) -> None:
        self._dataset = dataset
        self._with_depth = with_depth
        path = run_folder / FOLDER / _DEPTH
        size = latest.depth_bytes
        if (path.stat().st_size if path.is_file() else 0) < size:
            raise DatasetError(f"{path}: is damaged: it is shorter than the checkpoint says")
        self._bytes: bytes | mmap.mmap = b""
        if size > 0:  # as much as all the maps that a run keeps out of memory
            with path.open("rb") as file:
                self._bytes = mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ)
        self._latest = latest

    def read_frame(self, index: int) -> Frame:
        """A frame of the sequence."""
        return read_sound(self._dataset, index, with_depth=self._with_depth)[0]

    def read_prediction(self, frame: StoredFrame) -> DepthPrediction:
        """The depth that was predicted for a keyframe."""
        from slamdepth.depth.sensor import SensorDepth

        place = self._latest.depths.get(frame.index)
        if place is None:
            values = SensorDepth().predict(frame.load()).values
            return DepthPrediction(values, DepthKind.METRIC, is_sensor=True)
        first, values_bytes, sigma_bytes = place
        middle = first + values_bytes
        sigma: NDArray[Any] | None = None
        if sigma_bytes:
            sigma = decode_half_precision(self._bytes[middle : middle + sigma_bytes], np.dtype(np.float16))
        values = decode_half_precision(self._bytes[first:middle], np.dtype(np.float32))
        return DepthPrediction(values, DepthKind.METRIC, sigma)


def begin(run_folder: Path, about: Tree) -> None:
    """Make the folder of checkpoints, and write down what the run was asked for.

    Raises:
        OutputError: it cannot be written.
    """
    folder = run_folder / FOLDER
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    write_json(folder / _RUN, {"version": VERSION, **about})


def read_begun(run_folder: Path) -> Tree | None:
    """What :func:`begin` wrote; None where the run is finished, or is none.

    Raises:
        DatasetError: it is damaged or of another version.
    """
    path = run_folder / FOLDER / _RUN
    if not path.is_file():
        return None
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["version"] != VERSION:
            raise DatasetError(f"{path}: has version {about['version']}, and this slamdepth knows {VERSION}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path}: is damaged: {error}") from error
    return dict(about)


def remove(run_folder: Path) -> None:
    """Remove the checkpoints of a run; a link is left alone."""
    folder = run_folder / FOLDER
    if (folder / _RUN).is_file() and not folder.is_symlink():
        shutil.rmtree(folder, ignore_errors=True)
