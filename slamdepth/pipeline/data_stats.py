# SPDX-License-Identifier: Apache-2.0
"""Data sets with depth side by side: how much there is, how far, how sparse, through which lens."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth import __version__
from slamdepth.errors import ConfigError, DatasetError, OutputError, SlamdepthError
from slamdepth.evaluation.depth_statistics import DepthStatistics
from slamdepth.io import writable, write_json
from slamdepth.pipeline.depth_data import open_depth_data, thinned
from slamdepth.report.data_stats import DataRow, write_data_page
from slamdepth.training.data import Place
from slamdepth.types import Camera

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


class StatisticsInterrupted(SlamdepthError):
    """Stopped before all images were counted; half a count would mislead, so none is given."""

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
    """Count the depth of data sets; where ``output`` is named, also write page, picture and JSON there.

    Args:
        data: folders, see :func:`slamdepth.pipeline.depth_data.open_depth_data`.
        stride, max_frames: of each data set every so-manieth image, no more than so many.
        progress: called after each image.
        stop: set it, from any thread or a signal handler, to stop.

    Returns:
        The content of ``data-stats.json``.

    Raises:
        InputError: a folder, a setting or the output place is wrong.
        StatisticsInterrupted: ``stop`` was set.
    """
    if stride < 1 or (max_frames is not None and max_frames < 1):
        raise ConfigError(f"stride and number of frames must be 1 or more, got {stride} and {max_frames}")
    if output is not None:
        output = output.expanduser()
        if output.exists() and not output.is_dir():
            raise OutputError(f"{output}: is a file; name a folder for the results")
        writable(output)
    found = [(path, place) for path in data for place in open_depth_data(path)]
    chosen = [thinned(place, stride, max_frames) for _, place in found]
    total, done = sum(map(len, chosen)), 0
    rows: list[DataRow] = []
    for (_, place), name, indices in zip(found, _names(found), chosen, strict=True):
        statistics, notes, troubles = DepthStatistics(), list(place.notes), []
        for index in indices:
            if stop is not None and stop.is_set():
                raise StatisticsInterrupted(f"interrupted after {done} of {total} images; nothing is written")
            try:
                depth_m = place.read(index).depth_m
                assert depth_m is not None  # a place has depth or says which file is wrong
                statistics.add(depth_m)
            except DatasetError as error:
                logger.warning("left out: %s", error)
                troubles.append(str(error))
            done += 1
            if progress is not None:
                progress(name, done, total)
        if not statistics.images:
            why = troubles[0] if troubles else "none of the images looked at has one"
            raise DatasetError(f"{name}: no depth image could be read: {why}")
        notes += [f"{len(troubles)} images cannot be read and are left out"] if troubles else []
        rows.append(DataRow(name, place.camera, len(place), statistics, tuple(notes)))
    about = _about(rows, stride, max_frames)
    if output is not None:
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{output}: cannot be written: {error.strerror or error}") from error
        write_json(output / "data-stats.json", about)
        write_data_page(output, rows, about)
    return about


def view_deg(camera: Camera) -> float:
    """Horizontal field of view in degrees, lens distortion left aside."""
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
    """Names of the data sets, those of one name with the name of the folder above."""
    names = [place.name for _, place in found]
    return [
        f"{path.resolve().parent.name}/{place.name}" if names.count(place.name) > 1 else place.name
        for path, place in found
    ]
