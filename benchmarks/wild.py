# SPDX-License-Identifier: Apache-2.0
"""Run slamdepth with predicted depth on every recording with truth and on those known to be hard.

    python -m benchmarks.wild --data ../shared/data --output wild.json
    python -m benchmarks.wild --only beer_phone --loops off --single-start

Each run is a whole ``slamdepth run`` without a mesh, from frames 0, 10 and 20; the table has the medians.
With --output, finished rows are kept and the same command goes on. The error is that of the largest map
after alignment with scale; of a recording whose truth comes in pieces, that of the worst piece. A run, a
map or a stretch of one is truly good where each piece is off by less than 2 % of its path or, in metres, by
less than 5 cm. Stretches are those of five seconds and more that the report calls good: truly good ones, of
all with true poses.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import slamdepth
from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.excerpt import readable_excerpts, write_excerpt
from benchmarks.jobs import ROOT
from benchmarks.markdown import markdown_table
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.wild_recordings import Recording, find_recordings
from benchmarks.wild_scores import figures
from slamdepth.config import Config
from slamdepth.datasets import open_dataset
from slamdepth.errors import SlamdepthError
from slamdepth.pipeline import RunProgress

STARTS = (0, 10, 20)
_KEYS = ("recording", "start")
_HEADINGS = ("recording", "runs", "frames", "with a pose %", "largest map %", "maps", "Sim(3)", "% of extent",
             "SE(3) m", "scale", "loops", "leaps", "truly good", "verdict", "stretches",
             "wall s")  # fmt: skip


def run_recording(
    recording: Recording, start: int, work: Path, config: Config, progress: Any = None
) -> dict[str, Any]:
    """Run one recording from frame ``start``: its row, with the figures or the error.

    Args:
        work: the run folder is made here.
        progress: called with the :class:`~slamdepth.pipeline.RunProgress`.
    """
    about = {"recording": recording.name, "start": start}
    begun = time.perf_counter()
    try:
        excerpt = write_excerpt(work, recording.sequence, recording.camera_file, start)
        output = work / f"{recording.name}-{start}"
        with readable_excerpts():
            frames = len(open_dataset(excerpt))
            result = slamdepth.run(
                excerpt, output, config=config, mesh=False, overwrite=True, progress=progress
            )
    except SlamdepthError as error:  # no frame could be placed, say; the other rows go on
        return {**about, "error": str(error), "wall_s": time.perf_counter() - begun}
    wall_s = time.perf_counter() - begun
    found = figures(
        result.folder, result.summary, frames, recording.truths, is_metric=recording.is_metric
    )  # fmt: skip
    return {**about, **found, "wall_s": wall_s}


def medians(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The medians of the runs on one recording; leaps are those of the worst run."""
    good = [row for row in rows if "error" not in row]
    found: dict[str, Any] = {
        "recording": rows[0]["recording"],
        "runs": len(good),
        "failed": len(rows) - len(good),
    }
    names = (
        "frames",
        "posed",
        "largest",
        "maps",
        "sim3",
        "sim3_percent",
        "se3_m",
        "scale",
        "loops",
        "wall_s",
    )
    for name in names:
        values = [row[name] for row in good if row[name] is not None]
        found[name] = float(np.median(values)) if values else None
    found["leaps"] = max((row["leaps"] for row in good), default=None)
    judged = [row["is_good"] for row in good if row["is_good"] is not None]
    found["good"] = f"{sum(judged)}/{len(judged)}" if judged else "-"
    spans = [span["is_good"] for row in good for span in row["spans"] if span["is_good"] is not None]
    found["spans"] = f"{sum(spans)}/{len(spans)}" if spans else "-"
    found["verdict"] = ", ".join(dict.fromkeys(row["verdict"] for row in good)) or "-"
    return found


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One row for each recording as Markdown."""
    names = list(dict.fromkeys(row["recording"] for row in rows))
    return markdown_table(
        _HEADINGS, [_cells(medians([row for row in rows if row["recording"] == name])) for name in names]
    )


def verdicts(rows: Sequence[dict[str, Any]]) -> list[str]:
    """For each verdict how many of the runs, of the maps and of the stretches that got it are truly good.

    What has no known truth is not counted.
    """
    done = [row for row in rows if "error" not in row]
    spans = [{**span, "verdict": "good"} for row in done for span in row["spans"]]
    several = [one for row in done if len(row["each_map"]) > 1 for one in row["each_map"]]
    lines = []
    for what, ones in (("runs", done), ("maps of runs in several", several), ("stretches", spans)):
        known = [one for one in ones if one["is_good"] is not None]
        for name in sorted({one["verdict"] for one in known} - {"-"}):
            good = [one["is_good"] for one in known if one["verdict"] == name]
            lines.append(f"verdict '{name}': {sum(good)} of {len(good)} {what} are truly good")
    return lines


def _cells(m: dict[str, Any]) -> list[str]:
    runs = f"{m['runs']}" + (f" ({m['failed']} failed)" if m["failed"] else "")

    def shown(name: str, form: str, factor: float = 1.0) -> str:
        return "-" if m[name] is None else format(factor * m[name], form)

    return [
        m["recording"], runs, shown("frames", ".0f"), shown("posed", ".1f", 100),
        shown("largest", ".1f", 100), shown("maps", ".0f"), shown("sim3", ".4f"),
        shown("sim3_percent", ".1f"), shown("se3_m", ".3f"),
        shown("scale", ".3f"), shown("loops", ".0f"), shown("leaps", ".0f"), m["good"], m["verdict"],
        m["spans"], shown("wall_s", ".0f"),
    ]  # fmt: skip


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("wild", __doc__)
    add = parser.add_argument
    default = Path(os.environ.get("SLAMDEPTH_DATA", ROOT.parent / "shared" / "data"))
    add("--data", type=Path, default=default, metavar="DIR", help="the recordings (default: $SLAMDEPTH_DATA)")
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="these recordings, with commas")
    add("--also", type=Path, action="append", default=[], metavar="SEQ",
        help="a further sequence with ground truth, such as a rendered room; can be repeated")  # fmt: skip
    add("--single-start", action="store_true", help="from frame 0 only")
    add("--loops", choices=("on", "off"), default="on", help="close loops (default: on)")
    add("--single-map", action="store_true", help="start no new map where the camera stays lost")
    add("--depth", default="dinov2", metavar="NAME", help="depth model (default: dinov2)")
    add("--work", type=Path, metavar="DIR", help="keep the run folders here (default: temporary)")
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    config = Config.from_dict(
        {
            "depth": {"name": asked.depth},
            "loops": {"enabled": asked.loops == "on"},
            "tracking": {"new_maps": not asked.single_map},
        }
    )
    about = {"depth": asked.depth, "loops": asked.loops, "single_map": asked.single_map}
    recordings = find_recordings(asked.data, asked.also, asked.only)
    starts = STARTS[:1] if asked.single_start else STARTS
    file = RowFile(asked.output, begun, about, _KEYS)
    wanted = [(recording, start) for recording in recordings for start in starts]
    rows = []
    with tempfile.TemporaryDirectory(prefix="wild-") as temporary, _bar() as bar:
        work = asked.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        task = bar.add_task("", total=len(wanted), state="")
        for recording, start in wanted:
            bar.update(task, description=f"{recording.name} from {start}", state="")
            row = file.find(recording=recording.name, start=start)
            if row is None:

                def show(state: RunProgress) -> None:
                    bar.update(task, state=f"{state.stage.value} {state.done}/{state.total}")

                row = run_recording(recording, start, work, config, show)
                file.add(row)
                if bar.disable:
                    progress_line(f"{recording.name} from {start} done")
            rows.append(row)
            bar.advance(task)
    print(table(rows))
    print("".join(f"\n{line}" for line in verdicts(rows)))
    for row in rows:
        for text in [row["error"]] if "error" in row else row["unscored"]:
            print(f"{row['recording']} from {row['start']}: {text}")
    return 0


def _bar() -> Progress:
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(),
        TextColumn("{task.fields[state]}", markup=False), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
