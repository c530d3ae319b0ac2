# SPDX-License-Identifier: Apache-2.0
"""Measure how memory and processor time grow with the length of a sequence, which is played forth and back.

    python -m benchmarks.memory --data DIR --sequence NAME --depth sensor --frames 5000

Prints one line per thousand frames: keyframes, processor time of each frame since the line before, memory of
the process, and bytes of the tracker's arrays by kind. Below the table: what finishing took, what a keyframe
and a frame add once the images of old keyframes are spilled to disk, and what ten minutes of unseen ground
would need. That figure supposes keyframes as often as in the first play: played back, a sequence shows known
ground. ``--set tracking.keyframe_overlap=0.97`` makes keyframes of known ground as well, and so a large map.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.command import errors_in_one_line, parser_of
from benchmarks.markdown import markdown_table
from benchmarks.record import environment, write_benchmark
from benchmarks.seeded import seeded_depth_model
from benchmarks.sub_sequences import setting
from benchmarks.worker import memory_mib
from slamdepth.config import Config, merge
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.frontend.features import Features
from slamdepth.frontend.matching import PixelGrid
from slamdepth.tracking import Tracker

_MIB = 2**20
_TEN_MINUTES = 18_000  # frames at 30 Hz


@dataclass(frozen=True)
class TrackerMemory:
    """MiB of a tracker's arrays.

    Attributes:
        images: images and depth maps of keyframes in memory; bounded by ``map.keyframe_memory_mib`` or by
            eight keyframes, whichever is more.
        features: keypoints, descriptors and depth priors of keyframes.
        landmarks: positions, covariances and descriptors of landmarks.
        observations: what every frame observed.
        on_disk: images and depth maps spilled to the temporary file.
    """

    images: float
    features: float
    landmarks: float
    observations: float
    on_disk: float

    @classmethod
    def of(cls, tracker: Tracker) -> TrackerMemory:
        """Add up the arrays in the private parts of ``tracker``, after its threads are done."""
        tracker._workers.between.wait()
        map_ = tracker._active.map
        return cls(
            images=map_._store.resident_bytes / _MIB,
            features=sum(map(_array_bytes, map_._states)) / _MIB,
            landmarks=_array_bytes(map_._own) / _MIB,
            observations=tracker._active.frames.size_bytes / _MIB,
            on_disk=map_._store.spilled_bytes / _MIB,
        )


def _array_bytes(holder: object) -> int:
    """Bytes of the arrays of ``holder``; views of one array count once."""
    return sum({array.__array_interface__["data"][0]: array.nbytes for array in _arrays(holder)}.values())


def _arrays(holder: object) -> Iterator[NDArray[Any]]:
    for value in vars(holder).values():
        if isinstance(value, np.ndarray):
            yield value
        elif isinstance(value, Features | PixelGrid):
            yield from _arrays(value)


@dataclass(frozen=True)
class Sample:
    """The tracker and its process after a number of frames.

    Attributes:
        cpu_ms: processor time of each frame since the sample before, all threads, without reading.
        process_mib: resident memory of the process.
        tracker: MiB of the tracker's arrays.
    """

    frames: int
    keyframes: int
    cpu_ms: float
    process_mib: float
    tracker: TrackerMemory


def forth_and_back(count: int) -> Iterator[int]:
    """``0 .. count-1 .. 0 .. count-1`` without end; the ends come once."""
    if count == 1:
        return itertools.repeat(0)
    return itertools.cycle([*range(count), *range(count - 2, 0, -1)])


def measure(
    dataset: Dataset, tracker: Tracker, asked: argparse.Namespace, report: Callable[[Sample], None]
) -> tuple[list[Sample], dict[str, float]]:
    """Play the sequence and finish.

    Args:
        asked: the parsed command line.
        report: called with each sample.

    Returns:
        The samples, and the figures of the whole run by name.
    """
    length = min(len(dataset), asked.length or len(dataset))
    with_depth = asked.depth == "sensor"
    samples: list[Sample] = []
    lost = 0
    spent_s, sampled = 0.0, 0
    for n, index in enumerate(itertools.islice(forth_and_back(length), asked.frames), 1):
        frame = dataset.read(index, with_depth=with_depth)
        start = time.process_time()
        result = tracker.step(replace(frame, index=n - 1, timestamp_s=(n - 1) / dataset.camera.fps))
        tracker._workers.between.wait()
        spent_s += time.process_time() - start
        lost += result.T_world_camera is None
        if n == length or n % asked.every == 0 or n == asked.frames:
            cpu_ms = 1e3 * spent_s / (n - sampled)
            spent_s, sampled = 0.0, n
            samples.append(
                Sample(n, result.keyframes, cpu_ms, memory_mib("VmRSS"), TrackerMemory.of(tracker))
            )
            report(samples[-1])
    start = time.process_time()
    done = tracker.finish()
    figures = {
        "finish_cpu_s": time.process_time() - start,
        "lost": lost,
        "loops": done.statistics.loop_closures,
        "resident_after_finish_mib": memory_mib("VmRSS"),
        "peak_mib": memory_mib("VmHWM"),
    }
    return samples, figures | growth(samples, length)


def growth(samples: list[Sample], first_play: int) -> dict[str, float]:
    """What each keyframe and each frame adds, and what ten minutes of unseen ground would need.

    Args:
        first_play: frames of the first play, in which all ground is new.
    """
    first = next(s for s in samples if s.frames >= min(first_play, samples[-1].frames))
    last = samples[-1]
    more = last.keyframes - first.keyframes
    is_spilling = more > 0 and first.tracker.on_disk > 0  # the memory budget is used up
    disk_mib = (last.tracker.on_disk - first.tracker.on_disk) / more if is_spilling else 0.0
    keyframe_mib = (last.tracker.features + last.tracker.landmarks) / last.keyframes
    frame_mib = last.tracker.observations / last.frames
    rate = first.keyframes / first.frames
    arrays = last.tracker.images + last.tracker.features + last.tracker.landmarks + last.tracker.observations
    new_ground = last.process_mib - arrays + max(s.tracker.images for s in samples)
    new_ground += _TEN_MINUTES * (rate * keyframe_mib + frame_mib)
    return {
        "keyframe_mib": keyframe_mib,
        "keyframe_disk_mib": disk_mib,
        "frame_kib": 1024 * frame_mib,
        "keyframes_per_frame_of_new_ground": rate,
        "ten_minutes_of_new_ground_mib": new_ground,
    }


def table(samples: list[Sample]) -> str:
    """The samples as Markdown, sizes in MiB."""
    kinds = [name.replace("_", " ") for name in TrackerMemory.__dataclass_fields__]
    rows = ((s.frames, s.keyframes, s.cpu_ms, s.process_mib, *asdict(s.tracker).values()) for s in samples)
    headings = ["frames", "keyframes", "CPU ms", "process MiB", *kinds]
    return markdown_table(headings, [[f"{value:.0f}" for value in row] for row in rows])


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = parser_of("memory", __doc__)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of sequences")
    parser.add_argument("--sequence", required=True, metavar="NAME", help="which of them")
    parser.add_argument("--depth", default="sensor", metavar="MODEL")
    parser.add_argument("--frames", type=int, default=5000, metavar="N", help="number of frames to play")
    parser.add_argument("--length", type=int, metavar="N", help="turn back after N frames")
    parser.add_argument("--every", type=int, default=1000, metavar="N", help="frames per line")
    parser.add_argument("--budget", type=float, metavar="MIB", help="map.keyframe_memory_mib")
    parser.add_argument("--set", type=setting, action="append", default=[], dest="settings",
                        metavar="SECTION.KEY=VALUE", help="a setting; can be repeated")  # fmt: skip
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write all figures here, as JSON")
    asked = parser.parse_args(arguments)
    for name in ("frames", "every", "length"):
        if (value := getattr(asked, name)) is not None and value < 1:
            parser.error(f"--{name} must be at least 1, got {value}")
    console = Console(stderr=True)
    begun = environment()
    changed: dict[str, Any] = {} if asked.budget is None else {"map": {"keyframe_memory_mib": asked.budget}}
    for one in asked.settings:
        changed = merge(changed, one)
    config = Config.from_dict(changed, origin="--budget and --set")
    dataset = open_dataset(asked.data / asked.sequence)
    model = seeded_depth_model(asked.depth, config)
    samples, figures = measure(
        dataset, Tracker(dataset.camera, model, config), asked,
        lambda s: console.print(f"{s.frames} frames: {s.process_mib:.0f} MiB", style="dim"),
    )  # fmt: skip
    if asked.output is not None:
        settings = {key: value for key, value in vars(asked).items() if key not in ("data", "output")}
        write_benchmark(asked.output, begun, settings, samples=[asdict(s) for s in samples], figures=figures)
    print(table(samples))
    print()
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
