# SPDX-License-Identifier: Apache-2.0
"""What predicted depth has to beat, trained here and judged like every other model.

python -m benchmarks.depth_baselines --judge SEQ [SEQ ...] --output runs/depth-baselines

Models: the training median everywhere; the mean depth image; the dissertation's network at
both of its sizes; the same fully connected layers on the pixels, without the ViT; and any depth
model by name. A finished training and a finished judgement are not made again.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress as Bar

from benchmarks.command import errors_in_one_line
from benchmarks.depth_baseline_models import ConstantDepth, MeanImageDepth, PixelMlp
from benchmarks.depth_rows import judged_row, table
from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2 import load_dinov2
from slamdepth.depth.dinov2_mlp import Dinov2Mlp, read_header, save_mlp
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import WeightsError
from slamdepth.training.data import data_folder
from slamdepth.training.mlp import MlpPairs, MlpSettings, cached_tokens, read_pairs, train_mlp
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.training.readers.pairs import PairPlace, PairReader

TRAINED = {
    "dinov2-mlp-32": ("tokens", 32),
    "dinov2-mlp-224": ("tokens", 224),
    "pixel-mlp-32": ("pixels", 32),
    "pixel-mlp-224": ("pixels", 224),
}
SIMPLE = ("constant", "mean-image")
LEFT_OUT = "kitchen_kinect"  # the place of a judging sequence


class Baselines:
    """Fits what is asked for, once, from ``places``."""

    def __init__(self, places: list[PairPlace], settings: MlpSettings, folder: Path, bar: Bar) -> None:
        self.places, self.settings, self.folder, self._bar = places, settings, folder, bar
        self.trained_on = ", ".join(place.name for place in places)

    @functools.cached_property
    def pairs(self) -> MlpPairs:
        return read_pairs(self.places)

    @functools.cached_property
    def focal_px(self) -> float:
        """The focal length all depth is brought to: the middle one of the training images."""
        return float(np.median(self.pairs.focal_px))

    @functools.cached_property
    def tokens(self) -> np.ndarray:
        file = store.find_backbone(None)
        sha256, backbone = store.verify(file), load_dinov2(file)
        parts = [
            cached_tokens(place, backbone, sha256, progress=self._shown(f"tokens of {place.name}"))
            for place in self.places
        ]
        return np.concatenate(parts)

    def recipe(self, name: str) -> tuple[Callable[[], DepthModel], dict[str, Any]]:
        """How to make the model ``name``, once and when it is first judged; and what decides
        its figures, so that they are made anew when that changes."""
        places = {"places": [f"{place.name} {len(place)}" for place in self.places]}
        if name == "constant":
            return functools.cache(self._constant), places
        if name == "mean-image":
            return functools.cache(self._mean_image), places
        if name in TRAINED:
            return functools.cache(lambda: self._trained(name)), {**asdict(self.settings), **places}
        model = create_depth_model(name)
        return lambda: model, {"weights": [info.sha256 for info in model.weights]}

    def _constant(self) -> DepthModel:
        return ConstantDepth(float(np.median(self.pairs.depth_m[self.pairs.depth_m > 0])))

    def _mean_image(self) -> DepthModel:
        depth_m = self.pairs.depth_at(self.focal_px)
        count = (depth_m > 0).sum(axis=0)
        mean = depth_m.sum(axis=0) / np.maximum(count, 1)
        return MeanImageDepth(np.where(count > 0, mean, mean[count > 0].mean()), self.focal_px)

    def _trained(self, name: str) -> DepthModel:
        source, output = TRAINED[name]
        settings = replace(self.settings, output=output)
        said = json.dumps({**asdict(settings), "places": [f"{p.name} {len(p)}" for p in self.places]})
        file = self.folder / f"{name}.safetensors"
        if not _was_trained(file, said):
            pixels = self.pairs.image_rgb.reshape(len(self.pairs), -1)
            features = self.tokens if source == "tokens" else pixels
            depth_m = self.pairs.depth_at(self.focal_px)
            head, losses = train_mlp(features, depth_m, settings, progress=self._shown(name))
            about = {
                "trained_on": self.trained_on, "licence": "trained on data for research use",
                "focal_px": repr(self.focal_px), "settings": said, "losses": json.dumps(losses),
            }  # fmt: skip
            save_mlp(file, head, about)
        return Dinov2Mlp.load(weights=file) if source == "tokens" else PixelMlp.load(file)

    def _shown(self, what: str) -> Progress:
        task = self._bar.add_task(what)

        def show(step: TrainStep) -> None:
            described = f"{what}: {step.detail}" if step.detail else what
            self._bar.update(task, completed=step.done, total=step.total, description=described)

        return show


def _thinned(place: PairPlace, stride: int) -> PairPlace:
    return replace(place, images=place.images[::stride], depths=place.depths[::stride])


def _was_trained(file: Path, said: str) -> bool:
    if not file.is_file():
        return False
    try:
        return read_header(file).get("settings") == said
    except WeightsError:
        return False


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Train, judge, print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_baselines", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--judge", type=Path, nargs="+", required=True, metavar="DATA")
    parser.add_argument(
        "--train", type=Path, nargs="+", metavar="PAIRS",
        help=f"default: all of $SLAMDEPTH_DATA/depth_training but {LEFT_OUT}",
    )  # fmt: skip
    parser.add_argument("--models", nargs="+", default=[*SIMPLE, *TRAINED, "dinov2"], metavar="NAME")
    parser.add_argument("--output", type=Path, default=Path("runs/depth-baselines"), metavar="DIR")
    parser.add_argument("--epochs", type=int, default=MlpSettings.epochs)
    parser.add_argument("--batch", type=int, default=MlpSettings.batch)
    parser.add_argument("--learning-rate", type=float, default=MlpSettings.learning_rate)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--train-stride", type=int, default=1, metavar="N", help="train on every Nth pair")
    parser.add_argument("--stride", type=int, help="default: 10 of a sequence, 1 of training pairs")
    parser.add_argument("--max-frames", type=int)
    asked = parser.parse_args(arguments)
    folders = asked.train or [
        path for path in sorted(data_folder("depth_training").iterdir())
        if (path / "camera.json").is_file() and path.name != LEFT_OUT
    ]  # fmt: skip
    places = [_thinned(PairReader().open(folder), asked.train_stride) for folder in folders]
    settings = MlpSettings(
        epochs=asked.epochs, batch=asked.batch, learning_rate=asked.learning_rate, seed=asked.seed
    )
    rows = _rows(asked, places, settings)
    print(table(rows))
    return 0


def _rows(asked: argparse.Namespace, places: list[PairPlace], settings: MlpSettings) -> list[dict[str, Any]]:
    console = Console(stderr=True)
    rows = []
    with Bar(console=console, disable=not console.is_terminal, transient=True) as bar:
        baselines = Baselines(places, settings, asked.output, bar)
        for name in asked.models:
            make, made_with = baselines.recipe(name)
            for data in asked.judge:
                file = asked.output / f"{name.replace(':', '_').replace('/', '_')}@{data.resolve().name}.json"
                rows.append(
                    judged_row(
                        file, name, make, data.resolve(), made_with,
                        stride=asked.stride, max_frames=asked.max_frames,
                    )
                )  # fmt: skip
    return rows


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
