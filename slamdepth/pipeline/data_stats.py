# SPDX-License-Identifier: Apache-2.0
"""Data sets with depth side by side: how much there is, how far, how sparse, through which lens."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth import __version__
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.sequence import ImageSequence
from slamdepth.depth.training.data import Place, data_folder, open_place
from slamdepth.errors import ConfigError, DatasetError, ImageDecodeError, OutputError, SlamdepthError
from slamdepth.evaluation.depth_statistics import DepthStatistics
from slamdepth.io import write_json
from slamdepth.pipeline.folder import writable
from slamdepth.report.data_stats import DataRow, write_data_page
from slamdepth.types import Camera, Frame

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class DepthData:
    """Images with depth under one camera, however they are stored.

    Attributes:
        name: short name.
        size: number of images.
        read: the frame of a number below ``size``; its depth is None where it has none.
        notes: what was guessed or repaired.
    """

    name: str
    camera: Camera
    size: int
    read: Callable[[int], Frame]
    notes: tuple[str, ...] = ()


class StatisticsInterrupted(SlamdepthError):
    """Stopped before all images were counted; half a count would mislead, so none is given."""

    exit_code = 130


def open_depth_data(path: Path) -> list[DepthData]:
    """The data sets in a folder: training pairs (``camera.json``), a folder of such folders, or a
    sequence of a known layout. The one place that knows what kinds there are.

    Raises:
        DatasetError: the folder is missing, of no known kind, or has no depth.
        CameraError: its intrinsics are unknown.
    """
    folder = data_folder(str(path))
    if (folder / "camera.json").is_file():
        return [_of_place(open_place(folder))]
    places = sorted(file.parent for file in folder.glob("*/camera.json"))
    if places:
        return [_of_place(open_place(place)) for place in places]
    return [_of_sequence(open_dataset(folder))]


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
        data: folders, see :func:`open_depth_data`.
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
    sets = _told_apart([(path, found) for path in data for found in open_depth_data(path)])
    chosen = [
        range(found.size)[: None if max_frames is None else max_frames * stride : stride] for found in sets
    ]
    total, done = sum(map(len, chosen)), 0
    rows: list[DataRow] = []
    for found, indices in zip(sets, chosen, strict=True):
        statistics, notes, first_trouble = DepthStatistics(), list(found.notes), ""
        broken = without = 0
        for index in indices:
            if stop is not None and stop.is_set():
                raise StatisticsInterrupted(f"interrupted after {done} of {total} images; nothing is written")
            try:
                depth_m = found.read(index).depth_m
                if depth_m is None:
                    without += 1
                else:
                    statistics.add(depth_m)
            except (ImageDecodeError, DatasetError) as error:
                logger.warning("left out: %s", error)
                broken, first_trouble = broken + 1, first_trouble or str(error)
            done += 1
            if progress is not None:
                progress(found.name, done, total)
        if not statistics.images:
            why = first_trouble or "none of the images looked at has one"
            raise DatasetError(f"{found.name}: no depth image could be read: {why}")
        notes += [f"{broken} images do not decode and are left out"] if broken else []
        notes += [f"{without} images without a depth image are left out"] if without else []
        rows.append(DataRow(found.name, found.camera, found.size, statistics, tuple(notes)))
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


def _of_place(place: Place) -> DepthData:
    return DepthData(place.name, place.camera, len(place), place.read)


def _of_sequence(dataset: Dataset) -> DepthData:
    if not dataset.has_depth:
        raise DatasetError(f"{dataset.path}: has no depth images to count")
    # Which frames have a depth image is known without reading them where they are files.
    indices: Sequence[int] = range(len(dataset))
    if isinstance(dataset, ImageSequence):
        indices = [i for i, depth in enumerate(dataset.depth_paths) if depth is not None]

    def read(number: int) -> Frame:
        return dataset.read(indices[number], with_depth=True)

    return DepthData(dataset.name, dataset.camera, len(indices), read, tuple(dataset.notes))


def _told_apart(found: list[tuple[Path, DepthData]]) -> list[DepthData]:
    """The data sets, those of one name with the name of the folder above."""
    from dataclasses import replace

    names = [data.name for _, data in found]
    return [
        replace(data, name=f"{path.resolve().parent.name}/{data.name}")
        if names.count(data.name) > 1
        else data
        for path, data in found
    ]
