# SPDX-License-Identifier: Apache-2.0
"""The end of a run: adjustment of the whole map, the metric scale, the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given, coarse_correction, corrected_depth
from slamdepth.depth.robust_centre import robust_centre
from slamdepth.evaluation.leaps import confirmed
from slamdepth.geometry import invert
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.mapping.placement import PlacedBy
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.atlas import Atlas
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.integration import KeyframeIntegration
from slamdepth.tracking.keypoint_alignment import align_keypoints
from slamdepth.tracking.local_mapper import LocalMapper
from slamdepth.tracking.map_tracker import MapTracker
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import in_parallel
from slamdepth.types import RunStatistics
from slamdepth.typing import Ints

_SEARCHED_AGAIN = 6  # neighbours of each keyframe; twice as many gain nothing measurable
_PASSES = 3  # after the first adjustment; more than one only while the readout time changes
_CONVERGED_S = 0.002  # change of the readout time
_OTHER_START = (5, 10)  # steps of adjustments from two starts, of which the better one is kept
_ALIGNED_STEPS = (3, 6)
_READOUT_KEYFRAMES = 200  # latest ones: more tell no more of the readout time


@dataclass(frozen=True)
class FinalMap:
    """What optimising the whole map found.

    Attributes:
        notes: what a reader of the result should know.
        scale_votes: see :class:`RunStatistics`.
    """

    notes: tuple[str, ...]
    scale_votes: tuple[float, ...]


def finish_run(atlas: Atlas, config: Config, watch: Stopwatch, steps: int) -> Reconstruction:
    """Finish all maps of a run that are kept; no keyframe waits.

    Args:
        steps: frames given to the tracker.

    Returns:
        The largest map, with the others that never met it.
    """
    kept = atlas.by_size()
    atlas.finished = tuple(kept)
    atlas.active = kept[0]
    *others, largest = (_finish_map(tracked, config, watch, steps) for tracked in reversed(kept))
    notes = list(largest.notes)
    if others:
        notes.insert(0, f"the camera was lost, and found in places that never met: {len(kept)} separate maps")
    if atlas.dropped_frames:
        notes.append(f"{atlas.dropped_frames} frames lie in maps too small to be of use, and have no pose")
    return replace(
        largest,
        notes=tuple(notes),
        statistics=replace(largest.statistics, maps_joined=atlas.joined),
        others=tuple(reversed(others)),
    )


def _finish_map(tracked: MapTracker, config: Config, watch: Stopwatch, steps: int) -> Reconstruction:
    """Adjust the whole map, make it metric, and return it with the pose of every frame placed in it."""
    integration, map_, frames, shutter = (
        tracked.integration, tracked.map, tracked.frames, tracked.shutter,
    )  # fmt: skip
    with watch.timed("final"):
        final = optimise_map(tracked, config)
    statistics = RunStatistics(
        frames=steps,
        tracked=len(frames),
        loop_closures=integration.loops.count,
        loops_refused=integration.loops.refused,
        relocalisations=tracked.placed_by[PlacedBy.PLACE],
        registrations=tracked.placed_by[PlacedBy.REGISTRATION],
        timings_ms=watch.mean_ms(),
        timing_calls=watch.calls(),
        readout_s=shutter.readout_s,
        readout_sigma_s=shutter.sigma_s,
        scale_votes=final.scale_votes,
    )
    of_this_run = [keyframe for keyframe in map_.keyframes if keyframe.session == map_.session]
    in_time = sorted(of_this_run, key=lambda keyframe: keyframe.frame.timestamp_s)
    seen = map_.seen_by(2)
    rows = np.full(map_.size + 1, -1)  # the last is that of no landmark
    rows[seen] = np.arange(len(seen))
    # NumPy and the disk work in other threads while this one refines frames
    with in_parallel(partial(_final, mapper=integration.mapper, rows=rows), in_time) as making:
        if config.bundle.final:
            frames.refine(shutter.readout_s)
        keyframes = tuple(replace(made.result(), id=n) for n, made in enumerate(making))
    points_m = map_.landmarks.position_w[seen]
    found = frames.trajectory()
    trajectory = frames.with_repeats(confirmed(found, points_m, frames.quality, frames.follows_motion))
    kept_s = set(trajectory.timestamps_s.tolist())
    withdrawn = frames.withdrawn + len(found) + frames.repeated - len(trajectory)
    statistics = replace(statistics, tracked=len(trajectory), withdrawn=withdrawn)
    kept = tuple(one for one in keyframes if one.frame.timestamp_s in kept_s)
    notes = final.notes
    if repeated := frames.repeated:
        notes += (f"{repeated} images repeat the one before, and have its pose",)
    return Reconstruction(
        trajectory=trajectory,
        keyframes=kept,
        points_m=points_m,
        gravity_w=integration.gravity.in_world(),
        notes=notes,
        statistics=statistics,
        loops=_loops(integration, in_time, kept),
    )


def _loops(
    integration: KeyframeIntegration, in_time: Sequence[MapKeyframe], kept: Sequence[Keyframe]
) -> tuple[tuple[int, int], ...]:
    """The loops between the keyframes that are ``kept``, which are numbered in order of time."""
    number = {keyframe.id: n for n, keyframe in enumerate(in_time)}
    ids = {keyframe.id for keyframe in kept}
    pairs = ((number[i], number[j]) for i, j in integration.loops.pairs if i in number and j in number)
    return tuple(sorted({(min(pair), max(pair)) for pair in pairs if ids.issuperset(pair)}))


def optimise_map(tracked: MapTracker, config: Config) -> FinalMap:
    """Global bundle adjustment and metric scale.

    A map that goes on from a saved one keeps that one's scale, and needs no other start. Its keypoints are
    not aligned: images of the saved keyframes may be gone, and one landmark has one reference.
    """
    map_, integration, shutter, is_loaded = (
        tracked.map, tracked.integration, tracked.shutter, tracked.is_loaded,
    )  # fmt: skip
    notes: list[str] = []
    is_adjusted = config.bundle.final and len(map_.keyframes) >= 3
    is_other = is_adjusted and _adjust_all(
        map_, integration, tracked.frames, shutter, from_two_starts=not is_loaded
    )
    if is_adjusted and config.bundle.align and not is_loaded:
        align_keypoints(map_, shutter, tracked.localiser.levels)
        every = [keyframe.id for keyframe in map_.keyframes]
        integration.adjuster.adjust(every, [], map_.seen_by(2), _ALIGNED_STEPS)
    if is_other:
        notes.append(
            "keyframes that share few landmarks were re-registered from those that share many: their "
            "poses while the tracker ran were wrong"
        )
    if taken_back := integration.loops.taken_back:
        notes.append(f"{taken_back} loops were taken back: what the map had seen contradicted them")
    dropped = integration.mapper.dropped
    if dropped:
        notes.append(f"{dropped} predicted depth maps disagreed with the map and were not used")
    if integration.gravity.disagrees:
        notes.append("images disagree on gravity: it is unknown, and views stand as the camera was held")
    return FinalMap(tuple(notes), () if map_.is_measured or is_loaded else _make_metric(map_))


def _adjust_all(
    map_: Map,
    integration: KeyframeIntegration,
    frames: FrameLog,
    shutter: RollingShutter,
    *,
    from_two_starts: bool,
) -> bool:
    """Adjust everything, search again for what the better map predicts to be seen, and adjust once more.

    Args:
        from_two_starts: also try another start.

    Returns:
        Whether another start was better, see :mod:`slamdepth.backend.resection`.
    """
    mapper, adjuster = integration.mapper, integration.adjuster
    every = [keyframe.id for keyframe in map_.keyframes]
    _follow_motion(frames, shutter)
    adjuster.adjust(every, [], map_.seen_by(2), (3, 5))
    # a sensor's depth leaves no bad start to be found
    may_be_bad = from_two_starts and not map_.is_measured
    is_other = may_be_bad and adjuster.adjust_from_two_starts(every, map_.seen_by(2), _OTHER_START)
    for n in range(_PASSES):
        before_s = shutter.readout_s
        if shutter.is_estimated:
            adjuster.estimate_readout(every[-_READOUT_KEYFRAMES:])
        has_converged = abs(shutter.readout_s - before_s) < _CONVERGED_S
        if n > 0 and has_converged:
            break
        _follow_motion(frames, shutter)
        for keyframe in map_.keyframes:
            mapper.search(keyframe, mapper.neighbours(keyframe, limit=_SEARCHED_AGAIN))
        adjuster.adjust(every, [], map_.seen_by(2), (3, 3))
        if has_converged:
            break
    return is_other


def _follow_motion(frames: FrameLog, shutter: RollingShutter) -> None:
    """Correct all keyframes for the shutter by velocities of the whole trajectory."""
    frames.refresh_velocities()
    shutter.correct_keyframes()


def _make_metric(map_: Map) -> tuple[float, ...]:
    """Scale the map so that it agrees with the depth network over all keyframes, not with any one.

    Each keyframe votes with the median log ratio of its map depths to its prediction; the robust centre of
    the votes is taken out. Without votes the scale stays that of the first keyframe.

    Returns:
        The votes after that.
    """
    votes = np.array([v for k in map_.keyframes if (v := _scale_vote(map_, k)) is not None])
    if len(votes) == 0:
        return ()
    offset = robust_centre(votes)
    map_.rescale(float(np.exp(-offset)))
    return tuple(float(vote) for vote in votes - offset)


def _scale_vote(map_: Map, keyframe: MapKeyframe) -> float | None:
    at, _, z = map_.depths_seen(keyframe, observations=3)
    predicted = keyframe.predicted_log_depth[at]
    ok = np.isfinite(predicted)
    if np.count_nonzero(ok) < 20:
        return None
    return float(np.median(np.log(z[ok]) - predicted[ok]))


def _final(keyframe: MapKeyframe, mapper: LocalMapper, rows: Ints) -> Keyframe:
    """The finished keyframe; ``rows`` are those of its landmarks in the points of the result, or -1."""
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
        rows[keyframe.landmark_ids],
    )
