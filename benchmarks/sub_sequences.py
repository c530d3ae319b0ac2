# SPDX-License-Identifier: Apache-2.0
"""Run slamdepth on sub-sequences of a few recordings and average over them.

    python -m benchmarks.sub_sequences SEQ... --starts 0,50,100 --strides 2,3 --set bundle.prior_inflation=9
    python -m benchmarks.sub_sequences SEQ... --corruption "half hidden by a bar"

Any change of a setting moves the error of one run by up to a third, so one run decides nothing.
Sub-sequences with other first frames or fewer frames have other keyframes; a setting is judged by the means
over all of them. Each frame is predicted once and kept in --cache, in half precision. Frame rates are not
measured, since runs may share the machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console

from benchmarks.command import errors_in_one_line, parser_of
from benchmarks.corruptions import CORRUPTIONS, Corruption
from benchmarks.depth_cache import CachedDepth, DepthCache, default_cache
from benchmarks.markdown import markdown_table
from benchmarks.record import environment, write_benchmark
from benchmarks.robustness import chosen, opened, run
from slamdepth.config import Config, merge
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, DatasetError

_SHORTEST = 20  # frames; the error of fewer says little
_HEADINGS = ("sequence", "from frame", "every", "tracked %", "ATE SE(3) m", "ATE Sim(3) m", "scale",
             "keyframes", "loops")  # fmt: skip


@dataclass(frozen=True)
class SubSequence:
    """Frames ``start``, ``start + stride``, ... of a sequence.

    Attributes:
        settings: nested, as in a settings file.
        corruption: a name in ``CORRUPTIONS``.
    """

    sequence: Path
    start: int
    stride: int
    depth: str
    settings: dict[str, Any]
    cache: Path
    corruption: str

    def config(self) -> Config:
        """The default settings with those of this sub-sequence.

        Raises:
            ConfigError: a setting is unknown or out of range.
        """
        return Config.from_dict(merge({"depth": {"name": self.depth}}, self.settings), origin="--set")

    def _corruption(self) -> Corruption:
        whole = CORRUPTIONS[self.corruption]

        def is_dropped(n: int) -> bool:
            return n < self.start or (n - self.start) % self.stride > 0 or whole.is_dropped(n)

        return replace(whole, is_dropped=is_dropped)

    def figures(self) -> dict[str, Any]:
        """Run it: its row of the file, with the figures or the error."""
        dataset = opened(self.sequence)
        model = create_depth_model(self.depth)
        if self.depth != "sensor":
            cache = self.cache / "with_sigma" / self.corruption.replace(" ", "_")
            model = CachedDepth(model, DepthCache.of(cache, dataset, model))
        try:
            figures = run(dataset, self._corruption(), self.config(), len(dataset), model)
        except DatasetError as error:  # too few poses to score; the other rows go on
            figures = {"error": str(error)}
        return {"sequence": dataset.name, "start": self.start, "stride": self.stride, **figures}


def sub_sequences(asked: argparse.Namespace) -> list[SubSequence]:
    """Each start with stride 1, and the first start with each stride; short ones are left out.

    Raises:
        DatasetError: a folder is no sequence, or has no ground truth.
    """
    found = []
    for path in asked.sequences:
        dataset = opened(path)
        if asked.depth == "sensor" and not dataset.has_depth:
            continue
        wanted = [*((start, 1) for start in asked.starts), *((asked.starts[0], n) for n in asked.strides)]
        found += [
            SubSequence(path, start, stride, asked.depth, asked.settings, asked.cache, asked.corruption)
            for start, stride in dict.fromkeys(wanted)
            if (len(dataset) - start) // stride >= _SHORTEST
        ]
    return found


def means(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Average the scored runs: geometric means of errors, the mean of ``abs(log(scale))``."""
    good = [row for row in rows if "error" not in row]
    if not good:
        return {"runs": 0, "failed": len(rows)}
    return {
        "runs": len(good),
        "failed": len(rows) - len(good),
        "tracked": float(np.mean([row["tracked"] for row in good])),
        "ate_se3_m": float(np.exp(np.mean([np.log(row["ate_se3_m"]) for row in good]))),
        "ate_sim3_m": float(np.exp(np.mean([np.log(row["ate_sim3_m"]) for row in good]))),
        "abs_log_scale": float(np.mean([abs(np.log(row["scale"])) for row in good])),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One row for each run as Markdown; the row of a failed run holds its error."""
    return markdown_table(_HEADINGS, [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    names = [row["sequence"], str(row["start"]), str(row["stride"])]
    if "error" in row:
        return [*names, row["error"]]
    return [
        *names, f"{100 * row['tracked']:.1f}", f"{row['ate_se3_m']:.4f}", f"{row['ate_sim3_m']:.4f}",
        f"{row['scale']:.3f}", str(row["keyframes"]), str(row["loops"]),
    ]  # fmt: skip


def in_words(found: dict[str, Any]) -> str:
    """The result of :func:`means` as one line."""
    if not found["runs"]:
        return f"no run could be scored, {found['failed']} failed"
    failed = f", {found['failed']} failed" if found["failed"] else ""
    return (
        f"{found['runs']} runs{failed}: Sim(3) {found['ate_sim3_m']:.4f} m, "
        f"SE(3) {found['ate_se3_m']:.4f} m, "
        f"scale off by {found['abs_log_scale']:.3f} (log), {100 * found['tracked']:.2f} % tracked"
    )


def _whole_numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",") if part]


def setting(text: str) -> dict[str, Any]:
    """``SECTION.KEY=VALUE`` as nested settings."""
    name, equals, value = text.partition("=")
    section, dot, key = name.partition(".")
    if not (section and dot and key and equals):
        raise argparse.ArgumentTypeError(f"'{text}' is not SECTION.KEY=VALUE")
    return {section: {key: yaml.safe_load(value)}}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("sub_sequences", __doc__)
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ", help="with ground truth")
    parser.add_argument("--starts", type=_whole_numbers, metavar="N,...", default=[0, 30, 60, 100, 200, 400],
                        help="first frames (default: 0,30,60,100,200,400)")  # fmt: skip
    parser.add_argument("--strides", type=_whole_numbers, metavar="N,...", default=[2, 3],
                        help="every Nth frame, from the first start (default: 2,3)")  # fmt: skip
    parser.add_argument("--depth", default="dinov2", help="'sensor' or a depth model (default: dinov2)")
    parser.add_argument("--set", type=setting, action="append", default=[], dest="settings",
                        metavar="SECTION.KEY=VALUE", help="a setting; can be repeated")  # fmt: skip
    parser.add_argument("--corruption", default="as it is", metavar="NAME",
                        help="one of benchmarks.robustness, for every sub-sequence")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at once (default: 1)")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="folder for predictions")
    parser.add_argument("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    asked = parser.parse_args(arguments)
    if not asked.starts or min(asked.starts) < 0:
        parser.error("--starts must be numbers of frames from 0")
    if asked.strides and min(asked.strides) < 1:
        parser.error("--strides must be at least 1")
    if asked.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {asked.jobs}")
    settings: dict[str, Any] = {}
    for one in asked.settings:
        settings = merge(settings, one)
    asked.settings = settings
    asked.cache = asked.cache or default_cache()
    return asked


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    chosen([asked.corruption])
    wanted = sub_sequences(asked)
    if not wanted:
        raise ConfigError(f"no sub-sequence has {_SHORTEST} frames and the depth that was asked for")
    wanted[0].config()  # a wrong setting fails before any work
    settings = {key: getattr(asked, key) for key in ("depth", "corruption", "settings")}
    rows: list[dict[str, Any]] = []
    with (
        ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool,
        Console(stderr=True).status("") as status,
    ):
        for row in pool.map(SubSequence.figures, wanted):
            rows.append(row)
            status.update(f"{len(rows)} of {len(wanted)} runs: {row['sequence']} from {row['start']} done")
            if asked.output:
                write_benchmark(asked.output, begun, settings, rows=rows, means=means(rows))
    print(table(rows))
    print(f"\n{in_words(means(rows))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
