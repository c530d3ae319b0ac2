# SPDX-License-Identifier: Apache-2.0
"""The covariance and quality of each pose, judged by true poses.

    python -m benchmarks.poses --data ../shared/data --only rgbd_dataset_freiburg1_rpy,euroc
    python -m benchmarks.poses --also room --depth sensor,dinov2

Runs the tracker and takes the poses it gives frame by frame. Judged are motions from a frame to the next,
over a third of a second, and over a second: the squared error over the covariance of both poses, divided by
six (1 where the covariance is right, less where it is too cautious), its median over that of chi-square, and
the shares within 1, 2 and 3 sigma (68, 95, 99.7 %). A covariance is of the pose relative to the map around
it, so it has to hold for a second; shorter motions are better than it says, since neighbouring frames share
errors. The truth of --also is taken as exact; that of --data has 5 ms, 1 mm and 0.1 degrees of error.

A pose is called good where its quality is above 0.5. It is truly bad where neither the motion over the second
before it nor that over the second after it is within 2 % of the scene's distance and 2 degrees.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.markdown import markdown_table
from benchmarks.poses_scores import EXACT, MOTION_CAPTURE, Poses, TruthError, figures
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.seeded import seeded_depth_model
from benchmarks.wild_recordings import Recording, find_recordings
from slamdepth.config import Config
from slamdepth.datasets import open_dataset
from slamdepth.errors import InputError, SlamdepthError
from slamdepth.evaluation.leaps import scene_distance
from slamdepth.tracking import Tracker

_KEYS = ("sequence", "depth", "start", "stride")
_SPAN_HEADINGS = ("sequence", "depth", "over s", "motions", "error, % of distance", "error, deg",
                  "NEES/6", "median", "1 sigma", "2 sigma", "3 sigma")  # fmt: skip
_HEADINGS = ("sequence", "depth", "poses", "good", "of these bad", "not good", "of these bad", "ms")


def run(recording: Recording, depth: str, start: int, stride: int, truth_error: TruthError) -> dict[str, Any]:
    """Track one sequence and judge its poses: the figures, or the error."""
    dataset = open_dataset(recording.sequence, recording.camera_file)
    config = Config.from_dict({"depth": {"name": depth}})
    model = seeded_depth_model(depth, config)
    steps = []
    try:
        with Tracker(dataset.camera, model, config) as tracker:
            for index in range(start, len(dataset), stride):
                steps.append(tracker.step(dataset.read(index, with_depth=depth == "sensor")))
            found = tracker.finish()
    except SlamdepthError as error:  # no frame could be placed; the other rows go on
        return {"error": str(error)}
    distance = scene_distance(found.trajectory, found.points_m)
    if distance is None:
        return {"error": "no camera has ten landmarks in front of it"}
    pieces = [Poses.of(steps, truth) for truth in recording.truths]
    judged = [figures(poses, distance, truth_error) for poses in pieces if len(poses) > 1]
    return {
        "tracked": len(found.trajectory) / len(steps),
        "ms": found.statistics.timings_ms.get("uncertainty"),
        "pieces": judged,
    }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """The normalised errors, and the poses called good, as two Markdown tables."""
    spans, called = [], []
    for row in rows:
        name = [row["sequence"] + _excerpt(row), row["depth"]]
        if "error" in row:
            called.append([*name, row["error"]])
            continue
        for piece in row["pieces"]:
            spans += [[*name, *_span_cells(span)] for span in piece["spans"]]
        total = {key: sum(piece[key] for piece in row["pieces"]) for key in _COUNTS}
        called.append([*name, *_count_cells(total), "-" if row["ms"] is None else f"{row['ms']:.2f}"])
    every = [piece for row in rows for piece in row.get("pieces", [])]
    called.append(["all", "", *_count_cells({key: sum(piece[key] for piece in every) for key in _COUNTS})])
    return markdown_table(_SPAN_HEADINGS, spans) + "\n\n" + markdown_table(_HEADINGS, called)


_COUNTS = ("poses", "good", "good_bad", "poor", "poor_bad")


def _excerpt(row: dict[str, Any]) -> str:
    start = f" from {row['start']}" if row["start"] else ""
    return start + (f" every {row['stride']}" if row["stride"] > 1 else "")


def _span_cells(span: dict[str, Any]) -> list[str]:
    over = f"{span['span_s']:.2f}" if span["span_s"] else "1 frame"
    return [
        over, str(span["motions"]), f"{100 * span['share']:.2f}", f"{span['deg']:.2f}", f"{span['mean']:.2f}",
        f"{span['median']:.2f}", *(f"{100 * share:.0f}" for share in span["within"]),
    ]  # fmt: skip


def _count_cells(total: dict[str, int]) -> list[str]:
    def share(part: str, whole: str) -> str:
        return f"{total[part]} ({100 * total[part] / total[whole]:.1f} %)" if total[whole] else "-"

    return [
        str(total["poses"]), str(total["good"]), share("good_bad", "good"), str(total["poor"]),
        share("poor_bad", "poor"),
    ]  # fmt: skip


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("poses", __doc__)
    add = parser.add_argument
    add("--data", type=Path, metavar="DIR", help="all recordings with true poses in this folder")
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="of --data, with commas")
    add(
        "--also",
        type=Path,
        nargs="*",
        default=[],
        metavar="SEQ",
        help="rendered sequences, whose truth is exact",
    )
    add("--depth", type=comma_separated, default=["sensor", "dinov2"], metavar="NAMES",
        help="with commas (default: sensor,dinov2)")  # fmt: skip
    add("--start", type=int, default=0, metavar="N", help="first frame (default: 0)")
    add("--stride", type=int, default=1, metavar="N", help="every N-th frame (default: 1)")
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    found: list[tuple[Recording, TruthError]] = []
    if asked.data:
        found += [(one, MOTION_CAPTURE) for one in find_recordings(asked.data, only=asked.only) if one.truths]
    if asked.also:
        found += [(one, EXACT) for one in find_recordings(None, asked.also)]
    if not found:
        raise InputError("nothing to run: name --data or --also")
    file = RowFile(asked.output, begun, {}, _KEYS)
    rows = []
    for recording, truth_error in found:
        has_depth = open_dataset(recording.sequence, recording.camera_file).has_depth
        for depth in asked.depth:
            if depth == "sensor" and not has_depth:
                continue
            key = {"sequence": recording.name, "depth": depth, "start": asked.start, "stride": asked.stride}
            row = file.find(**key)
            if row is None:
                row = {**key, **run(recording, depth, asked.start, asked.stride, truth_error)}
                file.add(row)
                progress_line(f"{recording.name} [{depth}]: done")
            rows.append(row)
    print(tables(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
