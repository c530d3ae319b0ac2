# SPDX-License-Identifier: Apache-2.0
"""The format of a map on disk: its version, its files, and every array in them.

``docs/maps.md`` has the same table for people.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from slamdepth.errors import DatasetError

if TYPE_CHECKING:
    from numpy.typing import NDArray

FORMAT = "slamdepth map"
VERSION = 1
"""Counts up with every change of the arrays or of ``map.json``. Another version is refused."""

ABOUT = "map.json"

# Sizes: K keyframes, F features of all keyframes, L landmarks, V keyframes with words, W words, D numbers of
# a descriptor, E loops, O odometry edges, G images that tell gravity, T frames, I images, B bytes of images.
ARRAYS: dict[str, dict[str, tuple[str, tuple[str | int, ...]]]] = {
    "keyframes": {
        "first_feature": ("int64", ("K+1",)),
        "T_camera_world": ("float64", ("K", 4, 4)),
        "timestamp_s": ("float64", ("K",)),
        "frame": ("int64", ("K",)),
        "session": ("int64", ("K",)),
        "velocity": ("float64", ("K", 6)),
        "scale": ("float64", ("K",)),
        "unit": ("float64", ("K",)),
        "gravity": ("float64", ("K", 3)),
        "has_prediction": ("bool", ("K",)),
        "is_sensor": ("bool", ("K",)),
        "has_predicted_log_depth": ("bool", ("K",)),
        "predicted_gravity": ("float64", ("K", 3)),
        "predicted_gravity_share": ("float64", ("K",)),
        "scale_sigma_log": ("float64", ("K",)),
        "raw_px": ("float64", ("F", 2)),
        "px": ("float64", ("F", 2)),
        "octave": ("uint8", ("F",)),
        "sigma_px": ("float64", ("F",)),
        "descriptor": ("uint8|float32", ("F", "D")),
        "landmark": ("int32", ("F",)),
        "log_depth": ("float64", ("F",)),
        "sigma_log": ("float64", ("F",)),
        "predicted_log_depth": ("float64", ("F",)),
    },
    "landmarks": {
        "position_w": ("float64", ("L", 3)),
        "covariance_w": ("float64", ("L", 3, 3)),
        "descriptor": ("uint8|float32", ("L", "D")),
        "anchor_keyframe": ("int64", ("L",)),
        "octave": ("int64", ("L",)),
        "distance_m": ("float64", ("L",)),
        "direction_w": ("float64", ("L", 3)),
        "expected": ("int64", ("L",)),
        "found": ("int64", ("L",)),
        "observations": ("int64", ("L",)),
        "alive": ("bool", ("L",)),
        "alias": ("int64", ("L",)),
    },
    "places": {
        "keyframe": ("int64", ("V",)),
        "vector": ("float32", ("V", "W")),
    },
    "graph": {
        "loop_keyframes": ("int64", ("E", 2)),
        "loop_T_i_j": ("float64", ("E", 4, 4)),
        "loop_scale_i_j": ("float64", ("E",)),
        "loop_sigmas": ("float64", ("E", 3)),
        "loop_units": ("float64", ("E", 2)),
        "odometry_keyframes": ("int64", ("O", 2)),
        "odometry_T_i_j": ("float64", ("O", 4, 4)),
        "odometry_sigmas": ("float64", ("O", 3)),
        "gravity_w": ("float64", ("G", 3)),
        "gravity_confidence": ("float64", ("G",)),
    },
    "frames": {
        "timestamp_s": ("float64", ("T",)),
        "session": ("int64", ("T",)),
        "keyframe": ("int64", ("T",)),
        "T_camera_keyframe": ("float64", ("T", 4, 4)),
        "unit": ("float64", ("T",)),
    },
    "images": {
        "keyframe": ("int64", ("I",)),
        "first_byte": ("int64", ("I+1",)),
        "jpeg": ("uint8", ("B",)),
    },
}
"""Type and shape of every array, by file (``NAME.safetensors``) and name."""

OPTIONAL = ("images",)
"""Files that may be absent."""


def file_of(group: str) -> str:
    """Name of the file that holds a group of arrays."""
    return f"{group}.safetensors"


def check_arrays(groups: Mapping[str, Mapping[str, NDArray[Any]]], origin: str) -> dict[str, int]:
    """Refuse arrays of other names, types or shapes, and ids that point nowhere.

    Args:
        origin: named in the error.

    Returns:
        The sizes by their letters.

    Raises:
        DatasetError: an array is not as the format says.
    """
    sizes: dict[str, int] = {}
    for group, arrays in groups.items():
        wanted = ARRAYS[group]
        if set(arrays) != set(wanted):
            differing = ", ".join(sorted(set(arrays) ^ set(wanted)))
            raise DatasetError(f"{origin}: {file_of(group)} is damaged: {differing} missing or unknown")
        for name, (types, shape) in wanted.items():
            array = arrays[name]
            if array.dtype.name not in types.split("|") or not _fits(array.shape, shape, sizes):
                raise DatasetError(
                    f"{origin}: {file_of(group)} is damaged: {name} is {array.dtype.name} {array.shape}"
                )
    for group, name, letter, least in _IDS:
        ids = groups.get(group, {}).get(name)
        if ids is not None and ids.size and not (least <= ids.min() and ids.max() < sizes[letter]):
            raise DatasetError(f"{origin}: {file_of(group)} is damaged: {name} points nowhere")
    for group, name, letter in (("keyframes", "first_feature", "F"), ("images", "first_byte", "B")):
        if group not in groups:
            continue
        firsts = groups[group][name]
        if firsts[0] != 0 or firsts[-1] != sizes[letter] or (firsts[1:] < firsts[:-1]).any():
            raise DatasetError(f"{origin}: {file_of(group)} is damaged: {name} does not ascend")
    return sizes


_IDS = (
    ("keyframes", "landmark", "L", -1),
    ("landmarks", "anchor_keyframe", "K", 0),
    ("landmarks", "alias", "L", 0),
    ("places", "keyframe", "K", 0),
    ("graph", "loop_keyframes", "K", 0),
    ("graph", "odometry_keyframes", "K", 0),
    ("frames", "keyframe", "K", 0),
    ("images", "keyframe", "K", 0),
)


def _fits(shape: tuple[int, ...], wanted: tuple[str | int, ...], sizes: dict[str, int]) -> bool:
    """Whether an array has the shape, learning sizes that are not known yet."""
    if len(shape) != len(wanted):
        return False
    for have, want in zip(shape, wanted, strict=True):
        if isinstance(want, int):
            if have != want:
                return False
            continue
        letter, plus = want[0], 1 if want.endswith("+1") else 0
        if have - plus != sizes.setdefault(letter, have - plus):
            return False
    return True
