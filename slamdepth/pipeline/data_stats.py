# SPDX-License-Identifier: Apache-2.0
"""Data sets with depth side by side: number of images, ranges, sparsity, lens."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth._version import __version__
from slamdepth.errors import DatasetError, SlamdepthError
from slamdepth.evaluation.depth_statistics import DepthStatistics
from slamdepth.io import write_json
from slamdepth.pipeline.depth_data import open_depth_data, thinned
from slamdepth.pipeline.folder import make_folder, writable_folder
from slamdepth.pipeline.options import check_frames_asked
from slamdepth.report.data_stats import DataRow, write_data_page
from slamdepth.training.data import Place
from slamdepth.types import Camera

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


class StatisticsInterrupted(SlamdepthError):
    """Stopped before all images were counted. No result is given, for a partial count would mislead."""

    exit_code = 130


def data_statistics(
    data: Sequence[Path],
    *,
    output: Path | None = None,
    stride: int = 1,
    max_frames: int | None = None,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
) -> dict[str, Any]:
    """Count the depth of data sets; where ``output`` is given, also write page, histograms and JSON there.

    Args:
        data: folders, see :func:`slamdepth.pipeline.depth_data.open_depth_data`.
        output: folder for the results.
        stride, max_frames: every Nth image of each data set, and at most this many.
        progress: called after each image with the data set's name, images done, images in all.
        stop: set it, from any thread or a signal handler, to stop.

    Returns:
        The content of ``data-stats.json``.

    Raises:
        InputError: a folder, a setting or the output folder is wrong.
        StatisticsInterrupted: ``stop`` was set.
    """
    check_frames_asked(stride, max_frames)
    if output is not None:
        output = writable_folder(output)
    found = [(path, place) for path in data for place in open_depth_data(path)]
    chosen = [thinned(place, stride, max_frames) for _, place in found]
    counter = _Counter(sum(map(len, chosen)), progress or (lambda *_: None), stop or threading.Event())
    rows = [
        counter.count(name, place, indices)
        for (_, place), name, indices in zip(found, _names(found), chosen, strict=True)
    ]
    about = _about(rows, stride, max_frames)
    if output is not None:
        make_folder(output)
        write_json(output / "data-stats.json", about)
        write_data_page(output, rows, about)
    return about


@dataclass
class _Counter:
    """Counts images of all data sets.

    Attributes:
        total: images of all of them.
        done: images that were looked at.
    """

    total: int
    progress: Progress
    stop: threading.Event
    done: int = 0

    def count(self, name: str, place: Place, indices: Sequence[int]) -> DataRow:
        """Statistics of one data set; images that cannot be read are left out.

        Raises:
            DatasetError: no image can be read.
            StatisticsInterrupted: ``stop`` was set.
        """
        statistics = DepthStatistics()
        failures: list[str] = []
        for index in indices:
            if self.stop.is_set():
                raise StatisticsInterrupted(
                    f"interrupted after {self.done} of {self.total} images; nothing is written"
                )
            try:
                depth_m = place.read(index).depth_m
                assert depth_m is not None  # a place has depth or says which file is wrong
                statistics.add(depth_m)
            except DatasetError as error:
                logger.warning("left out: %s", error)
                failures.append(str(error))
            self.done += 1
            self.progress(name, self.done, self.total)
        if not statistics.images:
            why = failures[0] if failures else "none of the images looked at has one"
            raise DatasetError(f"{name}: no depth image could be read: {why}")
        left_out = [f"{len(failures)} images cannot be read and are left out"] if failures else []
        return DataRow(name, place.camera, len(place), statistics, (*place.notes, *left_out))


def view_deg(camera: Camera) -> float:
    """Horizontal field of view in degrees, without regard to lens distortion."""
    return math.degrees(
        math.atan((camera.cx + 0.5) / camera.fx) + math.atan((camera.width - 0.5 - camera.cx) / camera.fx)
    )


def _about(rows: list[DataRow], stride: int, max_frames: int | None) -> dict[str, Any]:
    edges_m = np.round(np.concatenate([np.arange(0.0, 10.0, 0.05), np.arange(10.0, 80.5, 0.5)]), 3)
    sets = []
    for row in rows:
        camera = row.camera
        sets.append(
            {
                "name": row.name,
                "pairs": row.size,
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "view_deg": view_deg(camera),
                **row.statistics.to_dict(),
                "histogram": row.statistics.histogram(edges_m),
                "notes": list(row.notes),
            }
        )
    return {
        "slamdepth": __version__,
        "stride": stride,
        "max_frames": max_frames,
        "histogram_edges_m": edges_m,
        "sets": sets,
    }


def _names(found: list[tuple[Path, Place]]) -> list[str]:
    """Names of the data sets; those that share a name get that of the parent folder before it."""
    names = [place.name for _, place in found]
    return [
        f"{path.resolve().parent.name}/{place.name}" if names.count(place.name) > 1 else place.name
        for path, place in found
    ]
