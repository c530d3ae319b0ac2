# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of predicted depth alone: accuracy, places left out, latency.

    python -m benchmarks.depth accuracy SEQ... --models constant mean-image dinov2-mlp-32 dinov2
    python -m benchmarks.depth accuracy SEQ... --train PAIRS --held-out 'PAIRS[40-73]' 'PAIRS[350-383]'
    python -m benchmarks.depth left-out SEQ... --samples 40 --coarse-epochs 5 --unmixed
    python -m benchmarks.depth latency --models dinov2 --threads 1 2 --data SEQ --output latency.json
    python -m benchmarks.depth latency --models dinov2:float32 dinov2:int8 dinov2:int8:32340 --one-pass

accuracy: baselines trained here and any depth models by name, judged on the same frames; a table, and a few
predictions as DATA.png. Times are of whole predictions with all cores.
left-out: the head trained without each place and judged on it, and trained on all and judged on SEQ...
latency: milliseconds before, in and after the ViT, for each device and number of threads; how far depth
is from that of the first model.

The first two keep heads and figures in --output DIR and compute nothing twice. Run latency on an idle
machine: its file records the load, and CPU time far below wall time shows that others took the processor.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress as Bar

# PyTorch reads this when it loads. The command line of slamdepth sets it too, so times agree.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from benchmarks.command import errors_in_one_line, parser_of, progress_line
from benchmarks.depth_baselines import BASELINES, Baselines, Recipe
from benchmarks.depth_blocks import Block, blocks_by_folder, every, held_out, open_pairs, without
from benchmarks.depth_judged import judged_row, mean_row, only_place, table
from benchmarks.depth_left_out import DEFAULT_CONFIG, left_out_rows, places_of, unmixed
from benchmarks.depth_pictures import draw_kept
from benchmarks.record import environment, write_benchmark
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError
from slamdepth.pipeline.training_data import sequence_readers
from slamdepth.training.config import TrainConfig
from slamdepth.training.data import data_folder
from slamdepth.training.loop import train_depth
from slamdepth.training.mlp import MlpSettings
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.training.readers.pairs import PairPlace

JUDGING_PLACE = "kitchen_kinect"
"""Training pairs of the place of a judging sequence; not trained on by default."""

_LINE_EVERY_S = 30
_CHANGES = {"members": int, "coarse_epochs": int, "fine_epochs": int, "seed": int}


def accuracy(asked: argparse.Namespace) -> None:
    """Judge baselines and depth models on the same frames; print and write the table."""
    begun = environment()
    blocks = blocks_by_folder(asked.held_out)
    judged = [only_place(path.resolve()) for path in asked.data]
    judged += [held_out(folder, numbers) for folder, numbers in blocks.items()]
    rows: list[dict[str, Any]] = []
    files: dict[str, list[Path]] = {}
    with _bars() as start:
        pairs = _training_pairs(asked, blocks)
        baselines = Baselines(pairs, _mlp_settings(asked), asked.output, start)
        for name in asked.models:
            recipe = baselines.recipe(name) if name in BASELINES else _by_name(name, asked.device)
            stem = name.replace(":", "_").replace("/", "_")
            files[name] = [asked.output / f"{stem}@{place.name}.json" for place in judged]
            for file, place in zip(files[name], judged, strict=True):
                rows.append(
                    judged_row(
                        file, name, recipe.make, place, recipe.settings,
                        stride=asked.stride, max_frames=asked.max_frames, pictures=asked.pictures,
                    )
                )  # fmt: skip
    if asked.pictures:
        draw_kept(asked.output, judged, files)
    print(table(rows))
    write_benchmark(
        asked.output / "accuracy.json", begun, _settings(asked), rows=rows, losses=baselines.losses()
    )


def _mlp_settings(asked: argparse.Namespace) -> dict[int, MlpSettings]:
    epochs = {32: asked.epochs, 224: asked.epochs_224 or asked.epochs}
    return {side: MlpSettings(side, epochs=n, bfloat16=asked.bfloat16) for side, n in epochs.items()}


def _by_name(name: str, device: str) -> Recipe:
    model = create_depth_model(name, device=device)
    return Recipe(lambda: model, {"weights": [info.sha256 for info in model.weights]})


