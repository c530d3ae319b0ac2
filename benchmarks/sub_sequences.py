# SPDX-License-Identifier: Apache-2.0
"""Many runs from few recordings: sequences begun later and with fewer frames, and what they have in common.

python -m benchmarks.sub_sequences SEQ... --starts 0,50,100 --strides 2,3 --set bundle.prior_inflation=9
python -m benchmarks.sub_sequences SEQ... --disturbance "half hidden by a bar"

One run of one sequence moves by a third when anything changes, so it decides nothing. Each cutting has
other keyframes; the means over all are what a setting is judged by. Predictions are made once a frame and
kept in --cache, in half precision. Rates are not told: runs may share the machine.
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

from benchmarks.command import errors_in_one_line
from benchmarks.corruptions import DISTURBANCES, Disturbance
from benchmarks.depth_cache import DepthCache, default_cache
from benchmarks.markdown import markdown_table
from benchmarks.remembered_depth import RememberedDepth
from benchmarks.robustness import chosen, opened, run
from benchmarks.summary import environment
from slamdepth.config import Config, merge
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.io import write_json

FORMAT = 1
_SHORTEST = 20  # frames of a cutting: fewer say little
_HEADINGS = ("sequence", "from frame", "every", "tracked %", "ATE SE(3) m", "ATE Sim(3) m", "scale",
             "keyframes", "loops")  # fmt: skip


@dataclass(frozen=True)
class Cutting:
    """Frames ``start``, ``start + stride``, ... of a sequence.

    Attributes:
        settings: nested, as of a settings file.
        disturbance: what is done to the frames, by its name in ``DISTURBANCES``.
    """

    sequence: Path
    start: int
    stride: int
    depth: str
    settings: dict[str, Any]
    cache: Path
    disturbance: str

    def config(self) -> Config:
        """Errors as of ``Config.from_dict``."""
        return Config.from_dict(merge({"depth": {"name": self.depth}}, self.settings), origin="--set")

    def _played(self) -> Disturbance:
        whole = DISTURBANCES[self.disturbance]

        def is_dropped(n: int) -> bool:
            return n < self.start or (n - self.start) % self.stride > 0 or whole.is_dropped(n)

        return replace(whole, is_dropped=is_dropped)

    def figures(self) -> dict[str, Any]:
        """Its row of the file: a run's figures, or why there are none."""
        dataset = opened(self.sequence)
        model = create_depth_model(self.depth)
        if self.depth != "sensor":
            cache = self.cache / "with_sigma" / self.disturbance.replace(" ", "_")
            model = RememberedDepth(model, DepthCache.of(cache, dataset, model))
        try:
            figures = run(dataset, self._played(), self.config(), len(dataset), model)
        except DatasetError as error:  # too few poses to score; the other rows go on
            figures = {"error": str(error)}
        return {"sequence": dataset.name, "start": self.start, "stride": self.stride, **figures}


def cuttings(asked: argparse.Namespace) -> list[Cutting]:
    """Each start with every frame, and the first start with fewer; those too short are left out.

    Raises:
        DatasetError: a sequence is none, or has no ground truth.
    """
    found = []
    for path in asked.sequences:
        dataset = opened(path)
        if asked.depth == "sensor" and not dataset.has_depth:
            continue
        wanted = [*((start, 1) for start in asked.starts), *((asked.starts[0], n) for n in asked.strides)]
        found += [
            Cutting(path, start, stride, asked.depth, asked.settings, asked.cache, asked.disturbance)
            for start, stride in dict.fromkeys(wanted)
            if (len(dataset) - start) // stride >= _SHORTEST
        ]
    return found


def means(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Over the runs that were scored: geometric means of errors, mean size of the scale's logarithm."""
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
    """A row a run; a failed one says why."""
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
    """One line of :func:`means`."""
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


def _setting(text: str) -> dict[str, Any]:
    name, equals, value = text.partition("=")
    section, dot, key = name.partition(".")
    if not (section and dot and key and equals):
        raise argparse.ArgumentTypeError(f"'{text}' is not SECTION.KEY=VALUE")
    return {section: {key: yaml.safe_load(value)}}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sub_sequences",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ", help="with ground truth")
    parser.add_argument("--starts", type=_whole_numbers, metavar="N,...", default=[0, 30, 60, 100, 200, 400],
                        help="first frames (default: 0,30,60,100,200,400)")  # fmt: skip
    parser.add_argument("--strides", type=_whole_numbers, metavar="N,...", default=[2, 3],
                        help="every Nth frame, from the first start (default: 2,3)")  # fmt: skip
    parser.add_argument("--depth", default="dinov2", help="'sensor' or a depth model (default: dinov2)")
    parser.add_argument("--set", type=_setting, action="append", default=[], dest="settings",
                        metavar="SECTION.KEY=VALUE", help="a setting; can be repeated")  # fmt: skip
    parser.add_argument("--disturbance", default="as it is", metavar="NAME",
                        help="of benchmarks.robustness, done to every cutting")  # fmt: skip
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
    chosen(asked.disturbance)
    wanted = cuttings(asked)
    if not wanted:
        raise ConfigError(f"no cutting has {_SHORTEST} frames and the depth that was asked for")
    wanted[0].config()  # a wrong setting is told before any work
    rows: list[dict[str, Any]] = []
    with (
        ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool,
        Console(stderr=True).status("") as status,
    ):
        for row in pool.map(Cutting.figures, wanted):
            rows.append(row)
            status.update(f"{len(rows)} of {len(wanted)} runs: {row['sequence']} from {row['start']} done")
            if asked.output:
                write_json(asked.output, {"format": FORMAT, "environment": begun, "depth": asked.depth,
                                          "disturbance": asked.disturbance,
                                          "settings": asked.settings, "rows": rows,
                                          "means": means(rows)})  # fmt: skip
    print(table(rows))
    print(f"\n{in_words(means(rows))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
