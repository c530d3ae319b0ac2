# SPDX-License-Identifier: Apache-2.0
"""Loop closing judged by true poses: loops closed, false and missed, and the error with and without.

    python -m benchmarks.loops --seeds 0,1,2 --output loops.json
    python -m benchmarks.loops --seeds "" --data ../shared/data --depth dinov2

Rooms of identical workstations are rendered into --work. Each sequence is run with loops on and off. A
closed loop is false where the motion it says differs from the true one by more than 0.3 m or 10 degrees, or
where its two images share no surface. A revisit of an earlier place is found "by loop" where a true loop was
closed in it, or else by tracking, where half of its keyframes share landmarks with that place. "linked"
is the share of all keyframes of revisits that do. The error is that of SE(3) with a sensor's depth and of
Sim(3) else. With --inject 0.3, 30 % of the keyframes that look for loops find one with a place they do not
see. With --output, finished rows are kept and the same command goes on.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.depth_cache import default_cache
from benchmarks.loops_closed import closed_loops, covisibility, taken_back
from benchmarks.loops_injected import inject_false_loops
from benchmarks.loops_truth import judge_loops, true_keyframes
from benchmarks.markdown import markdown_table
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.seeded import seeded_depth_model
from benchmarks.wild_recordings import Recording, find_recordings, sequence_of
from benchmarks.wild_scores import score_piece
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import InputError, SlamdepthError
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.synth.sequence import SynthSettings, render_sequence
from slamdepth.tracking import Tracker
from slamdepth.typing import Floats32

_KEYS = ("sequence", "depth", "start", "loops", "inject")
_HEADINGS = (
    "sequence", "depth", "from", "tracked %", "keyframes", "closed", "true", "false", "refused", "taken back",
    "injected", "revisits", "by loop", "found", "linked %", "error on", "error off", "on/off",
)  # fmt: skip


def aliased_rooms(seeds: Sequence[int], frames: int, width: int, height: int, work: Path) -> list[Recording]:
    """Render the rooms that are not there yet; an interrupted one is continued.

    Raises:
        OutputError: ``work`` cannot be written.
    """
    rooms = []
    for seed in seeds:
        folder = work / f"aliased-{seed}-{width}x{height}-{frames}"
        if not (folder / "groundtruth.txt").is_file():
            progress_line(f"rendering {folder.name}")
        settings = SynthSettings.from_dict(
            {"scene": "aliased", "seed": seed, "frames": frames, "width": width, "height": height}
        )
        room = sequence_of(render_sequence(folder, settings))
        assert room is not None
        rooms.append(room)
    return rooms


def run(
    recording: Recording, depth: str, start: int, *, with_loops: bool, injected: float = 0.0
) -> dict[str, Any]:
    """Track one sequence from frame ``start`` and judge its loops: the figures, or the error.

    Args:
        injected: share of the loop decisions that are about a false place.
    """
    dataset = open_dataset(recording.sequence, recording.camera_file)
    config = Config.from_dict({"depth": {"name": depth}, "loops": {"enabled": with_loops}})
    begun = time.perf_counter()
    model = seeded_depth_model(depth, config)
    frames = range(start, len(dataset))
    try:
        with Tracker(dataset.camera, model, config) as tracker:
            false_loops = inject_false_loops(tracker, injected, start) if injected else None
            for index in frames:
                tracker.step(dataset.read(index, with_depth=depth == "sensor"))
            found = tracker.finish()
    except SlamdepthError as error:  # no frame could be placed; the other rows go on
        return {"error": str(error)}
    wall_s = time.perf_counter() - begun
    pieces = [score_piece(t, found.trajectory, is_metric=recording.is_metric) for t in recording.truths]
    name = "se3_m" if depth == "sensor" else "sim3"
    errors = [piece[name] for piece in pieces if "error" not in piece]
    truth = true_keyframes(
        np.array([keyframe.frame.timestamp_s for keyframe in found.keyframes]),
        np.stack([keyframe.T_world_camera for keyframe in found.keyframes]),
        recording.truths,
        dataset.camera,
        _depths(dataset, found),
        is_metric=recording.is_metric,
        depth_is_true=dataset.has_depth,
    )
    ids = [keyframe.id for keyframe in found.keyframes]
    closed, shared = closed_loops(tracker, ids), covisibility(tracker, ids)
    judged = judge_loops(closed, truth, shared, config.loops.min_gap)
    return {
        "frames": len(frames),
        "tracked": len(found.trajectory) / len(frames),
        "keyframes": len(found.keyframes),
        "loop_closures": found.statistics.loop_closures,
        **judged,
        "refused": found.statistics.loops_refused,
        "taken_back": taken_back(tracker),
        "injected": len(false_loops.pairs) if false_loops else 0,
        "ate": max(errors, default=None),
        "wall_s": wall_s,
    }


def _depths(dataset: Dataset, found: Reconstruction) -> list[Floats32]:
    """Depth of each keyframe: the sensor's in metres, else the map's."""
    if not dataset.has_depth:
        return [keyframe.load_depth_m() for keyframe in found.keyframes]
    unknown = np.zeros((dataset.camera.height, dataset.camera.width), np.float32)
    read = [dataset.read(keyframe.frame.index, with_depth=True).depth_m for keyframe in found.keyframes]
    return [unknown if depth_m is None else depth_m for depth_m in read]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One row for each sequence, depth and start as Markdown; the last one has the sums."""
    with_loops = [row for row in rows if row["loops"] == "on"]
    cells = [_cells(on, _without(rows, on)) for on in with_loops]
    good = [row for row in with_loops if "error" not in row]
    names = (
        "closed",
        "true",
        "false",
        "refused",
        "taken_back",
        "injected",
        "revisits",
        "by_loop",
        "found",
        "linked",
        "seen_again",
    )
    total = {name: sum(row[name] for row in good) for name in names}
    counts = [str(total[name]) for name in names[:9]]
    ratios = [ratio for on in good if (ratio := _ratio(on, _without(rows, on))) is not None]
    worst = f"{max(ratios):.2f} at most" if ratios else "-"
    cells.append(
        ["all", "", "", "", "", *counts, _percent(total["linked"], total["seen_again"]), "", "", worst]
    )
    return markdown_table(_HEADINGS, cells)


