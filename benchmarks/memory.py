# SPDX-License-Identifier: Apache-2.0
"""How memory grows with the length of a sequence, played forth and back as often as needed.

python -m benchmarks.memory --data DIR --sequence NAME --depth sensor --frames 5000

One line a thousand frames: keyframes, the memory of the process, and what the tracker's arrays
take by kind. Below: how much a keyframe and a frame add once the images of old keyframes wait
on disk, and what ten minutes of new ground would need. Played back, a sequence is known ground;
a walk through new rooms makes keyframes as often as its first play does.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.command import errors_in_one_line
from benchmarks.markdown import markdown_table
from benchmarks.summary import environment
from benchmarks.worker import memory_mib
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.registry import create_depth_model
from slamdepth.io import write_json
from slamdepth.pipeline.run import seed_everything, seed_torch
from slamdepth.tracking import Tracker

FORMAT = 1
_MIB = 2**20
_TEN_MINUTES = 18_000  # frames at 30 Hz


@dataclass(frozen=True)
class Sample:
    """The tracker after so many frames; sizes in MiB.

    Attributes:
        resident: memory of the process.
        images, features, points, seen: arrays in memory; see ``slamdepth.tracking.held.HeldBytes``.
        on_disk: in the temporary file.
    """

    frames: int
    keyframes: int
    resident: float
    images: float
    features: float
    points: float
    seen: float
    on_disk: float


def forth_and_back(count: int) -> Iterator[int]:
    """``0 .. count-1 .. 0 .. count-1`` for ever; the ends come once."""
    if count == 1:
        return itertools.repeat(0)
    return itertools.cycle([*range(count), *range(count - 2, 0, -1)])


def sample(tracker: Tracker, frames: int, keyframes: int) -> Sample:
    """What the tracker and its process hold now."""
    held = {name: size / _MIB for name, size in asdict(tracker.held()).items()}
    return Sample(
        frames, keyframes, memory_mib("VmRSS"), held["images"], held["features"], held["points"],
        held["frames"], held["on_disk"],
    )  # fmt: skip


def measure(
    dataset: Dataset, tracker: Tracker, asked: argparse.Namespace, tell: Callable[[Sample], None]
) -> tuple[list[Sample], dict[str, float]]:
    """Play the sequence and finish; samples on the way, and figures of the end."""
    length = min(len(dataset), asked.length or len(dataset))
    with_depth = asked.depth == "sensor"
    samples: list[Sample] = []
    lost = 0
    for n, index in enumerate(itertools.islice(forth_and_back(length), asked.frames), 1):
        frame = dataset.read(index, with_depth=with_depth)
        result = tracker.step(replace(frame, index=n - 1, timestamp_s=(n - 1) / dataset.camera.fps))
        lost += result.T_world_camera is None
        if n == length or n % asked.every == 0 or n == asked.frames:
            samples.append(sample(tracker, n, result.keyframes))
            tell(samples[-1])
    done = tracker.finish()
    figures = {
        "lost": lost,
        "loops": done.statistics.loop_closures,
        "resident_after_finish_mib": memory_mib("VmRSS"),
        "peak_mib": memory_mib("VmHWM"),
    }
    return samples, figures | growth(samples, length)


def growth(samples: list[Sample], first_play: int) -> dict[str, float]:
    """What each keyframe and frame adds, and ten minutes of nothing but new ground would need."""
    first = next(s for s in samples if s.frames >= min(first_play, samples[-1].frames))
    last = samples[-1]
    more = last.keyframes - first.keyframes
    away = (last.on_disk - first.on_disk) / more if more and first.on_disk else 0.0  # once the budget is full
    keyframe_mib = (last.features + last.points) / last.keyframes
    frame_kib = 1024 * last.seen / last.frames
    rate = first.keyframes / first.frames
    without = last.resident - last.images - last.features - last.points - last.seen
    new_ground = without + max(s.images for s in samples)
    new_ground += _TEN_MINUTES * (rate * keyframe_mib + frame_kib / 1024)
    return {
        "keyframe_mib": keyframe_mib,
        "keyframe_disk_mib": away,
        "frame_kib": frame_kib,
        "keyframes_per_frame_of_new_ground": rate,
        "ten_minutes_of_new_ground_mib": new_ground,
    }


def table(samples: list[Sample]) -> str:
    """The samples as a table of a document."""
    heads = ("frames", "keyframes", "process MiB", "images", "features", "points", "seen", "on disk")
    return markdown_table(heads, [[f"{value:.0f}" for value in asdict(s).values()] for s in samples])


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Measure what the command line names and print it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.memory", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of sequences")
    parser.add_argument("--sequence", required=True, metavar="NAME", help="which of them")
    parser.add_argument("--depth", default="sensor", metavar="MODEL")
    parser.add_argument("--frames", type=int, default=5000, metavar="N", help="frames to play in all")
    parser.add_argument("--length", type=int, metavar="N", help="turn back after so many frames")
    parser.add_argument("--every", type=int, default=1000, metavar="N", help="frames between two lines")
    parser.add_argument("--budget", type=float, metavar="MIB", help="map.keyframe_memory_mib")
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write all figures here, as JSON")
    asked = parser.parse_args(arguments)
    for name in ("frames", "every", "length"):
        if (value := getattr(asked, name)) is not None and value < 1:
            parser.error(f"--{name} must be at least 1, got {value}")
    console = Console(stderr=True)
    begun = environment()
    changed: dict[str, Any] = {} if asked.budget is None else {"keyframe_memory_mib": asked.budget}
    config = Config.from_dict({"map": changed}, origin="--budget")
    dataset = open_dataset(asked.data / asked.sequence)
    seed_everything(config.seed)
    model = create_depth_model(asked.depth, seed=config.seed)
    seed_torch(config.seed)
    samples, figures = measure(
        dataset, Tracker(dataset.camera, model, config), asked,
        lambda s: console.print(f"{s.frames} frames: {s.resident:.0f} MiB", style="dim"),
    )  # fmt: skip
    if asked.output is not None:
        chosen = {key: str(value) for key, value in vars(asked).items() if key not in ("data", "output")}
        about = {"format": FORMAT, "environment": begun, "settings": chosen}
        write_json(asked.output, {**about, "samples": [asdict(s) for s in samples], "figures": figures})
    print(table(samples))
    print()
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