def _training_pairs(asked: argparse.Namespace, blocks: Mapping[Path, Sequence[Block]]) -> list[PairPlace]:
    """The pairs to train baselines on, without ``blocks``; none where no baseline is asked for.

    Raises:
        DatasetError: a folder holds no training pairs.
        ConfigError: there are none.
    """
    if not set(BASELINES) & set(asked.models):
        return []
    folders = asked.train or [
        folder for folder in sorted(data_folder("depth_training").glob("*"))
        if (folder / "camera.json").is_file() and folder.name != JUDGING_PLACE
    ]  # fmt: skip
    if not folders:
        raise ConfigError("no training pairs in $SLAMDEPTH_DATA/depth_training; name them by --train")
    places = []
    for place in map(open_pairs, folders):
        left_out = blocks.get(place.images[0].parent, ())
        places.append(every(without(place, left_out, asked.margin), asked.train_stride))
    return places


def left_out(asked: argparse.Namespace) -> None:
    """Train without each place and judge on it; print and write the table."""
    begun = environment()
    base = TrainConfig.from_yaml(asked.config)
    base = unmixed(base) if asked.unmixed else base
    with _bars() as start:

        def train(config: TrainConfig) -> object:
            show = start(Path(config.output).stem)
            return train_depth(config, device=asked.device, progress=show, readers=sequence_readers())

        of_places, of_unseen = left_out_rows(
            base,
            asked.output,
            places_of(base) if asked.places is None else asked.places,
            asked.data,
            train=train,
            load=lambda head: create_depth_model("dinov2", weights=head, device=asked.device),
            samples=asked.samples,
            changes={name: value for name in _CHANGES if (value := getattr(asked, name)) is not None},
            stride=asked.stride,
            max_frames=asked.max_frames,
        )
    mean = [mean_row("each without the place", of_places)] if of_places else []
    rows = [*of_places, *mean, *of_unseen]
    print(table(rows))
    write_benchmark(asked.output / "left-out.json", begun, _settings(asked), rows=rows)


def latency(asked: argparse.Namespace) -> None:
    """Measure each model on each device with each number of threads; print and write the table."""
    import torch

    from benchmarks import depth_latency

    begun = environment()
    if asked.data:
        frames = depth_latency.frames_of(asked.data, asked.repeats)
    else:
        frames = [depth_latency.noise_frame(asked.frame)]
    if asked.one_pass:
        frames = [depth_latency.upright(frame) for frame in frames]
    reference = depth_latency.reference_depth(asked.models[0], asked.devices[0], frames)
    rows = []
    for device in asked.devices:
        for threads in asked.threads if device == "cpu" else asked.threads[-1:]:
            torch.set_num_threads(threads)
            for name in asked.models:
                progress_line(f"{name} on {device}, {threads} threads")
                rows.append(
                    depth_latency.latency_row(name, device, frames, asked.repeats, asked.warm_up, reference)
                )
    print(depth_latency.table(rows))
    if asked.output:
        write_benchmark(asked.output, begun, _settings(asked), rows=rows)


def _settings(asked: argparse.Namespace) -> dict[str, Any]:
    """The options without what differs from machine to machine: paths become names."""
    left = {key: value for key, value in vars(asked).items() if key not in ("run", "output")}
    return {key: _names(value) for key, value in left.items()}


def _names(value: Any) -> Any:
    if isinstance(value, list):
        return [_names(item) for item in value]
    return value.name if isinstance(value, Path) else value


