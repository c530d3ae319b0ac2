# SPDX-License-Identifier: Apache-2.0
"""The scale of a finished map from markers of known size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.fiducial import MarkerDetector, MarkerSpec
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import ScaleSource
from slamdepth.scale.estimate import ScaleEstimate
from slamdepth.scale.marker_fit import MarkerFit, Sighting, fit_marker
from slamdepth.typing import Floats, Ints

SIDE_SIGMA_LOG = 0.003
"""Standard deviation of the log of a marker's side: half a millimetre of a print of 16 cm."""

_MAX_SEARCHED = 300  # frames besides the keyframes
_MIN_PARALLAX_DEG = 2.0
_MAX_SIGMA_LOG = 0.1
_MAX_RESIDUAL_PX = 4.0  # robust; beyond, the marker moved, or is a chance pattern
_MIN_SIGHTINGS = 3

_Corners = dict[int, Floats]


def from_markers(
    dataset: Dataset,
    reconstruction: Reconstruction,
    spec: MarkerSpec,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[ScaleEstimate]:
    """Compare the known side of markers with that in the map, one estimate for each marker.

    Keyframes are searched first, then placed frames around those that show a marker; where no keyframe does,
    frames spread over the whole run.

    Args:
        dataset: reads the images.
        reconstruction: a finished map of it.
        spec: family and side.
        progress: called with the images searched and to be searched.

    Raises:
        DatasetError: no image shows a marker, or none from two sides.
    """
    seen, searched = _search(dataset, reconstruction, MarkerDetector(spec), progress)
    numbers = sorted({number for corners in seen.values() for number in corners})
    if not numbers:
        raise DatasetError(f"no {spec} marker was found in {searched} images")
    found: list[ScaleEstimate] = []
    refused: list[str] = []
    for number in numbers:
        sightings = _sightings(dataset, reconstruction, seen, number)
        name = f"{spec.family} {number}"
        why = f"{name} was found in {len(sightings)} of {searched} images"
        if len(sightings) < _MIN_SIGHTINGS:
            refused.append(f"{why}, {_MIN_SIGHTINGS} are needed")
            continue
        fit = fit_marker(dataset.camera.without_distortion(), sightings)
        problem = _problem(fit)
        if fit is None or problem is not None:
            refused.append(f"{why}, {problem}")
            continue
        how = (
            f"marker {name} of {spec.side_m:g} m against {fit.side:.4g} m, seen in {len(sightings)} images "
            f"up to {fit.parallax_deg:.0f} degrees apart"
        )
        sigma_log = math.hypot(SIDE_SIGMA_LOG, fit.sigma_log)
        found.append(ScaleEstimate(ScaleSource.MARKER, spec.side_m / fit.side, sigma_log, how))
    if not found:
        raise DatasetError("; ".join(refused))
    return found


def _problem(fit: MarkerFit | None) -> str | None:
    """Why a fit tells no scale, or None."""
    if fit is None or fit.residual_px > _MAX_RESIDUAL_PX:
        return "but no resting square explains what they show"
    if fit.parallax_deg < _MIN_PARALLAX_DEG or fit.sigma_log > _MAX_SIGMA_LOG:
        return (
            f"but never from two sides ({fit.parallax_deg:.1f} degrees apart at most): move the camera "
            "sideways while it sees the marker"
        )
    return None


def _search(
    dataset: Dataset,
    reconstruction: Reconstruction,
    detector: MarkerDetector,
    progress: Callable[[int, int], None],
) -> tuple[dict[int, _Corners], int]:
    """Corners of markers by the frame that shows them, and the number of frames searched."""
    placed = _placed_frames(dataset, reconstruction)
    keyframes = sorted({keyframe.frame.index for keyframe in reconstruction.keyframes} & set(placed.tolist()))
    seen: dict[int, _Corners] = {}
    done: set[int] = set()

    def search(indices: Sequence[int]) -> None:
        left = [index for index in indices if index not in done]
        total = len(done) + len(left)
        for index in left:
            progress(len(done), total)
            done.add(index)
            try:
                corners = detector.find(dataset.read(index).image_rgb)
            except ImageDecodeError:
                continue
            if corners:
                seen[index] = corners

    search(keyframes)
    if not seen:
        search(_thinned(placed, _MAX_SEARCHED // 2))
    if seen:
        known = np.array(sorted(done))
        near: set[int] = set()
        for index in seen:
            at = int(np.searchsorted(known, index))
            low, high = known[max(0, at - 1)], known[min(len(known) - 1, at + 1)]
            near.update(placed[(placed >= low) & (placed <= high)].tolist())
        search(_thinned(np.array(sorted(near)), _MAX_SEARCHED))
    return seen, len(done)


def _placed_frames(dataset: Dataset, reconstruction: Reconstruction) -> Ints:
    """Numbers ``(N,)`` in the dataset of the frames with a pose."""
    times_s = np.asarray(dataset.timestamps_s)
    at = np.clip(np.searchsorted(times_s, reconstruction.trajectory.timestamps_s), 0, len(times_s) - 1)
    return np.asarray(at[times_s[at] == reconstruction.trajectory.timestamps_s])


def _thinned(indices: Ints, most: int) -> list[int]:
    if len(indices) <= most:
        return [int(index) for index in indices]
    return [int(index) for index in indices[np.linspace(0, len(indices) - 1, most).astype(int)]]


def _sightings(
    dataset: Dataset, reconstruction: Reconstruction, seen: dict[int, _Corners], number: int
) -> list[Sighting]:
    trajectory = reconstruction.trajectory
    times_s = np.array([keyframe.frame.timestamp_s for keyframe in reconstruction.keyframes])
    found = []
    for index in sorted(seen):
        if number in seen[index]:
            time_s = float(dataset.timestamps_s[index])
            row = int(np.searchsorted(trajectory.timestamps_s, time_s))
            group = int(np.argmin(np.abs(times_s - time_s))) if len(times_s) else index
            corners = dataset.camera.undistort_points(seen[index][number])
            found.append(Sighting(trajectory.T_world_camera[row], corners, group))
    return found
