# SPDX-License-Identifier: Apache-2.0
"""How long a depth map takes: by stage for whole models, and the ViT alone in every faster form.

python -m benchmarks.depth_latency --models dinov2 --sizes 224x224 238x322 --repeats 30

The first table has the dissertation's columns (resize, ViT, head) for any model with a DINOv2
inside. The second runs the backbone as PyTorch eager and in other forms, each with its error
against eager float32. Medians after a warm-up. Run it on a machine with nothing else to do: the
file says how busy it was, and CPU time beside wall time shows whether others took the processor.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

# Read when PyTorch loads; as the command line has it, so that times are those a user gets.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from benchmarks.command import errors_in_one_line
from benchmarks.depth_latency_stages import stage_row
from benchmarks.depth_latency_variants import VARIANTS, variant_row
from benchmarks.summary import environment
from slamdepth.errors import ConfigError
from slamdepth.io import write_json

FORMAT = 1


def parse_size(text: str) -> tuple[int, int]:
    """``"238x322"`` as rows and columns, multiples of 14.

    Raises:
        ConfigError: it is no such size.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    rows, columns = (int(match[1]), int(match[2])) if match else (0, 0)
    if not rows or not columns or rows % 14 or columns % 14:
        raise ConfigError(f"--sizes {text}: a size is ROWSxCOLUMNS in multiples of 14, as 238x322")
    return rows, columns


def stages_table(rows: list[dict[str, Any]]) -> str:
    """The dissertation's table, milliseconds."""
    lines = ["| model | device | threads | resize | ViT | head | together | CPU time |", "| --- " * 8 + "|"]
    for row in rows:
        if "failed" in row:
            lines.append(f"| {row['model']} | {row['device']} | {row['threads']} | {row['failed']} |||||")
            continue
        times = (f"{row[key]:.1f}" for key in ("resize_ms", "vit_ms", "head_ms", "together_ms", "cpu_ms"))
        lines.append(f"| {row['model']} | {row['device']} | {row['threads']} | {' | '.join(times)} |")
    return "\n".join(lines)


def variants_table(rows: list[dict[str, Any]]) -> str:
    """The ViT's forms; times in milliseconds, error relative to eager float32."""
    lines = ["| ViT as | device | input | threads | wall ms | CPU ms | error |", "| --- " * 7 + "|"]
    for row in rows:
        about = f"| {row['variant']} | {row['device']} | {row['size']} | {row['threads']} | "
        if "failed" in row:
            lines.append(f"{about}{row['failed']} |||")
        else:
            lines.append(f"{about}{row['wall_ms']:.1f} | {row['cpu_ms']:.1f} | {row['error']:.4f} |")
    return "\n".join(lines)


def measure(
    asked: argparse.Namespace, tell: Callable[[str], None]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """All rows that were asked for; one that cannot be is a row that says why."""
    import torch

    sizes = [parse_size(text) for text in asked.sizes]
    unknown = sorted(set(asked.variants) - set(VARIANTS))
    if unknown:
        raise ConfigError(f"--variants {unknown[0]}: choose from: {', '.join(VARIANTS)}")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() and not asked.no_cuda else [])]
    stages, variants = [], []
    for device in devices:
        for threads in asked.threads if device == "cpu" else asked.threads[-1:]:
            torch.set_num_threads(threads)
            for name in asked.models:
                tell(f"{name} on {device}, {threads} threads")
                stages.append(stage_row(name, device, asked.frame, asked.repeats, asked.warm_up))
            for rows, columns in sizes:
                for variant in asked.variants:
                    tell(f"ViT as {variant} at {rows}x{columns} on {device}, {threads} threads")
                    variants.append(
                        variant_row(variant, device, (rows, columns), asked.repeats, asked.warm_up)
                    )
    return stages, variants


@errors_in_one_line
def main(arguments: list[str]) -> int:
    """Measure what the command line names and print both tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth_latency", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--models", nargs="*", default=["dinov2", "dinov2-mlp-224", "dinov2-mlp-32"], metavar="NAME",
        help="depth models by name; dinov2-mlp-224 and -32 are the dissertation's with random weights",
    )  # fmt: skip
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), metavar="NAME")
    parser.add_argument("--sizes", nargs="+", default=["224x224", "238x322"], metavar="ROWSxCOLUMNS")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--repeats", type=int, default=30, metavar="N")
    parser.add_argument("--warm-up", type=int, default=5, metavar="N")
    parser.add_argument("--frame", default="480x640", help="size of the camera's image for whole models")
    parser.add_argument("--no-cuda", action="store_true")
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write all figures here, as JSON")
    asked = parser.parse_args(arguments)
    console = Console(stderr=True)
    begun = environment()
    stages, variants = measure(asked, lambda what: console.print(what, style="dim"))
    if asked.output is not None:
        settings = {key: value for key, value in vars(asked).items() if key != "output"}
        about = {"format": FORMAT, "environment": begun, "settings": settings}
        write_json(asked.output, {**about, "stages": stages, "variants": variants})
    print(stages_table(stages))
    print()
    print(variants_table(variants))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