def _without(rows: Sequence[dict[str, Any]], on: dict[str, Any]) -> dict[str, Any]:
    key = {**{name: on[name] for name in _KEYS}, "loops": "off"}
    return next((row for row in rows if all(row[name] == key[name] for name in _KEYS)), {})


def _ratio(on: dict[str, Any], off: dict[str, Any]) -> float | None:
    return on["ate"] / off["ate"] if on.get("ate") and off.get("ate") else None


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.0f}" if whole else "-"


def _cells(on: dict[str, Any], off: dict[str, Any]) -> list[str]:
    names = [on["sequence"], on["depth"], str(on["start"])]
    if "error" in on:
        return [*names, on["error"]]
    errors = ["-" if row.get("ate") is None else f"{row['ate']:.4f}" for row in (on, off)]
    ratio = _ratio(on, off)
    return [
        *names, f"{100 * on['tracked']:.1f}", str(on["keyframes"]), str(on["closed"]), str(on["true"]),
        str(on["false"]), str(on["refused"]), str(on["taken_back"]),
        str(on["injected"]), str(on["revisits"]), str(on["by_loop"]), str(on["found"]),
        _percent(on["linked"], on["seen_again"]), *errors, "-" if ratio is None else f"{ratio:.2f}",
    ]  # fmt: skip


def whole_numbers(text: str) -> list[int]:
    """Numbers with commas between them."""
    return [int(part) for part in comma_separated(text)]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("loops", __doc__)
    add = parser.add_argument
    add("sequences", nargs="*", type=Path, metavar="SEQ", help="further sequences with ground truth")
    add("--seeds", type=whole_numbers, default=list(range(10)), metavar="N,...",
        help="aliased rooms of these seeds (default: 0 to 9)")  # fmt: skip
    add("--frames", type=int, default=600, metavar="N", help="of a room (default: 600)")
    add("--width", type=int, default=320, metavar="PX", help="of a room's images (default: 320)")
    add("--height", type=int, default=240, metavar="PX", help="of a room's images (default: 240)")
    add("--data", type=Path, metavar="DIR", help="all recordings with true poses in this folder, too")
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="of --data, with commas")
    add("--depth", type=comma_separated, default=["sensor", "dinov2"], metavar="NAMES",
        help="with commas (default: sensor,dinov2)")  # fmt: skip
    add("--starts", type=whole_numbers, default=[0], metavar="N,...", help="first frames (default: 0)")
    add("--work", type=Path, default=default_cache(), metavar="DIR", help="folder of the rendered rooms")
    add("--inject", type=float, default=0.0, metavar="SHARE",
        help="share of the loop decisions that are about a false place (default: 0)")  # fmt: skip
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    recordings = aliased_rooms(asked.seeds, asked.frames, asked.width, asked.height, asked.work)
    if asked.data:
        recordings += [one for one in find_recordings(asked.data, only=asked.only) if one.truths]
    recordings += find_recordings(None, asked.sequences) if asked.sequences else []
    if not recordings:
        raise InputError("nothing to run: name seeds, sequences or --data")
    file = RowFile(asked.output, begun, {}, _KEYS)
    rows = []
    for recording in recordings:
        has_depth = open_dataset(recording.sequence, recording.camera_file).has_depth
        for depth in asked.depth:
            if depth == "sensor" and not has_depth:
                continue
            for start in asked.starts:
                for loops in ("on", "off"):
                    key = {"sequence": recording.name, "depth": depth, "start": start, "loops": loops,
                           "inject": asked.inject}  # fmt: skip
                    row = file.find(**key)
                    if row is None:
                        row = {
                            **key,
                            **run(recording, depth, start, with_loops=loops == "on", injected=asked.inject),
                        }
                        file.add(row)
                        progress_line(f"{recording.name} [{depth}] from {start}, loops {loops}: done")
                    rows.append(row)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
