# SPDX-License-Identifier: Apache-2.0
"""The default head trained once without each place and judged on it, and zero-shot on sequences.

python -m benchmarks.depth_places --zero-shot SEQ [SEQ ...] --samples 120 --output runs/depth-places

Every place of the settings' first source is left out once; what other sources hold (synthetic
rooms) is always trained on. The training on all places is judged on --zero-shot, which must show
none of them; the two kitchens (kitchen_kinect, 7-Scenes redkitchen) are one place, which the shipped
settings do not train on, so both belong there. A place's features are computed once for all
trainings; a finished training and a finished judgement are not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress as Bar

from benchmarks.command import errors_in_one_line
from benchmarks.depth_rows import judged_row, mean_row, table
from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError
from slamdepth.pipeline.training_data import sequence_readers
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.data import data_folder
from slamdepth.training.loop import train_depth
from slamdepth.training.progress import TrainStep

DEFAULT_CONFIG = Path(__file__).resolve().parents[1] / "slamdepth" / "depth" / "configs" / "dinov2_head.yaml"
OVERRULED = ("members", "coarse_epochs", "fine_epochs", "batch", "learning_rate", "seed")

Train = Callable[[TrainConfig], object]
Load = Callable[[Path], DepthModel]


def places_of(base: TrainConfig) -> tuple[str, ...]:
    """The places that can be left out: those of the first source."""
    return tuple(place.name for place in base.sources[0].places)


def unmixed(base: TrainConfig) -> TrainConfig:
    """One head of what ``base`` does not mix: a place's features are then the same whatever is left
    out, since nothing of the others is in them.

    Raises:
        ConfigError: everything is mixed.
    """
    sources = tuple(
        source.model_copy(update={"members": None})
        for source in base.sources
        if not (source.augment or base.view.augment).mixed
    )
    if not sources:
        raise ConfigError("the settings have no source whose views are not mixed")
    return base.model_copy(update={"sources": sources, "members": 1})


def config_without(
    base: TrainConfig,
    left_out: str | None,
    output: Path,
    *,
    samples: int | None = None,
    overruled: dict[str, Any] | None = None,
) -> TrainConfig:
    """``base`` without one place, or as it is.

    Each place becomes a source of its own, so that its features are shared by all trainings; a
    source's ``limit`` is spread over its places. With fewer members than ``base`` has, the first ones
    are trained, and what only the others learn from is left out. Uncertainty is the members' own:
    learnt out of fold it would take a training for each place again.

    Args:
        samples: no more than so many views of a place.
        overruled: other settings by name.

    Raises:
        ConfigError: ``left_out`` is no place of ``base``, or a setting is out of range.
    """
    if left_out is not None and left_out not in places_of(base):
        raise ConfigError(f"'{left_out}' cannot be left out; there are: {', '.join(places_of(base))}")
    count = (overruled or {}).get("members", base.members)
    sources = []
    for source in base.sources:
        members = None if source.members is None else [m for m in source.members if m < count]
        if members == []:
            continue
        total = sum(place.samples for place in source.places)
        share = min(1.0, source.limit / total) if source.limit else 1.0
        for place in source.places:
            if source.folder == base.sources[0].folder and place.name == left_out:
                continue
            views = max(1, round(place.samples * share))
            views = views if samples is None else min(views, samples)
            one = {**place.model_dump(), "samples": views}
            sources.append(
                {**source.model_dump(), "places": [one], "members": members, "held_out": [], "limit": None}
            )
    values = {**base.model_dump(), **(overruled or {}), "sources": sources, "output": str(output)}
    values |= {"trained_on": "", "uncertainty": "own"}
    return TrainConfig.from_dict(values, origin="benchmarks.depth_places")


def leave_one_out(
    base: TrainConfig,
    folder: Path,
    *,
    leave_out: tuple[str, ...],
    zero_shot: tuple[Path, ...],
    samples: int | None,
    overruled: dict[str, Any],
    train: Train,
    load: Load,
    stride: int | None = None,
    max_frames: int | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Train and judge; the rows of the places, and those of the sequences."""
    root = data_folder(base.sources[0].folder).resolve()
    judged_on: list[tuple[str | None, tuple[Path, ...]]] = [
        *((name, (root / name,)) for name in leave_out), *([(None, zero_shot)] if zero_shot else []),
    ]  # fmt: skip
    of_places, of_sequences = [], []
    for left_out, data in judged_on:
        stem = f"without-{left_out}" if left_out else "all-places"
        config = config_without(base, left_out, Path(stem), samples=samples, overruled=overruled)
        key = digest(config)
        head = folder / f"{stem}-{key}.safetensors"

        def made(config: TrainConfig = config, head: Path = head) -> DepthModel:
            if not head.is_file():
                train(TrainConfig.from_dict({**config.model_dump(), "output": str(head)}))
            return load(head)

        for path in data:
            row = judged_row(
                folder / f"{stem}@{path.resolve().name}.json", stem, made, path.resolve(), {"training": key},
                stride=stride, max_frames=max_frames,
            )  # fmt: skip
            (of_places if left_out else of_sequences).append(row)
    return of_places, of_sequences


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Train, judge, print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_places", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="default: the shipped head's")
    parser.add_argument("--output", type=Path, default=Path("runs/depth-places"), metavar="DIR")
    parser.add_argument("--leave-out", nargs="*", metavar="PLACE", help="default: each of the first source")
    parser.add_argument("--zero-shot", type=Path, nargs="*", default=[], metavar="DATA")
    parser.add_argument("--first-source-only", action="store_true", help="without the synthetic rooms")
    parser.add_argument("--unmixed", action="store_true", help="one head, of the sources that are not mixed")
    parser.add_argument("--samples", type=int, help="no more views of a place than this")
    for name in OVERRULED:
        kind = float if name == "learning_rate" else int
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help="default: as the settings say")
    parser.add_argument("--stride", type=int, help="default: 10 of a sequence, 1 of training pairs")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args(arguments)
    console = Console(stderr=True)
    base = TrainConfig.from_yaml(asked.config)
    base = unmixed(base) if asked.unmixed else base
    if asked.first_source_only:
        real = tuple(s for s in base.sources if s.folder == base.sources[0].folder)
        base = base.model_copy(update={"sources": real})
    with Bar(console=console, disable=not console.is_terminal, transient=True) as bar:

        def train(config: TrainConfig) -> object:
            head = Path(config.output).stem
            task = bar.add_task(head)

            def show(step: TrainStep) -> None:
                described = f"{head}: {step.stage} {step.detail}".rstrip()
                bar.update(task, completed=step.done, total=step.total, description=described)

            return train_depth(config, device=asked.device, progress=show, readers=sequence_readers())

        of_places, of_sequences = leave_one_out(
            base,
            asked.output,
            leave_out=tuple(asked.leave_out if asked.leave_out is not None else places_of(base)),
            zero_shot=tuple(asked.zero_shot),
            samples=asked.samples,
            overruled={name: getattr(asked, name) for name in OVERRULED if getattr(asked, name) is not None},
            train=train,
            load=lambda head: create_depth_model("dinov2", weights=head, device=asked.device),
            stride=asked.stride,
            max_frames=asked.max_frames,
        )
    mean = [mean_row("each without the place", of_places)] if of_places else []
    print(table([*of_places, *mean, *of_sequences]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
