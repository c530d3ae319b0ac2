# SPDX-License-Identifier: Apache-2.0
"""Compare SLAM systems on one machine, with the same frames and the same predicted depth.

    python -m benchmarks.slam --data DIR --runs 5 --output slam.json
    python -m benchmarks.slam --data DIR --ablation --pace fast --output ablation.json

Every run is a process of its own. See ``docs/benchmarks.md`` for the columns of the table.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.depth_cache import default_cache
from benchmarks.jobs import Job, run_job
from benchmarks.orbslam3 import HOW_TO_INSTALL
from benchmarks.record import environment, read_benchmark, write_benchmark
from benchmarks.rows import ABLATIONS, NONE, SENSOR, SYSTEMS, Row, config_of, plan_ablation, plan_rows
from benchmarks.summary import summarise
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import CameraError, ConfigError, DatasetError
from slamdepth.frontend.features import create_extractor, needs_weights
from slamdepth.io import write_text

_BUSY = 0.5


@dataclass(frozen=True)
class Plan:
    """Everything a benchmark was asked for."""

    sequences: dict[str, Dataset]
    rows: list[Row]
    runs: int
    base: Job
    cache: Path
    vocabulary: Path | None
    training_images: list[Path]
    timeout_s: float


def find_sequences(data: Path, names: Sequence[str] | None) -> dict[str, Dataset]:
    """The named sequences below ``data``, or every folder there that is one.

    Raises:
        DatasetError: a named one cannot be opened, or there is none.
    """
    if names:
        return {name: open_dataset(data / name) for name in names}
    if not data.is_dir():
        raise DatasetError(f"{data}: no such folder; --data names the folder that holds the sequences")
    found = {}
    for folder in sorted(path for path in data.iterdir() if path.is_dir()):
        try:
            found[folder.name] = open_dataset(folder)
        except (DatasetError, CameraError):
            continue
    if not found:
        raise DatasetError(f"{data}: holds no sequence; --data names the folder that holds the sequences")
    return found


def run_plan(plan: Plan) -> Iterator[dict[str, Any]]:
    """Run everything, one process after another; yields the entries of the table."""
    vocabulary: Path | None = None
    for name, dataset in plan.sequences.items():
        folders: dict[str, dict[str, Any]] = {}
        for row in plan.rows:
            trouble: dict[str, Any] | None = None
            job = replace(plan.base, sequence=str(dataset.path.resolve()), row=row)
            if row.needs_sensor and not dataset.has_depth:
                trouble = {"status": "left out", "message": "the sequence has no sensor depth"}
            elif row.system == "orbslam3":
                trouble, vocabulary = _prepare_orbslam3(plan, vocabulary)
                job = replace(job, vocabulary=str(vocabulary))
            if trouble is None and row.needs_predictions:
                if row.depth not in folders:
                    progress_line(f"{name}: predicting depth with {row.depth} for the peers")
                    folders[row.depth] = run_job(replace(job, kind="predict", cache=str(plan.cache)))
                predicted = folders[row.depth]
                trouble = None if predicted["status"] == "ok" else predicted
                job = replace(job, depth_folder=predicted.get("folder"))
            if trouble is not None:
                yield summarise(name, row, [trouble])
                continue
            results = []
            for number in range(plan.runs):
                progress_line(f"{name}: {row.label} [{row.depth}], run {number + 1} of {plan.runs}")
                results.append(run_job(job, timeout_s=plan.timeout_s))
                if results[-1]["status"] == "not installed":
                    break
            yield summarise(name, row, results)


def _prepare_orbslam3(plan: Plan, vocabulary: Path | None) -> tuple[dict[str, Any] | None, Path | None]:
    """What keeps ORB-SLAM3 from running, if anything does, and its vocabulary, trained once."""
    from importlib.util import find_spec

    if find_spec("pyorbslam3") is None:
        return {"status": "not installed", "message": HOW_TO_INSTALL}, None
    vocabulary = vocabulary or plan.vocabulary
    if vocabulary is None:
        from benchmarks.orb_vocabulary import train_vocabulary_file

        names = "\n".join(f"{path} {path.stat().st_size}" for path in plan.training_images)
        digest = hashlib.sha256(names.encode()).hexdigest()[:12]
        vocabulary = plan.cache / f"orb-vocabulary-{digest}.txt"
        if not vocabulary.is_file():
            progress_line(f"training an ORB vocabulary on {len(plan.training_images)} colour images")
            train_vocabulary_file(plan.training_images, vocabulary)
    return None, vocabulary


def training_images(data: Path, sequences: Iterable[Dataset]) -> list[Path]:
    """Images of ``data/depth_training/*/``, or where there are none every tenth of the sequences."""
    found = sorted((data / "depth_training").glob("*/*.jpg"))
    if found:
        return found
    for dataset in sequences:
        images = sorted(p for p in dataset.path.rglob("*") if p.suffix.lower() in (".jpg", ".png"))
        found += [path for path in images if "depth" not in path.relative_to(dataset.path).as_posix()][::10]
    return found


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("slam", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder that holds the sequences")
    add("--sequences", type=comma_separated, help="their names, with commas (default: all in --data)")
    add("--systems", type=comma_separated, default=list(SYSTEMS), metavar="NAMES",
        help=f"with commas, of: {', '.join(SYSTEMS)}")  # fmt: skip
    add("--depth", type=comma_separated, default=[SENSOR, "dinov2"], metavar="NAMES",
        help="'sensor' and names of depth models")  # fmt: skip
    add("--features", type=comma_separated, default=[], metavar="NAMES",
        help="features slamdepth is run with, with commas: orb,sift")  # fmt: skip
    add("--features-weights", type=Path, help="ONNX file of those that are a network: aliked")
    add("--features-matcher", type=Path, help="LightGlue's ONNX file for it")
    add("--runs", type=int, default=1, help="runs of each row; the table holds medians")
    add("--ablation", action="store_true", help="run slamdepth with one part changed at a time instead")
    add("--pace", choices=("sequence", "fast"), default="sequence",
        help="give each frame at its time, or as fast as it is taken")  # fmt: skip
    add("--max-frames", type=int)
    add("--stride", type=int, default=1)
    add("--output", type=Path, help=".json to write; tables (.md) and plot (.svg) get the same name")
    add("--compare", type=Path, help=".json of an earlier benchmark: print what changed")
    add("--vocabulary", type=Path, help="ORB-SLAM3's, DBoW2 text (default: trained here)")
    add("--cache", type=Path, help="folder for predictions and vocabulary")
    add("--timeout", type=float, default=1800.0, help="seconds after which a run is stopped")
    return parser.parse_args(arguments)


def make_plan(options: argparse.Namespace) -> Plan:
    """Check everything that can be checked before hours are spent.

    Raises:
        InputError: a sequence, a system, a depth or a feature does not exist.
    """
    from slamdepth.depth.registry import depth_model_names, is_depth_model_name

    for depth in options.depth:
        if not is_depth_model_name(depth):
            raise ConfigError(
                f"--depth: no depth is called '{depth}'; known: {', '.join(depth_model_names())}"
            )
    if options.runs < 1:
        raise ConfigError(f"--runs: at least 1, got {options.runs}")
    if options.ablation:
        if options.features:
            raise ConfigError("--features: not together with --ablation, which has rows of its own")
        rows = plan_ablation(options.depth)
    else:
        rows = plan_rows(options.systems, options.depth, _features(options))
    for row in rows:
        if row.is_ours:
            create_extractor(config_of(row).features)
    if options.vocabulary and not options.vocabulary.is_file():
        raise ConfigError(f"{options.vocabulary}: no such vocabulary file")
    sequences = find_sequences(options.data, options.sequences)
    base = Job("", Row("", "", NONE), pace=options.pace, stride=options.stride, max_frames=options.max_frames)
    base.indices(1)
    return Plan(
        sequences,
        rows,
        options.runs,
        base,
        (options.cache or default_cache()).resolve(),
        options.vocabulary and options.vocabulary.resolve(),
        training_images(options.data, sequences.values()),
        options.timeout,
    )


def _features(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Settings of each feature asked for, with the files for those that are networks."""
    files = {"weights": options.features_weights, "matcher": options.features_matcher}
    given = {key: str(path.resolve()) for key, path in files.items() if path is not None}
    return [{"name": name, **(given if needs_weights(name) else {})} for name in options.features]


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parse(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    earlier = read_benchmark(options.compare) if options.compare else None
    plan = make_plan(options)
    begun = environment()
    if begun["load_average"] is not None and begun["load_average"] > _BUSY:
        progress_line(f"the machine is busy (load {begun['load_average']:.1f}): speeds will suffer")
    rows: list[dict[str, Any]] = []
    settings = {
        "runs": plan.runs,
        "pace": plan.base.pace,
        "stride": plan.base.stride,
        "max_frames": plan.base.max_frames,
        "vocabulary": "given" if plan.vocabulary else "trained",
        "ablations": ABLATIONS if options.ablation else {},
    }
    code = 0
    try:
        for row in run_plan(plan):
            rows.append(row)
            if options.output:
                write_benchmark(options.output, begun, settings, rows=rows)
    except KeyboardInterrupt:
        progress_line("interrupted; the table holds what was done")
        code = 130
    _publish({"environment": begun, "settings": settings, "rows": rows}, earlier, options.output)
    return code


def _publish(benchmark: dict[str, Any], earlier: dict[str, Any] | None, output: Path | None) -> None:
    """Print the tables; next to the file go the tables as Markdown and the plot."""
    from rich.console import Console

    from benchmarks import tables
    from benchmarks.plot import write_plot

    console = Console()
    if not console.is_terminal:
        console = Console(width=200)
    if output and benchmark["rows"]:
        write_text(output.with_suffix(".md"), tables.markdown(benchmark))
        write_plot(output.with_suffix(".svg"), benchmark)
    for table in tables.rich_tables(benchmark):
        console.print(table)
    if earlier:
        console.print(tables.comparison_table(earlier, benchmark))


if __name__ == "__main__":
    sys.exit(main())
