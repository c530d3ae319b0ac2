# SPDX-License-Identifier: Apache-2.0
"""What each part of the default head's training is worth: trained without it, judged zero-shot.

python -m benchmarks.depth_ablation SEQ [SEQ ...] --samples 60 --output runs/depth-ablation

One small head a row, all with the same number of steps, whatever they are trained on. A
finished training and a finished judgement are not made again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress as Bar

from benchmarks.command import errors_in_one_line
from benchmarks.depth_places import DEFAULT_CONFIG, config_without
from benchmarks.depth_rows import judged_row, table
from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import create_depth_model
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.loop import steps_per_epoch, train_depth
from slamdepth.training.progress import TrainStep

VARIANTS: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "real places only": {"sources": "real"},
    "synthetic rooms only": {"sources": "synthetic"},
    "no mixing of scenes": {"mixed": 0.0},
    "real places only, no mixing": {"sources": "real", "mixed": 0.0},
    "no dropout, little decay": {"dropout": 0.0, "weight_decay": 0.05},
    "last block only": {"taps": (11,)},
    "four blocks": {"taps": (2, 5, 8, 11)},
    "twice as wide and deep": {"dim": 256, "blocks": 2},
    "no gradient loss": {"gradient": 0.0},
    "likelihood only": {"gradient": 0.0, "scale_invariant": 0.0},
}
_SECTIONS = {"dropout": "head", "taps": "head", "dim": "head", "blocks": "head", "gradient": "loss",
             "scale_invariant": "loss"}  # fmt: skip


def variant_config(base: TrainConfig, change: dict[str, Any], *, samples: int, steps: int) -> TrainConfig:
    """``base`` with ``change``, one member, about ``steps`` steps at 1/7 resolution and one fine epoch.

    Args:
        samples: no more than so many views of a place.
    """
    values = config_without(base, None, Path("unused"), samples=samples).model_dump()
    first = base.sources[0].folder
    keep = {"real": (True,), "synthetic": (False,), None: (True, False)}[change.get("sources")]
    sources = [source for source in values["sources"] if (source["folder"] == first) in keep]
    if "mixed" in change:
        sources = [{**s, "augment": {**s["augment"], "mixed": change["mixed"]}} for s in sources]
    values |= {"sources": sources, "members": 1}
    for name, value in change.items():
        if name in _SECTIONS:
            values[_SECTIONS[name]][name] = value
        elif name not in ("sources", "mixed"):
            values[name] = value
    views = sum(source["places"][0]["samples"] for source in sources)
    values["coarse_epochs"] = max(1, round(steps / steps_per_epoch(base, views)))
    values["fine_epochs"] = 1
    return TrainConfig.from_dict(values, origin="benchmarks.depth_ablation")


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Train, judge, print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_ablation", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("data", type=Path, nargs="+", metavar="DATA", help="must show no place trained on")
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="default: the shipped head's")
    parser.add_argument("--output", type=Path, default=Path("runs/depth-ablation"), metavar="DIR")
    parser.add_argument("--variants", nargs="*", choices=VARIANTS, metavar="NAME", help="default: all")
    parser.add_argument("--samples", type=int, default=60, help="no more views of a place than this")
    parser.add_argument("--steps", type=int, default=180, help="at 1/7 resolution")
    parser.add_argument("--stride", type=int, help="default: 10 of a sequence, 1 of training pairs")
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args(arguments)
    console = Console(stderr=True)
    rows = []
    base = TrainConfig.from_yaml(asked.config)
    with Bar(console=console, disable=not console.is_terminal, transient=True) as bar:
        for label in asked.variants or VARIANTS:
            config = variant_config(base, VARIANTS[label], samples=asked.samples, steps=asked.steps)
            key = digest(config)
            head = asked.output / f"{key}.safetensors"
            task = bar.add_task(label, total=1.0)

            def tell(step: TrainStep, task: Any = task, label: str = label) -> None:
                share, what = step.done / step.total, f"{label}: {step.stage} {step.detail}"
                bar.update(task, completed=share, description=what)

            def made(config: TrainConfig = config, head: Path = head, tell: Any = tell) -> DepthModel:
                if not head.is_file():
                    named = TrainConfig.from_dict({**config.model_dump(), "output": str(head)})
                    train_depth(named, device=asked.device, progress=tell)
                return create_depth_model("dinov2", weights=head, device=asked.device)

            for path in asked.data:
                file = asked.output / f"{key}@{path.resolve().name}.json"
                rows.append(
                    judged_row(file, label, made, path.resolve(), {"training": key}, stride=asked.stride)
                )
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
