# SPDX-License-Identifier: Apache-2.0
"""Heads, losses and inputs compared on places left out, several seeds each.

python -m benchmarks.depth_trials --seeds 3 --output runs/depth-trials

The places of the settings' first source are left out in three groups; one small head learns from the
others and from every other source, of views that are not mixed, and is judged at 1/7 of the resolution
on the plain views of those left out. All trials of a seed see the same views in the same order. What is
chosen by these figures has seen no sequence to be judged. A finished trial is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress as Bar
from torch import nn

from benchmarks.command import errors_in_one_line
from benchmarks.depth_places import DEFAULT_CONFIG, config_without, places_of, unmixed
from benchmarks.depth_rows import read_row
from benchmarks.depth_trial_heads import DptLikeHead, LinearHead, Loss, mse_ssim, normals_too
from benchmarks.markdown import markdown_table
from benchmarks.summary import environment
from slamdepth.depth.head import DepthHead, HeadShape
from slamdepth.io import write_json
from slamdepth.training.caches import Encoder, fill_cache, open_encoder, plan_caches
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.features import FeatureCache, load_batch, load_mixed_batch
from slamdepth.training.loop import head_shape, learning_rate
from slamdepth.training.losses import taught, total_loss
from slamdepth.training.stages import coarse_target, not_always_told, predict

_GROUPS = 3
_FEWEST_CELLS = 40
_AT_ONCE = 10
FIGURES = ("abs_rel", "one_median", "frame_median", "delta1_frame_median", "scale_spread", "scale_off")
_HEADINGS = ("AbsRel as predicted", "one median", "frame median", "delta1 (frame median)", "scale spread",
             "scale off")  # fmt: skip

Build = Callable[[HeadShape, float], nn.Module]


@dataclass(frozen=True)
class Trial:
    """What differs from the settings.

    Attributes:
        change: settings by dotted name.
        build, loss: instead of the shipped head and the settings' loss.
        is_real_only: without the other sources (synthetic rooms).
        all_teach_both: every source teaches relief and level, whatever the settings say.
    """

    change: dict[str, Any] = field(default_factory=dict)
    build: Build = DepthHead
    loss: Loss | None = None
    is_real_only: bool = False
    all_teach_both: bool = False


TRIALS: dict[str, Trial] = {
    "as shipped": Trial(),
    "not told where down is": Trial({"head.gravity": False}),
    "as held, not turned upright": Trial({"head.gravity": False, "view.upright": False}),
    "every source teaches both": Trial(all_teach_both=True),
    "relief and level by the same layers": Trial({"head.level_dim": 0, "head.gravity": False}),
    "linear head": Trial(build=LinearHead),
    "DPT-like head": Trial(build=DptLikeHead),
    "normals too": Trial(loss=normals_too),
    "MSE * exp(1 - SSIM)": Trial(loss=mse_ssim),
    "154 x 210 pixels": Trial({"view.rows": 154, "view.columns": 210}),
    "238 x 322 pixels": Trial({"view.rows": 238, "view.columns": 322}),
    "308 x 420 pixels": Trial({"view.rows": 308, "view.columns": 420}),
    "no dropout, little decay": Trial({"head.dropout": 0.0, "weight_decay": 0.05}),
    "last block only": Trial({"head.taps": (11,)}),
    "real places only": Trial(is_real_only=True, all_teach_both=True),  # nothing else would teach relief
}


def groups_of(base: TrainConfig) -> list[tuple[str, ...]]:
    """The places left out together: every third of the first source."""
    names = places_of(base)
    return [group for k in range(_GROUPS) if (group := names[k::_GROUPS])]


def trial_config(base: TrainConfig, trial: Trial, left_out: Sequence[str], samples: int) -> TrainConfig:
    """``base`` with the trial's change, ``left_out`` held out, at most ``samples`` views of a place."""
    values = config_without(unmixed(base), None, Path("unused"), samples=samples).model_dump()
    first = base.sources[0].folder
    sources = []
    values["head"]["down_dim"] = 0  # gravity is known here
    for source in values["sources"]:
        if source["teaches"] == "down":
            continue
        if trial.all_teach_both:
            source = {**source, "teaches": "both"}
        is_real = source["folder"] == first
        if is_real and source["places"][0]["name"] in left_out:
            source = {**source, "places": [], "held_out": [source["places"][0]["name"]]}
        if is_real or not trial.is_real_only:
            sources.append(source)
    values["sources"] = sources
    for name, value in trial.change.items():
        section, _, last = name.rpartition(".")
        (values[section] if section else values)[last] = value
    return TrainConfig.from_dict(values, origin="benchmarks.depth_trials")