@contextmanager
def _bars() -> Iterator[Callable[[str], Progress]]:
    """Progress bars on a terminal, else lines; what it yields starts the bar of one training."""
    console = Console(stderr=True)
    with Bar(console=console, disable=not console.is_terminal, transient=True) as bar:

        def start(name: str) -> Progress:
            task = bar.add_task(name)

            shown_s = time.monotonic()

            def show(step: TrainStep) -> None:
                nonlocal shown_s
                described = f"{name}: {step.stage} {step.detail}".rstrip()
                if not console.is_terminal and time.monotonic() - shown_s > _LINE_EVERY_S:
                    progress_line(f"{described} ({step.done} of {step.total})")
                    shown_s = time.monotonic()
                bar.update(task, completed=step.done, total=step.total, description=described)

            return show

        yield start


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("depth", __doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    positive = _whole_number(1)

    def command(name: str, run: Callable[[argparse.Namespace], None]) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=(run.__doc__ or "").splitlines()[0])
        made.set_defaults(run=run)
        return made

    one = command("accuracy", accuracy)
    one.add_argument("data", type=Path, nargs="*", metavar="DATA", help="sequences with depth, or pairs")
    one.add_argument("--models", nargs="+", default=[*BASELINES, "dinov2"], metavar="NAME",
                     help=f"baselines ({', '.join(BASELINES)}) and depth models")  # fmt: skip
    one.add_argument("--train", type=Path, nargs="+", metavar="PAIRS",
                     help=f"pairs to train baselines on, a folder or some of its numbers, NAME[FIRST-LAST] "
                     f"(default: $SLAMDEPTH_DATA/depth_training without {JUDGING_PLACE})")  # fmt: skip
    one.add_argument("--held-out", type=Path, nargs="+", default=[], metavar="NAME[FIRST-LAST]",
                     help="pairs left out of training and judged on, those of a folder together")  # fmt: skip
    one.add_argument("--margin", type=_whole_number(0), default=4, metavar="N",
                     help="numbers on each side of these left out of training too (default: 4)")  # fmt: skip
    one.add_argument("--train-stride", type=positive, default=1, metavar="N", help="train on every Nth pair")
    one.add_argument("--epochs", type=positive, default=MlpSettings.epochs, metavar="N")
    one.add_argument("--epochs-224", type=positive, metavar="N", help="of 224 outputs (default: --epochs)")
    one.add_argument("--bfloat16", action="store_true", help="train with products in bfloat16: faster")
    one.add_argument("--pictures", type=_whole_number(0), default=4, metavar="N",
                     help="frames of each data set to draw (default: 4)")  # fmt: skip
    two = command("left-out", left_out)
    two.add_argument("data", type=Path, nargs="*", metavar="DATA", help="must show none of the places")
    two.add_argument("--places", nargs="*", metavar="NAME", help="places to leave out (default: each)")
    two.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="default: dinov2_head_frozen.yaml")
    two.add_argument("--unmixed", action="store_true", help="one head, of sources that mix no views: faster")
    two.add_argument("--samples", type=positive, metavar="N", help="no more than N views of a place")
    for name, kind in _CHANGES.items():
        two.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar="N",
                         help="default: as the settings say")  # fmt: skip
    for made, folder in ((one, "depth-accuracy"), (two, "depth-left-out")):
        made.add_argument("--stride", type=positive, metavar="N", help="default: sequences 10, pairs 1")
        made.add_argument("--max-frames", type=positive, metavar="N")
        made.add_argument("--device", default="cpu")
        made.add_argument("--output", "-o", type=Path, default=Path("runs") / folder, metavar="DIR")
    three = command("latency", latency)
    three.add_argument("--models", nargs="+", default=["dinov2", "dinov2-mlp-224", "dinov2-mlp-32"],
                       metavar="NAME", help="dinov2-mlp-224 and -32 have random weights; dinov2:int8:32340 "
                       "names a precision and the pixels of the input")  # fmt: skip
    three.add_argument("--devices", nargs="+", default=["cpu"], metavar="DEVICE", help="cpu cuda")
    three.add_argument("--threads", type=positive, nargs="+", default=[1, 2], metavar="N")
    three.add_argument("--data", type=Path, metavar="SEQ", help="frames of a sequence in place of noise")
    three.add_argument("--frame", default="480x640", metavar="ROWSxCOLUMNS", help="size of the noise")
    three.add_argument("--one-pass", action="store_true", help="gravity as of a camera held upright is given")
    three.add_argument("--repeats", type=positive, default=30, metavar="N")
    three.add_argument("--warm-up", type=_whole_number(0), default=5, metavar="N")
    three.add_argument("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    asked = parser.parse_args(arguments)
    if asked.run is accuracy and not asked.data and not asked.held_out:
        one.error("name DATA or --held-out to judge on")
    return asked


def _whole_number(least: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"'{text}' is no whole number from {least}")
        return int(text)

    return number


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked = parse(arguments)
    asked.run(asked)
    return 0


if __name__ == "__main__":
    sys.exit(main())
