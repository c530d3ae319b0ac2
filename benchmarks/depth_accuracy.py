# SPDX-License-Identifier: Apache-2.0
"""Depth of a model against the sensor depth of sequences, as a table.

python benchmarks/depth_accuracy.py dinov2 SEQ [SEQ ...] --stride 10
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from slamdepth.datasets import open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.evaluate import judge_depth
from slamdepth.depth.registry import create_depth_model
from slamdepth.types import Frame


def frames(path: Path, stride: int) -> Iterator[Frame]:
    """Every ``stride``-th frame of a sequence, with depth."""
    dataset = open_dataset(path)
    for index in range(0, len(dataset), stride):
        yield dataset.read(index, with_depth=True)


def main() -> None:
    """Judge what the command line names and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--stride", type=int, default=10)
    parser.add_argument("--head", type=Path, help="judge this head file instead of the shipped one")
    arguments = parser.parse_args()
    model: DepthModel
    if arguments.head:
        from slamdepth.depth.model import Dinov2Depth

        model = Dinov2Depth.load(head=arguments.head)
    else:
        model = create_depth_model(arguments.model)
    for info in model.weights:
        print(f"{info.name} {info.sha256[:12]} trained on: {info.trained_on}")
    print("| sequence | frames | AbsRel as predicted | sequence median | frame median | delta1 (frame) "
          "| scale spread | surest half | within 1 sigma |")  # fmt: skip
    print("| --- " * 9 + "|")
    for path in arguments.sequences:
        judged = judge_depth(model, frames(path, arguments.stride))
        a, u = judged.accuracy, judged.uncertainty
        sure = f"{u.surest_half:.2f} | {u.within_one_sigma:.2f}" if u else "- | -"
        print(f"| {path.name} | {a.frames} | {a.metric.abs_rel:.3f} | {a.sequence_median.abs_rel:.3f} "
              f"| {a.frame_median.abs_rel:.3f} | {a.frame_median.delta1:.3f} | {a.frame_scale_spread:.3f} "
              f"| {sure} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
