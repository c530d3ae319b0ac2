# SPDX-License-Identifier: Apache-2.0
"""All recordings below a data folder: videos with a camera file, and sequences with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slamdepth.datasets import open_dataset
from slamdepth.errors import CameraError, DatasetError, InputError
from slamdepth.io import read_tum_trajectory
from slamdepth.types import Trajectory

WILD = "wild"
"""Folder of the videos: ``NAME/NAME.mp4``, ``NAME/camera.yaml``, and true poses where they are known."""

_ANY_SCALE = ("beer_phone", "balcony")  # truth by COLMAP, whose scale is arbitrary


@dataclass(frozen=True)
class Recording:
    """A recording and what is known of its true path.

    Attributes:
        truths: true poses in pieces that have no common frame; empty where nothing is known.
        is_metric: whether the pieces are in metres.
    """

    name: str
    sequence: Path
    camera_file: Path | None
    truths: tuple[Trajectory, ...]
    is_metric: bool


def find_recordings(
    data: Path | None, also: Sequence[Path] = (), only: Sequence[str] = ()
) -> list[Recording]:
    """Every recording of ``data``, then the sequences ``also``.

    Args:
        data: folder of sequences with ground truth; its folder ``wild`` holds videos. None takes ``also``.
        only: names of those wanted; empty takes all.

    Raises:
        InputError: there is none, or none of a name in ``only``.
        DatasetError: a sequence of ``also`` cannot be opened or has no ground truth.
    """
    found: list[Recording] = []
    if data is not None:
        found += [_video(folder) for folder in _folders(data / WILD) if _video_of(folder).is_file()]
        found += [one for folder in _folders(data) if folder.name != WILD and (one := sequence_of(folder))]
    for path in also:
        one = sequence_of(path, must_open=True)
        if one is None:
            raise DatasetError(f"{path}: has no ground truth to score by")
        found.append(one)
    names = [recording.name for recording in found]
    for name in only:
        if name not in names:
            raise InputError(f"no recording '{name}' in {data}; there are: {', '.join(names) or 'none'}")
    if not found:
        raise InputError(f"{data}: holds no recording; --data names the folder that holds them")
    return [recording for recording in found if not only or recording.name in only]


def _folders(parent: Path) -> list[Path]:
    return sorted(path for path in parent.iterdir() if path.is_dir()) if parent.is_dir() else []


def _video_of(folder: Path) -> Path:
    return folder / f"{folder.name}.mp4"


def _video(folder: Path) -> Recording:
    truths = [read_tum_trajectory(file)[0] for file in sorted(folder.glob("groundtruth*.txt"))]
    is_metric = folder.name not in _ANY_SCALE
    return Recording(folder.name, _video_of(folder), folder / "camera.yaml", tuple(truths), is_metric)


def sequence_of(folder: Path, *, must_open: bool = False) -> Recording | None:
    """The sequence in ``folder``; None where there is none with ground truth.

    Raises:
        DatasetError, CameraError: with ``must_open``, it cannot be opened.
    """
    try:
        dataset = open_dataset(folder)
    except (DatasetError, CameraError):
        if must_open:
            raise
        return None
    if dataset.ground_truth is None:
        return None
    return Recording(dataset.name, folder, None, (dataset.ground_truth,), True)
