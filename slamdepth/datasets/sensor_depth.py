# SPDX-License-Identifier: Apache-2.0
"""Checks of a sequence's depth images before they are relied on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.datasets.base import Dataset
from slamdepth.datasets.orientation import UPRIGHT
from slamdepth.datasets.sequence import ImageSequence
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_file, read_depth_m

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SAMPLES = 5
_NEEDED = (
    "needed is one channel of 16 bits (PNG, TIFF) in units of depth_factor, or of floats in metres (TIFF, "
    "EXR, .npy)"
)
_LEAST_KNOWN = 0.001
"""Share of the pixels with depth below which nothing can be tracked."""
_NEAREST_M, _FARTHEST_M = 0.02, 100.0
"""What most of the depths of a scene lie between, whatever the sensor."""


@dataclass(frozen=True)
class _Sample:
    path: Path
    raw: NDArray[Any]
    depth_m: NDArray[np.float32]


def lack_of_depth(dataset: Dataset) -> str:
    """That and why ``dataset`` has no sensor depth, for a message."""
    why = dataset.why_no_depth if isinstance(dataset, ImageSequence) else ""
    return f"has no sensor depth ({why or 'no depth images'})"


def check_sensor_depth(dataset: Dataset, indices: Sequence[int]) -> list[str]:
    """Look at a few depth images of the frames ``indices``.

    Returns:
        What is unusual about them, one line each.

    Raises:
        DatasetError: all of those are of 8 bits, of several channels, of another size than the colour images,
            empty, damaged, or of distances that no scene has; says what is needed.
    """
    if not isinstance(dataset, ImageSequence):
        return []
    listed = [path for index in indices if (path := dataset.depth_paths[index]) is not None]
    if not listed:
        return []
    chosen = np.unique(np.linspace(0, len(listed) - 1, _SAMPLES).round().astype(int))
    samples: list[_Sample] = []
    troubles: list[str] = []
    for path in (listed[position] for position in chosen.tolist()):
        try:
            raw = read_depth_file(path)
            if trouble := _wrong_kind(path, raw) or _wrong_size(raw, dataset):
                troubles.append(f"{path}: {trouble}; {_NEEDED}")
                continue
            depth_m = read_depth_m(path, dataset.camera.depth_factor, unknown_raw=dataset.unknown_raw_depth)
        except ImageDecodeError as error:
            troubles.append(f"none of {len(chosen)} depth images looked at can be read; the first: {error}")
            continue
        samples.append(_Sample(path, raw, depth_m))
    if not samples:
        raise DatasetError(troubles[0])
    return _check_values(samples, dataset.camera.depth_factor)


def _wrong_kind(path: Path, raw: NDArray[Any]) -> str:
    """What an image is that holds no depth; empty where it may."""
    is_deep = raw.dtype.kind == "f" or (raw.dtype.kind in "iu" and raw.dtype.itemsize >= 2)
    if raw.ndim == 2:
        if is_deep:
            return ""
        if path.suffix.lower() in (".jpg", ".jpeg"):
            return "the depth images are JPEG, which has 8 bits and loses detail"
        return "the depth images have 8 bits, for viewing rather than distances"
    channels = raw.shape[2] if raw.ndim == 3 else 0
    if not channels:
        return f"the depth images are arrays of shape {raw.shape}"
    equal = bool((raw[..., :3] == raw[..., :1]).all())
    if is_deep:
        return f"the depth images have {channels} channels"
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return f"the depth images are JPEG of {channels} channels, which has 8 bits and loses detail"
    if equal:
        return (
            f"the depth images have 8 bits and {channels} equal channels, for viewing rather than distances"
        )
    return f"the depth images have 8 bits and {channels} channels, a colour map made for viewing"


def _wrong_size(raw: NDArray[Any], dataset: ImageSequence) -> str:
    camera = dataset.camera
    if raw.shape == (camera.height, camera.width) or (
        raw.shape == (camera.width, camera.height) and dataset.orientation != UPRIGHT
    ):
        return ""
    return (
        f"the depth images are {raw.shape[1]}x{raw.shape[0]}, the colour images {camera.width}x"
        f"{camera.height}, but each depth must belong to the colour pixel at its place: register them"
    )


def _check_values(samples: list[_Sample], depth_factor: float) -> list[str]:
    first, count = samples[0], len(samples)
    is_float = first.raw.dtype.kind == "f"
    known = np.concatenate([sample.depth_m[sample.depth_m > 0] for sample in samples])
    share = len(known) / sum(sample.depth_m.size for sample in samples)
    if share < _LEAST_KNOWN:
        raise DatasetError(
            f"{first.path}: {_percent(share)} of the pixels in {count} depth images looked at has a depth "
            "above 0, which means unknown: is it the sensor's depth?"
        )
    if all(_is_saturated(sample.raw) for sample in samples):
        raise DatasetError(
            f"{first.path}: all pixels of {count} depth images looked at are {first.raw.flat[0]}, the "
            "largest value there is, which is no distance"
        )
    near_m, far_m = (float(value) for value in np.percentile(known, (25, 75)))
    if near_m > _FARTHEST_M or far_m < _NEAREST_M:
        by = "as floats in metres" if is_float else f"by depth_factor {depth_factor:g} (raw units per metre)"
        fix = (
            "if they are millimetres, divide them by 1000"
            if is_float
            else "write the camera file's depth_factor: 1000 for millimetres, 5000 for TUM"
        )
        raise DatasetError(
            f"{first.path}: half of the depths lie between {near_m:.3g} and {far_m:.3g} m {by}, which is no "
            f"scene for a depth sensor; {fix}"
        )
    notes = []
    if is_float:
        notes.append("depth images hold floats and are read as metres; depth_factor is not applied to them")
        largest = [float(sample.depth_m.max()) for sample in samples]
        if min(largest) == max(largest) == 1.0:
            notes.append("the largest depth of every image looked at is 1: are they metres, or normalised?")
    return notes


def _is_saturated(raw: NDArray[Any]) -> bool:
    return raw.dtype.kind in "iu" and bool((raw == np.iinfo(raw.dtype).max).all())


def _percent(share: float) -> str:
    return "none" if share == 0.0 else f"only {100 * share:.2g} %"