def train_head(
    config: TrainConfig, trial: Trial, caches: Sequence[FeatureCache], dim: int, steps: int, seed: int
) -> nn.Module:
    """One head, all of it at 1/7 of the resolution."""
    one_epoch = config.model_copy(update={"coarse_epochs": 1})
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        order = np.random.default_rng(seed)
        samples = np.array([(c, k) for c, cache in enumerate(caches) for k in range(len(cache))])
        head = trial.build(head_shape(config, dim), config.head.dropout).train()
        optimiser = torch.optim.AdamW(
            head.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        for step in range(steps):
            chosen = samples[order.choice(len(samples), min(config.batch, len(samples)), replace=False)]
            batch, teaches = load_mixed_batch(caches, chosen, "cpu")
            batch = not_always_told(batch, config.head)
            prediction, target = predict(head, batch, False)
            prediction = taught(prediction, target, teaches)
            loss = (
                trial.loss(prediction, target) if trial.loss else total_loss(prediction, target, config.loss)
            )
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(one_epoch, step / steps)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(head.parameters(), 1.0)
            optimiser.step()
    return head.eval()


def judge_head(head: nn.Module, cache: FeatureCache) -> dict[str, float]:
    """Figures of one place at 1/7 of the resolution, means over its views; ``scale_off`` is the size
    of the mean log of its factor, ``scale_spread`` that log's deviation."""
    errors = []
    for start in range(0, len(cache), _AT_ONCE):
        chosen = np.arange(start, min(start + _AT_ONCE, len(cache)))
        tokens, class_tokens, image, field, depth = load_batch(cache, chosen, "cpu")
        with torch.inference_mode():
            log_depth = head.coarse(tokens, class_tokens, image, field)[0][:, 0]
        for predicted, target in zip(log_depth, coarse_target(depth), strict=True):
            known = target > 0
            if int(known.sum()) >= _FEWEST_CELLS:
                errors.append((predicted[known] - target[known].log()).double().numpy())
    levels = np.array([np.median(error) for error in errors])
    level = float(np.median(np.concatenate(errors)))
    free = [error - own for error, own in zip(errors, levels, strict=True)]
    return {
        "abs_rel": _abs_rel(errors),
        "one_median": _abs_rel([error - level for error in errors]),
        "frame_median": _abs_rel(free),
        "delta1_frame_median": float(np.mean([np.mean(np.abs(error) < np.log(1.25)) for error in free])),
        "scale_spread": float(levels.std()),
        "scale_off": abs(float(levels.mean())),
    }


def _abs_rel(errors: Sequence[Any]) -> float:
    return float(np.mean([np.abs(np.expm1(error)).mean() for error in errors]))


def try_out(
    base: TrainConfig, trial: Trial, encoder: Encoder, *, samples: int, steps: int, seed: int
) -> dict[str, dict[str, float]]:
    """The figures of every place by a head that has not seen it."""
    found = {}
    for left_out in groups_of(base):
        config = trial_config(base, trial, left_out, samples)
        planned = plan_caches(config, encoder.key)
        caches = [fill_cache(plan, config, encoder.backbone) for plan in planned]
        learnt = [cache for plan, cache in zip(planned, caches, strict=True) if plan.held_out is None]
        head = train_head(config, trial, learnt, encoder.backbone.dim, steps, seed)
        for plan, cache in zip(planned, caches, strict=True):
            if plan.held_out is not None:
                found[plan.held_out] = judge_head(head, cache)
    return found


def mean_over_places(found: dict[str, dict[str, float]]) -> list[float]:
    """Of each of :data:`FIGURES`; every place counts the same."""
    return [float(np.mean([figures[name] for figures in found.values()])) for name in FIGURES]


def table(results: dict[str, list[dict[str, dict[str, float]]]]) -> str:
    """A row a trial: the mean over seeds of the mean over places, and half the range over seeds; last,
    how much more the frame-median error is than that of the first trial with the same seed."""
    rows, first = [], None
    for label, of_seeds in results.items():
        values = np.array([mean_over_places(found) for found in of_seeds])
        first = values if first is None else first
        cells = [
            f"{mean:.3f} ±{half:.3f}"
            for mean, half in zip(values.mean(axis=0), np.ptp(values, axis=0) / 2, strict=True)
        ]
        at = FIGURES.index("frame_median")
        more = values[:, at] - first[: len(values), at] if len(values) <= len(first) else np.full(1, np.nan)
        cells.append(" ".join(f"{100 * one:+.1f}" for one in more))
        rows.append([label, str(len(of_seeds)), *cells])
    return markdown_table(["trial", "seeds", *_HEADINGS, "frame median more than first, % points"], rows)


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Train, judge, print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_trials", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="default: the shipped head's")
    parser.add_argument("--output", type=Path, default=Path("runs/depth-trials"), metavar="DIR")
    parser.add_argument("--trials", nargs="*", choices=TRIALS, metavar="NAME", help="default: all")
    parser.add_argument("--seeds", type=int, default=3, help="how many, from 0")
    parser.add_argument("--samples", type=int, default=40, help="no more views of a place than this")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--batch", type=int, help="default: as the settings say")
    asked = parser.parse_args(arguments)
    console = Console(stderr=True)
    labels = asked.trials or list(TRIALS)
    results: dict[str, list[dict[str, dict[str, float]]]] = {label: [] for label in labels}
    base = TrainConfig.from_yaml(asked.config)
    base = base.model_copy(update={"batch": asked.batch}) if asked.batch else base
    encoder = open_encoder(base.backbone)
    with Bar(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=asked.seeds * len(labels))
        for seed in range(asked.seeds):
            for label in labels:
                bar.update(task, description=f"{label}, seed {seed}")
                settings = {"base": digest(base), "trial": label, "seed": seed, "steps": asked.steps,
                            "samples": asked.samples}  # fmt: skip
                file = asked.output / f"{digest(base, settings)}.json"
                row = read_row(file, settings)
                if row is None:
                    found = try_out(
                        base, TRIALS[label], encoder, samples=asked.samples, steps=asked.steps, seed=seed
                    )
                    row = {"settings": settings, "environment": environment(), "places": found}
                    file.parent.mkdir(parents=True, exist_ok=True)
                    write_json(file, row)
                results[label].append(row["places"])
                bar.advance(task)
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
