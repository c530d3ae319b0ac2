# SPDX-License-Identifier: Apache-2.0
"""What the maps of a tracker see, as self-calibration takes it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.backend.sights import Sights
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.observations import Observations
from slamdepth.tracking.map_parts import MapParts
from slamdepth.types import Camera
from slamdepth.typing import Floats

_MOST_KEYFRAMES = 240  # of a map: more tell little more of the camera, and the equations are dense
_RUN = 30  # successive keyframes that are taken together where a map has more
_FEWEST_KEYFRAMES = 3
_SEEN_BY = 3  # two images of a point fit almost any camera


def sights_of(maps: Sequence[MapParts], camera: Camera) -> Sights | None:
    """Observations of landmarks that three keyframes or more see, without any depth.

    Args:
        maps: no keyframe of them may wait to be integrated.
        camera: that their keypoints were undistorted with.

    Returns:
        None where there are too few.
    """
    parts = [part for one in maps if (part := _sights_of_map(one, camera)) is not None]
    return Sights.joined(parts) if parts else None


def _sights_of_map(one: MapParts, camera: Camera) -> Sights | None:
    keyframes = _chosen(one.map.keyframes)
    if len(keyframes) < _FEWEST_KEYFRAMES:
        return None
    ids = one.map.seen_by(_SEEN_BY)
    seen = Observations.of(keyframes, ids, one.map.size)
    often = np.bincount(seen.landmark, minlength=len(ids)) >= _SEEN_BY
    keep = np.flatnonzero(often[seen.landmark])
    if len(keep) == 0:
        return None
    row = np.cumsum(often) - 1
    per_keyframe = [seen.feature[seen.keyframe == n] for n in range(len(keyframes))]
    both = list(zip(keyframes, per_keyframe, strict=True))
    raw_px = np.concatenate([k.features.raw_px[at] for k, at in both])
    corrected: Floats = raw_px + seen.px - camera.undistort_points(raw_px)
    px_rate = np.concatenate([one.shutter.px_rate(k, at) for k, at in both])
    return Sights(
        T_camera_world=np.stack([k.T_camera_world for k in keyframes]),
        group=np.zeros(len(keyframes), dtype=np.int64),
        points_w=one.map.landmarks.position_w[ids[often]].copy(),
        obs_camera=seen.keyframe[keep],
        obs_point=row[seen.landmark[keep]],
        raw_px=corrected[keep],
        sigma_px=seen.sigma_px[keep],
        px_rate=px_rate[keep],
    )


def _chosen(keyframes: Sequence[MapKeyframe]) -> list[MapKeyframe]:
    """All keyframes, or runs of successive ones spread over the map."""
    if len(keyframes) <= _MOST_KEYFRAMES:
        return list(keyframes)
    starts = np.linspace(0, len(keyframes) - _RUN, _MOST_KEYFRAMES // _RUN).round().astype(int)
    return [keyframe for start in starts for keyframe in keyframes[start : start + _RUN]]
