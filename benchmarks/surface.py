# SPDX-License-Identifier: Apache-2.0
"""Compare meshes: from predicted and sensor depth, from the network alone, and by Open3D.

    python -m benchmarks.surface --data ../shared/data --output surface.json
    python -m benchmarks.surface --only demo,kitchen --rows dense=off,sensor

Every mesh is scored against the sensor's own depth, fused from the true poses, where that sensor saw
(``slamdepth evaluate-mesh``). The poses are aligned with scale (Sim(3)) where depth is predicted and
without (SE(3)) where a sensor measured it: over a short path, the scale of an alignment is worse than a
sensor's. F at 5 cm is given for both. "demo" is the room of ``make demo``, "bare" a room with hardly any
texture; both have exact depth. "kitchen" and "rpy" have a Kinect's.

Rows: "dense=MODE", predicted depth with each mode of dense depth that the settings know; "sensor", the same
tracker with the sensor's depth; "network alone", the predictions of the keyframes times one factor each, at
the poses of "dense=off"; "Open3D at our poses", sensor depth of the keyframes of "dense=off" fused by Open3D
alone; "Open3D RGB-D", its dense SLAM with the sensor's depth and its own odometry, all frames.

Depth of the keyframes against the sensor's of the same frame, multiplied by the trajectory's scale: AbsRel is
the mean, "median" the median relative error of all pixels with both; "edges" the F1 of depth edges, see
:mod:`benchmarks.surface_depth`; "1 sigma, 2 sigma" the shares of pixels within the stated deviation.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.depth_cache import default_cache
from benchmarks.jobs import ROOT
from benchmarks.markdown import markdown_table
from benchmarks.record import environment, machine_line
from benchmarks.resume import RowFile
from benchmarks.surface_depth import scaled_predictions, score_keyframes
from benchmarks.surface_open3d import fused_at_poses, open3d_slam
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.sequence import MAX_TIME_DIFFERENCE_S
from slamdepth.evaluation import Surface, score_trajectory
from slamdepth.evaluation.pose_alignment import align_by_poses
from slamdepth.evaluation.surface_file import read_surface
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.sensor_surface import SensorSurface
from slamdepth.pipeline import run
from slamdepth.pipeline.surface import score_against, sensor_reference, surface_of
from slamdepth.synth.sequence import SynthSettings, render_sequence
from slamdepth.types import Trajectory

SEQUENCES = ("demo", "bare", "kitchen", "rpy")
_ROOMS: dict[str, dict[str, Any]] = {
    "demo": {"frames": 300, "seed": 0},
    "bare": {"frames": 200, "seed": 3, "texture": "bare"},
}
_REAL = {"kitchen": "7scenes_redkitchen_seq-01", "rpy": "rgbd_dataset_freiburg1_rpy"}
_KEYS = ("sequence", "row")
_HEADINGS = ("sequence", "row", "accuracy, median / RMSE cm", "completion, median / RMSE cm",
             "precision / recall at 5 cm", "F at 2 / 5 / 10 cm", "F at 5 cm, SE(3) / Sim(3)",
             "AbsRel / median", "measured: share, median", "edges F1", "1 / 2 sigma", "s")  # fmt: skip


def dense_modes() -> tuple[str, ...]:
    """Values of the setting ``dense.mode`` but ``auto``; ``off`` alone where the settings do not know it."""
    section = Config.model_fields.get("dense")
    field = getattr(section.annotation, "model_fields", {}).get("mode") if section is not None else None
    return ("off",) if field is None else tuple(mode for mode in get_args(field.annotation) if mode != "auto")


def row_names() -> tuple[str, ...]:
    """Names of all rows."""
    ours = tuple(f"dense={mode}" for mode in dense_modes())
    return (*ours, "sensor", "network alone", "Open3D at our poses", "Open3D RGB-D")


@dataclass
class Made:
    """A surface in a world of its own.

    Attributes:
        surface: None where there is none.
        trajectory: of the cameras in its world.
        keyframes: whose depth is scored too, if any.
        seconds: wall time of tracking and meshing.
        is_measured: a sensor measured the depth that the trajectory comes from.
    """

    surface: Surface | None
    trajectory: Trajectory
    keyframes: Reconstruction | None
    seconds: float
    is_measured: bool = False


class Bench:
    """One sequence: its reference and what was run on it, each made once."""

    def __init__(self, dataset: Dataset, depth: str) -> None:
        self.dataset = dataset
        self._depth = depth
        self._runs: dict[str, tuple[Made, Reconstruction]] = {}

    @cached_property
    def reference(self) -> SensorSurface:
        """What the sensor saw from the true poses."""
        return sensor_reference(self.dataset)

    def row(self, name: str) -> dict[str, Any]:
        """The figures of one row."""
        made = self._makers[name]() if name in self._makers else self._ours(name.removeprefix("dense="))[0]
        assert self.dataset.ground_truth is not None
        alignment = align_by_poses(self.dataset.ground_truth, made.trajectory, MAX_TIME_DIFFERENCE_S)
        path = score_trajectory(self.dataset.ground_truth, made.trajectory)
        row: dict[str, Any] = {"ate_sim3_m": path.sim3.rmse_m, "scale": alignment.scale,
                               "seconds": made.seconds}  # fmt: skip
        scores = None if made.surface is None else score_against(self.reference, made.surface, alignment)
        row["align"] = "se3" if made.is_measured else "sim3"
        row["se3"] = None if scores is None else scores.se3.to_dict()
        row["sim3"] = None if scores is None else scores.sim3.to_dict()
        row["depth"] = None
        if made.keyframes is not None:
            row["depth"] = score_keyframes(self.dataset, made.keyframes, alignment.scale)
        return row

    @property
    def _makers(self) -> dict[str, Callable[[], Made]]:
        return {
            "sensor": self._sensor,
            "network alone": self._network_alone,
            "Open3D at our poses": self._at_our_poses,
            "Open3D RGB-D": self._open3d,
        }

    def _ours(self, mode: str) -> tuple[Made, Reconstruction]:
        if mode not in self._runs:
            settings = {} if dense_modes() == ("off",) else {"dense": {"mode": mode}}
            self._runs[mode] = self._run(self._depth, settings)
        return self._runs[mode]

    def _run(self, depth: str, settings: dict[str, Any]) -> tuple[Made, Reconstruction]:
        with tempfile.TemporaryDirectory(prefix="surface-") as folder:
            started = time.perf_counter()
            config = Config.from_dict({"depth": {"name": depth}, **settings})
            result = run(self.dataset.path, Path(folder) / "run", config=config)
            seconds = time.perf_counter() - started
            file = result.folder / "mesh.ply"
            surface = read_surface(file) if file.is_file() else None
        found = result.reconstruction
        return Made(surface, found.trajectory, found, seconds, depth == "sensor"), found

    def _sensor(self) -> Made:
        return replace(self._run("sensor", {})[0], keyframes=None)

    def _network_alone(self) -> Made:
        made, reconstruction = self._ours("off")
        started = time.perf_counter()
        alone = replace(reconstruction, keyframes=scaled_predictions(reconstruction.keyframes))
        mesh = alone.fuse_mesh()
        seconds = made.seconds + time.perf_counter() - started
        return Made(surface_of(mesh) if len(mesh.triangles) else None, made.trajectory, alone, seconds)

    def _at_our_poses(self) -> Made:
        made, reconstruction = self._ours("off")
        started = time.perf_counter()
        assert self.dataset.ground_truth is not None
        scale = align_by_poses(self.dataset.ground_truth, made.trajectory, MAX_TIME_DIFFERENCE_S).scale
        surface = fused_at_poses(self.dataset, reconstruction.keyframes, scale)
        return Made(surface, made.trajectory, None, made.seconds + time.perf_counter() - started)

    def _open3d(self) -> Made:
        started = time.perf_counter()
        surface, trajectory = open3d_slam(self.dataset)
        return Made(surface, trajectory, None, time.perf_counter() - started, True)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line for each row as Markdown."""
    return markdown_table(_HEADINGS, [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    cells = [row["sequence"], row["row"]]
    if row["sim3"] is None:
        cells += ["no surface", "-", "-", "-", "-"]
    else:
        chosen = row[row["align"]]
        at_5cm = chosen["within"]["5cm"]
        cells += [f"{100 * chosen[way]['median_m']:.1f} / {100 * chosen[way]['rmse_m']:.1f}"
                  for way in ("accuracy", "completion")]  # fmt: skip
        cells += [
            f"{at_5cm['precision']:.2f} / {at_5cm['recall']:.2f}",
            " / ".join(f"{one['f_score']:.2f}" for one in chosen["within"].values()),
            " / ".join(f"{row[key]['within']['5cm']['f_score']:.2f}" for key in ("se3", "sim3")),
        ]
    depth = row["depth"]
    if depth is None:
        cells += ["-", "-", "-", "-"]
    else:
        inside = "-" if depth["within_1_sigma"] is None else (
            f"{100 * depth['within_1_sigma']:.0f} / {100 * depth['within_2_sigma']:.0f} %")  # fmt: skip
        measured = "-" if depth["median_measured"] is None else (
            f"{100 * depth['measured']:.0f} %, {depth['median_measured']:.3f}")  # fmt: skip
        errors = f"{depth['abs_rel']:.3f} / {depth['median']:.3f}"
        cells += [errors, measured, f"{depth['edge_f1']:.2f}", inside]
    return [*cells, f"{row['seconds']:.0f}"]


def sequences(data: Path, names: Sequence[str], work: Path) -> Iterator[tuple[str, Dataset]]:
    """The sequences of those names that are there; rooms that are not are rendered into ``work``."""
    for name in names:
        if name in _ROOMS:
            settings = SynthSettings.from_dict(_ROOMS[name])
            folder = work / f"room-{settings.seed}-{settings.texture}-{settings.frames}"
            yield name, open_dataset(render_sequence(folder, settings))
        elif (data / _REAL[name]).is_dir():
            yield name, open_dataset(data / _REAL[name])
        else:
            progress_line(f"{name}: {_REAL[name]} is absent in {data.name}/, left out")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("surface", __doc__)
    add = parser.add_argument
    default = Path(os.environ.get("SLAMDEPTH_DATA", ROOT.parent / "shared" / "data"))
    add("--data", type=Path, default=default, metavar="DIR", help="real sequences (default: $SLAMDEPTH_DATA)")
    add("--depth", default="dinov2", metavar="NAME", help="depth model (default: dinov2)")
    add("--only", type=comma_separated, default=list(SEQUENCES), metavar="NAMES",
        help=f"of the sequences, with commas (default: {','.join(SEQUENCES)})")  # fmt: skip
    add("--rows", type=comma_separated, default=list(row_names()), metavar="NAMES",
        help="with commas (default: all)")  # fmt: skip
    add("--work", type=Path, default=default_cache(), metavar="DIR", help="folder of the rendered rooms")
    add("--output", "-o", type=Path, metavar="FILE", help="write the figures as JSON, and go on from there")
    asked = parser.parse_args(arguments)
    for given, known in ((asked.only, SEQUENCES), (asked.rows, row_names())):
        if unknown := [name for name in given if name not in known]:
            parser.error(f"unknown: {', '.join(unknown)}; known: {', '.join(known)}")
    return asked


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    asked, begun = parse(arguments), environment()
    file = RowFile(asked.output, begun, {"depth": asked.depth}, _KEYS)
    rows = []
    for sequence, dataset in sequences(asked.data, asked.only, asked.work):
        bench = Bench(dataset, asked.depth)
        for name in asked.rows:
            row = file.find(sequence=sequence, row=name)
            if row is None:
                row = {"sequence": sequence, "row": name, **bench.row(name)}
                file.add(row)
                progress_line(f"{sequence} [{name}]: done")
            rows.append(row)
    print(machine_line(begun), table(rows), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
