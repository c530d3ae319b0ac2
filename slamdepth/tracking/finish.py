# SPDX-License-Identifier: Apache-2.0
"""The end of a run: one adjustment of everything, the metric scale, the result."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given, coarse_correction, corrected_depth
from slamdepth.depth.robust_centre import robust_centre
from slamdepth.geometry import invert
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.local_mapper import LocalMapper
from slamdepth.tracking.map_adjuster import MapAdjuster
from slamdepth.tracking.shutter import Shutter
from slamdepth.types import RunStatistics
from slamdepth.typing import Floats

_SEARCHED_AGAIN = 6  # neighbours of each keyframe; twice as many gain nothing measurable
_PASSES = 3  # after the first adjustment; more than one only while the readout time changes
_SETTLED_S = 0.002
_OTHER_START = (5, 10)  # steps of adjustments from two starts, of which the better one is kept
_MAX_KEYFRAMES = 600  # beyond, the reduced camera system outgrows a laptop's memory


def optimise_everything(
    landmarks: LandmarkMap,
    mapper: LocalMapper,
    adjuster: MapAdjuster,
    frames: FrameLog,
    shutter: Shutter,
    config: Config,
) -> tuple[list[str], tuple[float, ...]]:
    """Global bundle adjustment and metric scale.

    Returns:
        Notes, and the keyframes' votes on the scale; see ``RunStatistics.scale_votes``.
    """
    notes: list[str] = []
    votes: tuple[float, ...] = ()
    keyframes = landmarks.keyframes
    if config.bundle.final and 3 <= len(keyframes) <= _MAX_KEYFRAMES:
        if _adjust_all(landmarks, mapper, adjuster, frames, shutter):
            notes.append(
                "keyframes that share few points were placed anew from those that share many: what the "
                "tracker said of them while it ran was wrong"
            )
    elif len(keyframes) > _MAX_KEYFRAMES:
        notes.append(
            f"the final adjustment of the whole map was left out: {len(keyframes)} keyframes, "
            f"at most {_MAX_KEYFRAMES} fit"
        )
    if mapper.dropped:
        notes.append(f"{mapper.dropped} predicted depth maps disagreed with the map and were not used")
    if not landmarks.is_measured:
        votes = _make_metric(landmarks, frames)
    return notes, votes


def _adjust_all(
    landmarks: LandmarkMap, mapper: LocalMapper, adjuster: MapAdjuster, frames: FrameLog, shutter: Shutter
) -> bool:
    """Adjust everything, look again for what the better map predicts to be seen, and adjust once more.

    Returns:
        Whether it all started anew, see :mod:`slamdepth.backend.resection`.
    """
    every = [k.id for k in landmarks.keyframes]
    _follow_motion(frames, shutter)
    adjuster.adjust(every, [], landmarks.seen_by(2), (3, 5))
    # a sensor's depth leaves no bad start to be found
    is_anew = not landmarks.is_measured and adjuster.reconsider(every, landmarks.seen_by(2), _OTHER_START)
    for n in range(_PASSES):
        before_s = shutter.readout_s
        if shutter.is_sought:
            adjuster.find_readout(every)
        is_settled = abs(shutter.readout_s - before_s) < _SETTLED_S
        if n > 0 and is_settled:
            break
        _follow_motion(frames, shutter)
        for keyframe in landmarks.keyframes:
            mapper.search(keyframe, mapper.neighbours(keyframe, limit=_SEARCHED_AGAIN))
        adjuster.adjust(every, [], landmarks.seen_by(2), (3, 3))
        if is_settled:
            break
    return is_anew


def _follow_motion(frames: FrameLog, shutter: Shutter) -> None:
    """Correct all keyframes for the shutter by velocities of the whole trajectory."""
    frames.refresh_velocities()
    shutter.correct_keyframes()


def _make_metric(landmarks: LandmarkMap, frames: FrameLog) -> tuple[float, ...]:
    """Scale the map so that it agrees with the depth network over all keyframes, not with any one.

    Each keyframe votes with the median log ratio of its map depths to its prediction; the
    votes' robust centre is taken out. Without votes the scale stays that of the first keyframe.

    Returns:
        The votes after that.
    """
    votes = np.array([v for k in landmarks.keyframes if (v := _scale_vote(landmarks, k)) is not None])
    if len(votes) == 0:
        return ()
    offset = robust_centre(votes)
    factor = float(np.exp(-offset))
    n = landmarks.size
    landmarks.position_w[:n] *= factor
    landmarks.covariance_w[:n] *= factor**2
    for keyframe in landmarks.keyframes:
        keyframe.T_camera_world[:3, 3] *= factor
        keyframe.log_depth -= offset
        keyframe.scale *= factor
        keyframe.velocity[:3] *= factor
    landmarks.refresh_views(np.arange(n))
    frames.rescale(np.full(len(landmarks.keyframes), factor))
    return tuple(float(vote) for vote in votes - offset)


def _scale_vote(landmarks: LandmarkMap, keyframe: MapKeyframe) -> float | None:
    at, _, z = landmarks.depths_seen(keyframe, observations=3)
    predicted = keyframe.predicted_log_depth[at]
    ok = np.isfinite(predicted)
    if np.count_nonzero(ok) < 20:
        return None
    return float(np.median(np.log(z[ok]) - predicted[ok]))


def build_reconstruction(
    landmarks: LandmarkMap,
    mapper: LocalMapper,
    frames: FrameLog,
    shutter: Shutter,
    *,
    refine_frames: bool,
    frames_total: int,
    loop_closures: int,
    relocalisations: int,
    registrations: int,
    timings_ms: dict[str, float],
    timing_calls: dict[str, int],
    notes: list[str],
    scale_votes: tuple[float, ...] = (),
    gravity_w: Floats | None = None,
) -> Reconstruction:
    """The value handed to the user, with every frame placed anew where ``refine_frames``."""
    # NumPy and the disk work in other threads while this one places frames
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        making = [pool.submit(_final, keyframe, mapper) for keyframe in landmarks.keyframes]
        if refine_frames:
            frames.refine(shutter.readout_s)
        keyframes = tuple(made.result() for made in making)
    return Reconstruction(
        trajectory=frames.trajectory(),
        keyframes=keyframes,
        points_m=landmarks.position_w[landmarks.seen_by(2)],
        gravity_w=gravity_w,
        notes=tuple(notes),
        statistics=RunStatistics(
            frames=frames_total,
            tracked=len(frames),
            loop_closures=loop_closures,
            relocalisations=relocalisations,
            registrations=registrations,
            timings_ms=timings_ms,
            timing_calls=timing_calls,
            readout_s=shutter.readout_s,
            readout_sigma_s=shutter.sigma_s,
            scale_votes=scale_votes,
        ),
    )


def _final(keyframe: MapKeyframe, mapper: LocalMapper) -> Keyframe:
    stored = keyframe.prediction
    assert stored is not None
    in_metres = as_given
    if not stored.is_sensor:
        prediction = stored.load()
        coarse = coarse_correction(mapper.depth_field(keyframe, prediction), prediction)
        in_metres = partial(corrected_depth, coarse)
    return Keyframe(
        keyframe.id,
        keyframe.frame,
        invert(keyframe.T_camera_world),
        keyframe.features.raw_px,
        keyframe.scale,
        stored,
        in_metres,
    )
