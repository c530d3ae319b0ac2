# SPDX-License-Identifier: Apache-2.0
"""Recordings that leave a place and come back: which frames are placed, and which maps are joined.

    python -m benchmarks.maps --data ../shared/data --output maps.json
    python -m benchmarks.maps --seeds 0,1 --depth sensor

Each recording is spliced from pieces of sequences, with darkness between them. "elsewhere" goes from a desk
(freiburg1_desk) to a kitchen (7-Scenes) and back by a cut: nothing ties the two. "back" leaves a rendered
room in the dark and comes back from its other end, so that two maps meet. "aliased" does so in halls of
identical desks, where places that look alike must not join two maps. "gaps" gets dark seven times in such a
hall and is elsewhere each time; at the desk, in the kitchen and in the room it comes back to where it was.

A join is wrong where the joined map is off by more than 2 % of the path and 5 cm. A frame that was lost is
found again wrongly where the motion from the last frame before in its map differs from the true one by more
than 0.3 m or 10 degrees. "visible" are the frames that are not dark. Errors are Sim(3).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.depth_cache import default_cache
from benchmarks.jobs import ROOT
from benchmarks.loops import aliased_rooms, whole_numbers
from benchmarks.loops_truth import FALSE_DEG, FALSE_M
from benchmarks.markdown import markdown_table
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.seeded import seeded_depth_model
from benchmarks.wild_scores import score_piece
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.geometry import invert, rotation_angle_rad
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.synth.sequence import SynthSettings, render_sequence
from slamdepth.tracking import Tracker
from slamdepth.types import Frame, StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Floats

DARK_FRAMES = 60
_DESK, _KITCHEN = "rgbd_dataset_freiburg1_desk", "7scenes_redkitchen_seq-01"
_FOUND = (TrackingStatus.RELOCALISED, TrackingStatus.REGISTERED)
_KEYS = ("recording", "depth", "single_map")
_HEADINGS = ("recording", "depth", "frames", "visible", "placed %", "largest map %", "maps", "joined",
             "wrong joins", "found again", "wrongly", "largest map, % of path",
             "error of each map, m")  # fmt: skip


@dataclass(frozen=True)
class Piece:
    """Frames ``indices`` of a sequence; dark ones where it is None."""

    dataset: Dataset | None
    indices: Sequence[int]


@dataclass(frozen=True)
class Splice:
    """Pieces one after another, at the pace and with the camera of the first one."""

    name: str
    pieces: tuple[Piece, ...]

    @property
    def first(self) -> Dataset:
        """The sequence of the first piece."""
        first = self.pieces[0].dataset
        assert first is not None
        return first

    def frames(self, *, with_depth: bool) -> Iterator[tuple[Frame, Dataset | None, float]]:
        """Each frame, with the sequence it is of and its time there."""
        camera = self.first.camera
        blank = self.first.read(0)
        count = 0
        for piece in self.pieces:
            for index in piece.indices:
                if piece.dataset is None:
                    frame = replace(blank, image_rgb=np.zeros_like(blank.image_rgb))
                else:
                    frame = piece.dataset.read(index, with_depth=with_depth)
                spliced = replace(frame, index=count, timestamp_s=count / camera.fps, camera=camera)
                yield spliced, piece.dataset, frame.timestamp_s
                count += 1


def there_and_back(name: str, dataset: Dataset, until: int, begin: int, end: int) -> Splice:
    """Frames 0 to ``until``, darkness, and ``begin`` to ``end``, backwards where it is smaller."""
    step = 1 if end > begin else -1
    pieces = (
        Piece(dataset, range(until)),
        Piece(None, range(DARK_FRAMES)),
        Piece(dataset, range(begin, end, step)),
    )
    return Splice(name, pieces)


def gaps(name: str, dataset: Dataset, first: int, begins: Sequence[int], length: int) -> Splice:
    """Frames 0 to ``first``, and after darkness ``length`` frames from each of ``begins``."""
    pieces = [Piece(dataset, range(first))]
    for begin in begins:
        pieces += [Piece(None, range(DARK_FRAMES)), Piece(dataset, range(begin, begin + length))]
    return Splice(name, tuple(pieces))


def run(splice: Splice, depth: str, *, single_map: bool = False) -> dict[str, Any]:
    """Track one recording: its figures.

    Args:
        single_map: start no new map where the camera stays lost.
    """
    config = Config.from_dict({"depth": {"name": depth}, "tracking": {"new_maps": not single_map}})
    model = seeded_depth_model(depth, config)
    given: dict[float, tuple[Dataset | None, float]] = {}
    results = []
    with Tracker(splice.first.camera, model, config) as tracker:
        for frame, dataset, time_s in splice.frames(with_depth=depth == "sensor"):
            results.append(tracker.step(frame))
            given[frame.timestamp_s] = dataset, time_s
        found = tracker.finish()
    maps = (found, *found.others)
    visible = sum(dataset is not None for dataset, _ in given.values())
    scores = [_score(one, given, splice.first) for one in maps]
    largest = scores[0]
    judged = [wrong for one in maps for wrong in found_again(one.trajectory, results, given)]
    return {
        "frames": len(given),
        "visible": visible,
        "placed": sum(len(one.trajectory) for one in maps) / visible,
        "largest": len(found.trajectory) / visible,
        "maps": len(maps),
        "joined": found.statistics.maps_joined,
        "percent_of_path": 100 * largest["sim3"] / largest["path"] if "path" in largest else None,
        "errors_m": [score.get("sim3") for score in scores],
        "found_again": len(judged),
        "found_wrongly": sum(judged),
        "wrong_joins": int(found.statistics.maps_joined > 0 and not largest.get("is_good", True)),
    }


def _score(
    found: Reconstruction, given: dict[float, tuple[Dataset | None, float]], of: Dataset
) -> dict[str, Any]:
    """Errors of those poses that are of frames of ``of``; empty where they are fewer than three."""
    assert of.ground_truth is not None
    times_s = found.trajectory.timestamps_s
    at = [n for n, time_s in enumerate(times_s.tolist()) if given[time_s][0] is of]
    if len(at) < 3:
        return {}
    there_s = np.array([given[float(times_s[n])][1] for n in at])
    nearest = np.abs(of.ground_truth.timestamps_s[None] - there_s[:, None]).argmin(axis=1)
    truth = Trajectory(times_s[at], of.ground_truth.T_world_camera[nearest])
    estimate = Trajectory(times_s[at], found.trajectory.T_world_camera[at])
    return score_piece(truth, estimate, is_metric=True)


def found_again(
    found: Trajectory, results: Sequence[StepResult], given: dict[float, tuple[Dataset | None, float]]
) -> list[bool]:
    """Of each frame of a map that follows a lost one, whether it was found in a wrong place."""
    again = {
        after.timestamp_s
        for before, after in pairwise(results)
        if before.T_world_camera is None and after.status in _FOUND
    }
    wrong = []
    for n in range(1, len(found)):
        if found.timestamps_s[n] not in again:
            continue
        (there, before_s), (here, now_s) = (given[float(found.timestamps_s[k])] for k in (n - 1, n))
        if here is not there or here is None:
            wrong.append(True)
            continue
        D = invert(found.T_world_camera[n - 1]) @ found.T_world_camera[n]
        true = invert(_true_pose(here, before_s)) @ _true_pose(here, now_s)
        off_m = float(np.linalg.norm(D[:3, 3] - true[:3, 3]))
        turned = float(rotation_angle_rad(D[:3, :3].T @ true[:3, :3]))
        wrong.append(off_m > FALSE_M or turned > np.radians(FALSE_DEG))
    return wrong


def _true_pose(dataset: Dataset, time_s: float) -> Floats:
    assert dataset.ground_truth is not None
    nearest = np.abs(dataset.ground_truth.timestamps_s - time_s).argmin()
    return np.asarray(dataset.ground_truth.T_world_camera[nearest])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One row for each recording and depth as Markdown."""
    return markdown_table(_HEADINGS, [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    percent = row["percent_of_path"]
    errors = ", ".join("-" if error is None else f"{error:.4f}" for error in row["errors_m"])
    return [
        row["recording"], row["depth"], str(row["frames"]), str(row["visible"]),
        f"{100 * row['placed']:.1f}", f"{100 * row['largest']:.1f}", str(row["maps"]), str(row["joined"]),
        str(row["wrong_joins"]), str(row["found_again"]), str(row["found_wrongly"]),
        "-" if percent is None else f"{percent:.2f}", errors,
    ]  # fmt: skip


def splices(data: Path | None, seeds: Sequence[int], work: Path) -> list[Splice]:
    """The recordings; rooms that are not there yet are rendered into ``work``."""
    found = []
    if data is not None:
        desk, kitchen = (open_dataset(data / name) for name in (_DESK, _KITCHEN))
        pieces = (
            Piece(desk, range(200)),
            Piece(None, range(DARK_FRAMES)),
            Piece(kitchen, range(200)),
            Piece(desk, range(150, 350)),
        )
        found.append(Splice("elsewhere", pieces))
        found.append(gaps("gaps desk", desk, 200, (150, 100, 50, 10), 40))
        found.append(gaps("gaps kitchen", kitchen, 200, (150, 100, 50, 10), 40))
    settings = SynthSettings.from_dict({"seed": 1, "frames": 300})
    room = open_dataset(render_sequence(work / "room-640x480-300", settings))
    found.append(there_and_back("back", room, 60, 220, 20))
    found.append(gaps("gaps room", room, 150, (110, 70, 30, 5), 40))
    for hall in aliased_rooms(seeds, 600, 320, 240, work):
        dataset = open_dataset(hall.sequence)
        found.append(there_and_back(hall.name, dataset, 200, 330, 600))
        found.append(gaps(f"gaps {hall.name}", dataset, 200, range(250, 600, 50), 40))
    return found


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("maps", __doc__)
    add = parser.add_argument
    default = Path(os.environ.get("SLAMDEPTH_DATA", ROOT.parent / "shared" / "data"))
    add("--data", type=Path, default=default, metavar="DIR", help="real sequences (default: $SLAMDEPTH_DATA)")
    add("--seeds", type=whole_numbers, default=[0, 1, 2, 3], metavar="N,...",
        help="aliased rooms of these seeds (default: 0 to 3)")  # fmt: skip
    add("--depth", type=comma_separated, default=["sensor", "dinov2"], metavar="NAMES",
        help="with commas (default: sensor,dinov2)")  # fmt: skip
    add("--only", type=comma_separated, default=[], metavar="NAMES", help="of the recordings, with commas")
    add("--single-map", action="store_true", help="start no new map where the camera stays lost")
    add("--work", type=Path, default=default_cache(), metavar="DIR", help="folder of the rendered rooms")
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    data = asked.data if (asked.data / _DESK).is_dir() else None
    if data is None:
        progress_line(f"no {_DESK} there; only rendered rooms are run")
    file = RowFile(asked.output, begun, {}, _KEYS)
    rows = []
    for splice in splices(data, asked.seeds, asked.work):
        if asked.only and splice.name not in asked.only:
            continue
        for depth in asked.depth:
            if depth == "sensor" and not all(p.dataset is None or p.dataset.has_depth for p in splice.pieces):
                continue
            key = {"recording": splice.name, "depth": depth, "single_map": asked.single_map}
            row = file.find(**key)
            if row is None:
                row = {**key, **run(splice, depth, single_map=asked.single_map)}
                file.add(row)
                progress_line(f"{splice.name} [{depth}]: done")
            rows.append(row)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
