# SPDX-License-Identifier: Apache-2.0
"""What is equal and what differs between runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from slamdepth.errors import ConfigError, DatasetError
from slamdepth.evaluation import TrajectoryScore, score_trajectory
from slamdepth.report.saved_run import SavedRun
from slamdepth.report.text import MISSING, count, fixed, percent

_Show = Callable[[Any], str]

# name of the figure, where it is in report.json, how it is shown, which end is better
_FIGURES: tuple[tuple[str, str, _Show, str], ...] = (
    ("verdict", "health.verdict", str, ""),
    ("sequence", "sequence", str, ""),
    ("depth model", "depth_model", str, ""),
    ("frames", "frames", count, ""),
    ("tracked", "tracked_fraction", percent, "high"),
    ("maps", "maps", count, ""),
    ("keyframes", "keyframes", count, ""),
    ("loop closures", "loop_closures", count, ""),
    ("frames per second", "fps", lambda value: fixed(value, 1), "high"),
    ("ATE SE(3), RMSE (m)", "ate.se3.rmse_m", lambda value: fixed(value, 4), "low"),
    ("ATE Sim(3), RMSE (m)", "ate.sim3.rmse_m", lambda value: fixed(value, 4), "low"),
    ("scale by truth", "ate.sim3.scale", lambda value: fixed(value, 3), ""),
    ("RPE per frame (m)", "rpe.per_frame.trans_rmse_m", lambda value: fixed(value, 4), "low"),
    ("RPE per second (m)", "rpe.per_second.trans_rmse_m", lambda value: fixed(value, 4), "low"),
    ("RPE per second (°)", "rpe.per_second.rot_rmse_deg", lambda value: fixed(value, 3), "low"),
    ("depth AbsRel", "depth.metric.abs_rel", lambda value: fixed(value, 3), "low"),
    ("mesh triangles", "mesh.triangles", count, ""),
    ("mesh Sim(3): F at 5 cm", "surface.sim3.within.5cm.f_score", lambda value: fixed(value, 3), "high"),
    ("mesh Sim(3): accuracy, median (m)", "surface.sim3.accuracy.median_m", lambda v: fixed(v, 4), "low"),
    ("mesh Sim(3): completion, median (m)", "surface.sim3.completion.median_m", lambda v: fixed(v, 4), "low"),
    ("mesh SE(3): F at 5 cm", "surface.se3.within.5cm.f_score", lambda value: fixed(value, 3), "high"),
)
_DIFFERING = ("settings", "options", "versions", "hardware")
_NO_DIFFERENCE = {"options.interrupted"}


@dataclass(frozen=True)
class Row:
    """A figure of all runs.

    Attributes:
        name: of the figure.
        values: as they are in ``report.json``, None where one has none.
        shown: the same as text.
        best: numbers of the runs that are best, none where all are equal or no end is better.
    """

    name: str
    values: tuple[Any, ...]
    shown: tuple[str, ...]
    best: tuple[int, ...] = ()


@dataclass(frozen=True)
class Comparison:
    """Runs side by side.

    Attributes:
        names: of the runs, no two alike.
        runs: in the order given; the first is the one that paths are aligned to.
        figures: those that at least one run has.
        differences: settings, options, versions and hardware that are not the same for all.
        to_first: path of each run against the first one's, None for the first itself and where they
            have too little in common.
        notes: what could not be compared, one line each.
    """

    names: tuple[str, ...]
    runs: tuple[SavedRun, ...]
    figures: tuple[Row, ...]
    differences: tuple[Row, ...]
    to_first: tuple[TrajectoryScore | None, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for ``compare.json``."""
        return {
            "runs": list(self.names),
            "figures": {row.name: list(row.values) for row in self.figures},
            "differences": {row.name: list(row.values) for row in self.differences},
            "distance_to_first": [
                None
                if one is None
                else {"matched": one.matched, "se3_rmse_m": one.se3.rmse_m, "sim3_rmse_m": one.sim3.rmse_m,
                      "sim3_scale": one.sim3.scale}
                for one in self.to_first
            ],
            "notes": list(self.notes),
        }  # fmt: skip


def compare_runs(runs: Sequence[SavedRun]) -> Comparison:
    """Put runs side by side.

    Raises:
        ConfigError: there are fewer than two.
    """
    if len(runs) < 2:
        raise ConfigError("name two or more run folders to compare")
    names = _names([run.folder for run in runs])
    summaries = [run.summary for run in runs]
    notes = [note for run in runs for note in run.notes]
    one_sequence = len({summary["sequence"] for summary in summaries}) == 1
    to_first: list[TrajectoryScore | None] = [None]
    for name, run in zip(names[1:], runs[1:], strict=True):
        try:
            to_first.append(score_trajectory(runs[0].scene.maps[0].path, run.scene.maps[0].path))
        except DatasetError:
            to_first.append(None)
            notes.append(f"{name}: its path has too little in common with that of {names[0]} to be aligned")
    if not one_sequence:
        notes.append("the runs are of different sequences: their errors cannot be compared")
    figures = [
        replace(row, best=row.best if one_sequence else ())
        for figure in _FIGURES
        if (row := _figure(summaries, *figure)) is not None
    ]
    if any(one is not None for one in to_first):
        values = tuple(None if one is None else one.sim3.rmse_m for one in to_first)
        figures.append(Row(f"distance to {names[0]} (m)", values, tuple(fixed(value, 4) for value in values)))
    return Comparison(
        names, tuple(runs), tuple(figures), tuple(_differences(summaries)), tuple(to_first), tuple(notes)
    )


def _names(folders: Sequence[Path]) -> tuple[str, ...]:
    """The last part of each path, or as many as it takes to tell them apart."""
    paths = [folder.absolute() for folder in folders]
    for depth in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            return tuple(names)
    return tuple(f"{path.name} ({n})" for n, path in enumerate(paths, start=1))


def _figure(
    summaries: Sequence[dict[str, Any]], name: str, place: str, show: _Show, better: str
) -> Row | None:
    values = tuple(_at(summary, place) for summary in summaries)
    if all(value is None for value in values):
        return None
    shown = tuple(MISSING if value is None else show(value) for value in values)
    numbers = [value for value in values if isinstance(value, int | float)]
    best: tuple[int, ...] = ()
    if better and len(numbers) > 1 and len(set(shown)) > 1:
        top = max(numbers) if better == "high" else min(numbers)
        best = tuple(n for n, value in enumerate(values) if value is not None and value == top)
    return Row(name, values, shown, best)


def _at(value: Any, place: str) -> Any:
    for key in place.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(key)
    return len(value) if isinstance(value, list) else value


def _differences(summaries: Sequence[dict[str, Any]]) -> list[Row]:
    rows = []
    flat = [
        {f"{part}.{key}": value for part in _DIFFERING for key, value in _leaves(summary.get(part) or {})}
        for summary in summaries
    ]
    for key in dict.fromkeys(key for one in flat for key in one):
        values = tuple(one.get(key) for one in flat)
        if key not in _NO_DIFFERENCE and any(value != values[0] for value in values):
            shown = tuple(MISSING if value is None else _short(str(value)) for value in values)
            rows.append(Row(key.removeprefix("settings."), values, shown))
    return rows


def _leaves(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            found += _leaves(inner, f"{prefix}{key}.")
        else:
            found.append((f"{prefix}{key}", inner))
    return found


def _short(text: str) -> str:
    """A commit by its first digits, everything else as it is."""
    commit, plus, changes = text.partition("+")
    is_commit = len(commit) == 40 and all(c in "0123456789abcdef" for c in commit)
    return f"{commit[:10]}{plus}{changes}" if is_commit else text
