# SPDX-License-Identifier: Apache-2.0
"""The rows of the table: systems, their depth and their settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.system import System
from slamdepth.config import Config, merge
from slamdepth.errors import ConfigError
from slamdepth.types import Camera

SENSOR = "sensor"
NONE = "none"
OURS = "slamdepth"
FILES = {"weights", "matcher"}
"""Settings of a feature that hold a file."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        label: name in the table; unique together with ``depth``.
        system: key of :data:`SYSTEMS`.
        depth: ``"sensor"``, ``"none"`` or the registered name of a depth model.
        settings: nested settings of slamdepth that differ from its defaults.
        note: a note below the table, or nothing.
    """

    label: str
    system: str
    depth: str
    settings: dict[str, Any] = field(default_factory=dict)
    note: str = ""

    @property
    def is_ours(self) -> bool:
        return self.system.startswith("slamdepth")

    def published(self) -> dict[str, Any]:
        """The row as the JSON file holds it, with names of weights files instead of their paths."""
        row = asdict(self)
        del row["note"]
        for key in FILES & row["settings"].get("features", {}).keys():
            row["settings"]["features"][key] = Path(row["settings"]["features"][key]).name
        return row

    @property
    def needs_sensor(self) -> bool:
        return self.depth == SENSOR

    @property
    def needs_predictions(self) -> bool:
        """Whether it gets predictions from the cache; slamdepth's own network runs in the measured time."""
        return not self.is_ours and self.depth not in (SENSOR, NONE)


def _ours(depths: Sequence[str]) -> list[Row]:
    return [Row("slamdepth", OURS, depth) for depth in depths]


def _ours_icp(depths: Sequence[str]) -> list[Row]:
    return [Row("slamdepth, KISS-ICP", "slamdepth-icp", d, {"odometry": "kiss-icp"}) for d in depths]


def _orbslam3(depths: Sequence[str]) -> list[Row]:
    rows = [Row("ORB-SLAM3 monocular", "orbslam3", NONE, note="no scale of its own")]
    for depth in depths:
        note = "" if depth == SENSOR else "naive: predictions given as if a sensor's"
        rows.append(Row("ORB-SLAM3 RGB-D", "orbslam3", depth, note=note))
    return rows


def _open3d(depths: Sequence[str]) -> list[Row]:
    return [Row("Open3D RGB-D odometry", "open3d", depth) for depth in depths]


def _kiss_icp(depths: Sequence[str]) -> list[Row]:
    return [Row("KISS-ICP", "kiss-icp", depth) for depth in depths if depth == SENSOR]


SYSTEMS: dict[str, Callable[[Sequence[str]], list[Row]]] = {
    OURS: _ours,
    "slamdepth-icp": _ours_icp,
    "orbslam3": _orbslam3,
    "open3d": _open3d,
    "kiss-icp": _kiss_icp,
}
"""For each system the function that makes its rows for a list of depths."""

ABLATIONS: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "no loops": {"loops": {"enabled": False}},
    "no final bundle": {"bundle": {"final": False}},
    "no local bundle": {"bundle": {"local": False}},
    "no bundle adjustment": {"bundle": {"local": False, "final": False}},
    "no loops, no final bundle": {"loops": {"enabled": False}, "bundle": {"final": False}},
    "rolling shutter ignored": {"shutter": {"readout_ms": 0.0}},
    "window 4": {"bundle": {"window": 4}},
    "no prior inflation": {"bundle": {"prior_inflation": 1.0}},
    "prior inflation 2": {"bundle": {"prior_inflation": 2.0}},
    "prior inflation 20": {"bundle": {"prior_inflation": 20.0}},
    "no common depth error": {"bundle": {"scale_sigma": 0.0}},
    "no uncertainty": {"depth": {"uncertainty": False}},
    "any depth, however unsure": {"depth": {"max_sigma_log": 10.0}},
    "500 features": {"features": {"count": 500}},
    "1000 features": {"features": {"count": 1000}},
    "2000 features": {"features": {"count": 2000}},
    "keyframe overlap 0.5": {"tracking": {"keyframe_overlap": 0.5}},
    "keyframe overlap 0.6": {"tracking": {"keyframe_overlap": 0.6}},
    "keyframe overlap 0.7": {"tracking": {"keyframe_overlap": 0.7}},
    "keyframe overlap 0.8": {"tracking": {"keyframe_overlap": 0.8}},
    "keyframe overlap 0.9": {"tracking": {"keyframe_overlap": 0.9}},
}
"""Rows of the ablation: settings that differ from the defaults."""


def plan_rows(
    systems: Sequence[str], depths: Sequence[str], features: Sequence[dict[str, Any]] = ()
) -> list[Row]:
    """The rows of ``systems`` for ``depths``, in the order given.

    Args:
        features: settings of each feature that slamdepth is run with; none takes the default.

    Raises:
        ConfigError: no such system; lists those that exist.
    """
    rows: list[Row] = []
    for name in systems:
        if name not in SYSTEMS:
            raise ConfigError(f"--systems: no system is called '{name}'; known: {', '.join(SYSTEMS)}")
        of_system = SYSTEMS[name](depths)
        if name == OURS and features:
            of_system = [with_feature(row, settings) for row in of_system for settings in features]
        rows += of_system
    return rows


def with_feature(row: Row, settings: dict[str, Any]) -> Row:
    """The row with other features, which its label names unless they are the default."""
    if settings == {"name": Config().features.name}:
        return row
    return replace(row, label=f"{row.label}, {settings['name']}", settings={"features": settings})


def plan_ablation(depths: Sequence[str]) -> list[Row]:
    """slamdepth with one part changed at a time; variants equal to the default are left out."""
    rows = []
    for depth in depths:
        shipped, *others = (Row(label, OURS, depth, s) for label, s in ABLATIONS.items())
        rows += [shipped, *(row for row in others if config_of(row) != config_of(shipped))]
    return rows


def config_of(row: Row) -> Config:
    """slamdepth's settings for a row.

    Raises:
        ConfigError: a setting of the row is unknown or out of range.
    """
    return Config.from_dict(merge({"depth": {"name": row.depth}}, row.settings), origin=f"row '{row.label}'")


def build_system(row: Row, camera: Camera, vocabulary: Path | None) -> System:
    """The system of a row, ready for its first frame.

    Raises:
        NotInstalled: a peer's package is missing.
        WeightsError: the weights of the depth model are missing.
    """
    if row.is_ours:
        from benchmarks.ours import SlamDepth

        return SlamDepth(camera, config_of(row))
    if row.system == "orbslam3":
        from benchmarks.orbslam3 import OrbSlam3

        if vocabulary is None:
            raise ConfigError("ORB-SLAM3 needs a vocabulary")
        return OrbSlam3(camera, "mono" if row.depth == NONE else "rgbd", vocabulary)
    from benchmarks import peers

    return peers.Open3dOdometry(camera) if row.system == "open3d" else peers.KissIcp(camera)
