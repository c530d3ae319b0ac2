# SPDX-License-Identifier: Apache-2.0
"""How exactly frames are placed in a map of earlier frames.

    python -m benchmarks.localise SEQ --map-frames 200 --frames 100 --depth dinov2

A map is made of the first frames, and the next ones are looked for in it: as a recording, as single images,
and by a run that goes on from the map. Each is done without the images of the map and with them. "In the map"
is the error of the placed frames, aligned by the frames of the map and not by themselves; "by themselves" is
their own ATE. A run over all frames at once, aligned and judged in the same way, is what can be hoped for: it
is off as well, since the alignment is extrapolated. Errors are in millimetres, RMSE.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.command import errors_in_one_line, parser_of, progress_line
from benchmarks.markdown import markdown_table
from benchmarks.seeded import seeded_depth_model
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.geometry import umeyama
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map, Session
from slamdepth.tracking import MapLocaliser, Tracker
from slamdepth.types import StepResult, Trajectory
from slamdepth.typing import Bools, Floats

_HEADINGS = ("", "placed", "in the map: SE(3)", "Sim(3)", "by themselves: SE(3)", "Sim(3)")


class Study:
    """One sequence: its map, and what is looked for in it.

    Args:
        map_frames: first frames, that the map is made of.
        frames: that follow, and are looked for.
    """

    def __init__(self, dataset: Dataset, depth: str, map_frames: int, frames: int) -> None:
        self._dataset, self._depth = dataset, depth
        self._config = Config.from_dict({"depth": {"name": depth}})
        self._earlier = range(map_frames)
        self._later = range(map_frames, min(map_frames + frames, len(dataset)))

    def rows(self) -> list[tuple[str, ...]]:
        """A row of cells for each way to place the frames."""
        known, _ = self._tracked(self._earlier)
        whole = self._tracked((*self._earlier, *self._later))[0].trajectory(0)
        begin_s = float(self._dataset.timestamps_s[self._later[0]])
        is_later = whole.timestamps_s >= begin_s
        first, last = (_part(whole, at) for at in (~is_later, is_later))
        rows = [self._row("run over all frames at once", first, last)]
        for saved, name in ((known.without_images(), ""), (known, ", images in the map")):
            placed, adjusted = self._as_a_recording(saved)
            grown, _ = self._tracked(self._later, saved)
            ways = {
                "single images": self._alone(saved),
                "recording, as placed": placed,
                "recording, adjusted": adjusted,
                "run --map": grown.trajectory(len(grown.sessions) - 1),
            }
            reference = {"run --map": grown.trajectory(0)}
            for way, found in ways.items():
                rows.append(self._row(way + name, reference.get(way, known.trajectory(0)), found))
        return rows

    def _tracked(self, indices: Iterable[int], start_map: Map | None = None) -> tuple[Map, Reconstruction]:
        model = seeded_depth_model(self._depth, self._config)
        is_sensor = self._depth == "sensor"
        with Tracker(self._dataset.camera, model, self._config, start_map=start_map) as tracker:
            for index in indices:
                tracker.step(self._dataset.read(index, with_depth=is_sensor))
            result = tracker.finish()
        session = Session(self._dataset.name, self._depth)
        progress_line("tracked")
        return tracker.saved_map(0, result, session, {}, with_images=True), result

    def _as_a_recording(self, saved: Map) -> tuple[Trajectory, Trajectory]:
        with MapLocaliser(saved, self._dataset.camera, self._config) as localiser:
            self._each(localiser.step)
            return localiser.trajectory(), localiser.finish()

    def _alone(self, saved: Map) -> Trajectory:
        with MapLocaliser(saved, self._dataset.camera, self._config) as localiser:
            found = [one for one in self._each(localiser.place) if one.T_world_camera is not None]
        poses = np.array([one.T_world_camera for one in found]).reshape(-1, 4, 4)
        return Trajectory(np.array([one.timestamp_s for one in found]), poses)

    def _each(self, place: Callable[..., StepResult]) -> list[StepResult]:
        return [place(self._dataset.read(index)) for index in self._later]

    def _row(self, name: str, reference: Trajectory, found: Trajectory) -> tuple[str, ...]:
        errors = []
        if len(found) >= 3:
            for by in (reference, found):
                for with_scale in (False, True):
                    errors.append(f"{1e3 * self._error_m(by, found, with_scale):.1f}")
        return name, f"{len(found)} of {len(self._later)}", *errors

    def _error_m(self, reference: Trajectory, found: Trajectory, with_scale: bool) -> float:
        scale, R, t = umeyama(_centers(reference), self._truth(reference), with_scale)
        off = scale * _centers(found) @ R.T + t - self._truth(found)
        return float(np.sqrt((off**2).sum(axis=1).mean()))

    def _truth(self, of: Trajectory) -> Floats:
        truth = self._dataset.ground_truth
        assert truth is not None
        nearest = np.abs(truth.timestamps_s[:, None] - of.timestamps_s).argmin(axis=0)
        return np.asarray(truth.T_world_camera[nearest, :3, 3])


def _centers(of: Trajectory) -> Floats:
    return np.asarray(of.T_world_camera[:, :3, 3])


def _part(of: Trajectory, at: Bools) -> Trajectory:
    return Trajectory(of.timestamps_s[at], of.T_world_camera[at])


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("localise", __doc__)
    parser.add_argument("sequence", type=Path, help="with ground truth")
    parser.add_argument("--map-frames", type=int, default=200, metavar="N", help="the map (default: 200)")
    parser.add_argument("--frames", type=int, default=100, metavar="N", help="looked for (default: 100)")
    parser.add_argument("--depth", default="dinov2", metavar="NAME", help="default: dinov2")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked = parse(arguments)
    dataset = open_dataset(asked.sequence)
    if dataset.ground_truth is None:
        print("error: the sequence has no ground truth", file=sys.stderr)
        return 2
    print(markdown_table(_HEADINGS, Study(dataset, asked.depth, asked.map_frames, asked.frames).rows()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
