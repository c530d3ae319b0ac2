# SPDX-License-Identifier: Apache-2.0
"""Maps of several runs joined into one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamdepth._version import __version__
from slamdepth.config import Config
from slamdepth.errors import ConfigError
from slamdepth.io import results_folder, write_json, write_tum_trajectory
from slamdepth.mapstore import Map
from slamdepth.pipeline.folder import MAP, make_folder
from slamdepth.tracking.merging import merge_all

logger = logging.getLogger(__name__)

_FIGURES = "merged.json"


@dataclass(frozen=True)
class MergeResult:
    """What joining maps gave.

    Attributes:
        map: of all that were joined, in the world and the metres of the first one.
        meetings: keyframes that agreed on how to join them.
        apart: places, in what was asked for, of maps that never met it.
    """

    map: Map
    meetings: int
    apart: tuple[int, ...]

    def save(self, folder: str | Path) -> None:
        """Write ``map/``, ``merged.json`` and ``sessions/N/trajectory.txt`` of each recording.

        Raises:
            OutputError: they cannot be written.
        """
        path = Path(folder)
        make_folder(path)
        self.map.save(path / MAP)
        for number, _ in enumerate(self.map.sessions):
            place = path / "sessions" / str(number + 1)
            make_folder(place)
            write_tum_trajectory(place / "trajectory.txt", self.map.trajectory(number))
        write_json(path / _FIGURES, {**self.figures(), "version": __version__})

    def figures(self) -> dict[str, Any]:
        """Counts for reports."""
        return {
            "sessions": [asdict(session) for session in self.map.sessions],
            "keyframes": len(self.map),
            "points": len(self.map.points_m),
            "meetings": self.meetings,
            "apart": list(self.apart),
        }


def merge(maps: Sequence[Map | str | Path], config: Config | None = None) -> MergeResult:
    """Join the maps of several runs by places that their keyframes see in common.

    Args:
        maps: two or more maps, or run folders with one; the first one gives the world frame and the scale.
        config: settings; features are those of the maps.

    Raises:
        InputError: there are fewer than two, one cannot be read, or they cannot be compared.
        ConfigError: no two of them meet.
    """
    if len(maps) < 2:
        raise ConfigError(f"merging takes two maps or more, got {len(maps)}")
    loaded = [one if isinstance(one, Map) else Map.load(one) for one in maps]
    last, apart = merge_all(loaded, config)
    if last is None:
        raise ConfigError(
            "the maps never meet: no three keyframes agree on a place that looks like no other; nothing is "
            "written"
        )
    return MergeResult(last.map, last.meetings, tuple(apart))


def plan_folder(output: Path, *, overwrite: bool) -> Path:
    """Check the folder of the results; nothing is written.

    Raises:
        OutputError: it is a file, cannot be written, or holds something else than earlier results.
    """
    return results_folder(output, lambda path: (path / _FIGURES).is_file(), "merged map", overwrite=overwrite)
