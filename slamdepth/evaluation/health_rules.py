# SPDX-License-Identifier: Apache-2.0
"""The rules of a verdict.

Each rule states what it rests on and what innocent cause looks the same. Thresholds are the same for all
recordings, and relative: to the run's own median speed, to the fewest inliers the tracker accepts, to the
length of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from slamdepth.evaluation.health_facts import RunFacts
from slamdepth.evaluation.health_numbers import HealthNumbers
from slamdepth.evaluation.health_spans import GOOD_SPAN_S, LONG_S, HealthSpan, SpanKind
from slamdepth.evaluation.leaps import MAX_STEP_S

WEAK = 2
"""Times the least inliers that the tracker accepts: one group of wrong matches less, and it would be lost."""

_MUCH_LOST = 0.2  # of all frames; also of those withdrawn or in another map
_SOME_LOST = 0.05
_LONG_START = 0.1
_MANY_LEAPS = 3  # two are one wrong pose, there and back
_MOSTLY = 0.5
_MUCH_REGISTERED = 0.25
_FRAMES_PER_KEYFRAME = 2.0
_FEW_FRAMES = 20
_FEW_REFUSED = 3
_STRONG = 60  # points that hold odometry as well as it can be held: as in slamdepth/loops/edges.py
_DRIFT_SHARE = 0.03  # of the path that odometry may drift by: as in slamdepth/loops/consistency.py
_SCALE_SPREAD_LOG = 0.4  # a factor of 1.5; networks err by about 0.2 from image to image
_SHOWN = 3  # spans named in one sentence


class Verdict(str, Enum):
    """What a run says of its own result."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    NOT_TRUSTWORTHY = "not trustworthy"


@dataclass(frozen=True)
class Finding:
    """What one rule says: how grave it is, in a few words, and as a sentence.

    Attributes:
        is_local: the evidence lies in spans, so that stretches without one are not doubted.
    """

    level: Verdict
    short: str
    sentence: str
    is_local: bool = True


Rule = Callable[[RunFacts, HealthNumbers, Sequence[HealthSpan]], "Finding | None"]


def _no_path(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """One pose is no path."""
    poses = len(facts.trajectory)
    if poses >= 2:
        return None
    text = "no frame has a pose" if poses == 0 else "a single frame has a pose"
    return Finding(Verdict.NOT_TRUSTWORTHY, text, f"{text[0].upper()}{text[1:]}: there is no path.")


def _losses(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Lost frames are a hole, and only a relocalisation ties its two sides together.

    A covered lens looks the same, and leaves the same hole. Few losses of less than a second each, as at a
    blurred image, leave a result good.
    """
    share = numbers.lost_share or 0.0
    if share < _SOME_LOST and numbers.longest_loss_s < LONG_S:
        return None
    where = _where(spans, SpanKind.LOST)
    is_lost_at_the_end = bool(facts.steps) and facts.is_lost(facts.steps[-1])
    end = "it was not found again" if is_lost_at_the_end else "parts before and after may not fit together"
    return Finding(
        _level_of(share),
        f"{percent(share)} of the frames were lost ({where})",
        f"The camera was lost for {percent(share)} of the frames: {where}. The longest loss took "
        f"{numbers.longest_loss_s:.1f} s; {end}.",
    )


def _withdrawn(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A pose was believed and then taken out. What is left is the better for it, but tracking had gone wrong
    there unnoticed, and may have elsewhere.

    A single blurred image does the same, so that a few are stated and no doubt.
    """
    share = numbers.withdrawn_share or 0.0
    if not share:
        return None
    where = _where(spans, SpanKind.WITHDRAWN)
    return Finding(
        _level_of(share) if share >= _SOME_LOST else Verdict.GOOD,
        f"{percent(share)} of the poses were withdrawn ({where})",
        f"{percent(share)} of the frames have no pose, because what followed did not confirm it: {where}.",
    )


def _several_maps(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Maps that never met have no common frame, so a frame in another map is as good as lost for this one.

    A few frames of another place at the start or the end look the same, and leave the largest map as it is.
    """
    share = numbers.outside_share or 0.0
    if not share:
        return None
    others = "another map" if len(facts.others) == 1 else f"{len(facts.others)} other maps"
    where = _where(spans, SpanKind.OTHER_MAP)
    return Finding(
        _level_of(numbers.missing_share) if share >= _SOME_LOST else Verdict.GOOD,
        f"{percent(share)} of the frames are in {others} ({where})",
        f"{percent(share)} of the frames are in {others} that never met this one: {where}. Maps have no "
        "common frame, and each has its own scale.",
    )


def _leaps(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A camera cannot leap, so one of the two poses, or all that follow, are wrong.

    A real quick turn is confirmed by its neighbours, see :mod:`slamdepth.evaluation.leaps`. A cut in the
    recording is not, so that a single place leaves a result doubtful.
    """
    if not numbers.leaps:
        return None
    where = _where(spans, SpanKind.LEAP)
    many = numbers.leaps >= _MANY_LEAPS
    text = f"{numbers.leaps} leap{'s' if numbers.leaps > 1 else ''}"
    return Finding(
        Verdict.NOT_TRUSTWORTHY if many else Verdict.DOUBTFUL,
        f"{text} ({where})",
        f"The path has {text} that no motion before or after confirms: {where}. Unless the recording was cut "
        "there, poses next to it are wrong.",
    )


def _weak_tracking(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """With few inliers one group of wrong matches decides the pose.

    A passing hand or a quick turn does the same for less than a second, which the motion bridges. A few
    frames at the end of a map, before the camera was lost, are stated and no doubt.
    """
    share = numbers.weak_share or 0.0
    if not share:
        return None
    where = _where(spans, SpanKind.WEAK)
    level = Verdict.NOT_TRUSTWORTHY if share > _MOSTLY else Verdict.DOUBTFUL
    return Finding(
        level if _is_long(spans, SpanKind.WEAK, share) else Verdict.GOOD,
        f"weak tracking ({where})",
        f"Fewer than {WEAK * facts.least_inliers} map points agreed with each pose, for a second or more or "
        f"next to a loss: {where}.",
    )


def _registration(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A flat wall leaves three of six degrees of freedom open, and predicted depth is no measurement.

    Standing before a white wall with a sensor looks the same. Measured depth fixes distance and tilt there,
    so that only a large share is a doubt.
    """
    if not any(span.kind is SpanKind.REGISTERED for span in spans):
        return None
    share = numbers.registered_share or 0.0
    where = _where(spans, SpanKind.REGISTERED)
    is_long = _is_long(spans, SpanKind.REGISTERED, share)
    is_much = share > _MUCH_REGISTERED if facts.depth_is_measured else is_long
    return Finding(
        Verdict.DOUBTFUL if is_much else Verdict.GOOD,
        f"{percent(share)} placed by depth alone ({where})",
        f"The shape of the {'measured' if facts.depth_is_measured else 'predicted'} depth alone placed "
        f"{percent(share)} of the frames: {where}. Along a flat wall such poses may slide.",
    )


def _moving_things(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """What moves by itself is in the map for a moment and in the mesh for good, and can draw a pose along.

    A few of many matches are refused as outliers, so that the path is doubted only where most of what is seen
    moves: then it is not known which of the two stands still. Reflections and the camera's own shadow move,
    too.
    """
    if not numbers.moving_share:
        return None
    where = _where(spans, SpanKind.MOVING)
    return Finding(
        Verdict.DOUBTFUL if numbers.moving_share > _MOSTLY else Verdict.GOOD,
        f"things move ({where})",
        f"Up to {percent(numbers.moving_share)} of what is seen moves by itself: {where}. Moving things are "
        "left out of the path as far as they are outnumbered, not out of the mesh.",
    )


def _short_map(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A map that was started because tracking had failed, and in which it soon failed again.

    A short recording in one map is no such case.
    """
    times_s = facts.trajectory.timestamps_s
    if not facts.others or len(times_s) < 2 or times_s[-1] - times_s[0] >= GOOD_SPAN_S:
        return None
    length_s = float(times_s[-1] - times_s[0])
    return Finding(
        Verdict.DOUBTFUL,
        f"{length_s:.1f} s are too short to judge",
        f"The camera was in this map for {length_s:.1f} s only, too short to judge it.",
    )


def _late_start(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Without a map there is no path. What follows a dark start can be sound, so this is only a doubt."""
    share = numbers.no_map_share or 0.0
    if share <= _LONG_START:
        return None
    where = _where(spans, SpanKind.NO_MAP)
    return Finding(
        Verdict.DOUBTFUL,
        f"no map for {percent(share)} of the frames",
        f"No map could be started for {percent(share)} of the frames: {where}.",
    )


def _keyframe_rate(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A keyframe at nearly every frame: what was mapped is hardly found in the very next image.

    At a few frames a second every image is a new view, so such footage is not judged by this.
    """
    rate = numbers.frames_per_keyframe
    placed = len(facts.trajectory)
    if rate is None or placed < _FEW_FRAMES or rate >= _FRAMES_PER_KEYFRAME or facts.frame_s >= MAX_STEP_S:
        return None
    return Finding(
        Verdict.DOUBTFUL,
        "landmarks are hardly found again",
        f"Every {rate:.1f} frames the map needed a new keyframe: landmarks are hardly found again.",
        is_local=False,
    )


def _refused_loops(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Verified loops that contradict the path are wrong where places look alike, right where it has drifted.

    It can have drifted where few points held it for a second, or where tracking failed however shortly, and
    it has been led astray where it was corrected by more than odometry drifts. Where none of this is so,
    places look alike and the path is right. A few refused loops are normal.
    """
    refused, closed = numbers.loops_refused, numbers.loop_closures
    if refused < _FEW_REFUSED or refused <= closed:
        return None
    weakest, correction = numbers.weakest_second, numbers.correction_share
    is_strong = weakest is not None and weakest >= _STRONG
    is_steady = correction is not None and correction <= _DRIFT_SHARE
    is_whole = not (numbers.leaps or numbers.withdrawn_share or numbers.lost_share)
    is_sure = is_strong and is_steady and is_whole
    why = "Either places look alike here, or the path has drifted"
    if is_sure:
        why = "Places look alike here"
    elif not is_strong:
        why += " where few map points held it"
    elif correction is not None and not is_steady:
        why += f"; loops and adjustment moved it by {percent(correction)} of its length"
    elif not is_whole:
        why += " where tracking failed"
    return Finding(
        Verdict.GOOD if is_sure else Verdict.DOUBTFUL,
        f"{refused} loops contradicted the path",
        f"{refused} loops were refused because they contradict the path; loops closed: {closed}. {why}.",
        is_local=False,
    )


def _scale(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Keyframes that disagree on the scale by more than the network errs: the map is not of one size.

    A single odd view is an outlier of the robust spread. A scale that is wrong everywhere leaves the shape
    right; ``scale`` in the report says what is known of it.
    """
    spread = numbers.scale_spread_log
    if not facts.trajectory.is_metric or not facts.scale_is_known:
        what = "size of the path" if facts.trajectory.is_metric else "unit of length"
        return Finding(
            Verdict.GOOD, "scale unknown", f"The {what} is unknown: the path has a shape, no size."
        )
    if spread is None or spread <= _SCALE_SPREAD_LOG:
        return None
    return Finding(
        Verdict.DOUBTFUL,
        "the scale varies along the path",
        f"Keyframes disagree on the scale by a factor of {np.exp(spread):.1f} (one standard deviation).",
        is_local=False,
    )


def _guessed_camera(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """A wrong focal length bends the path and stretches the map along the view.

    It does so however well everything was tracked, and no other figure shows it. Motion that tells nothing
    of the focal length looks the same with any.
    """
    if not facts.camera_is_guessed:
        return None
    return Finding(
        Verdict.DOUBTFUL,
        "the focal length is a guess",
        "The focal length was guessed, and the motion does not show it: the path may be bent. Give --fov or "
        "--camera.",
        is_local=False,
    )


def _sparse_footage(facts: RunFacts, numbers: HealthNumbers, spans: Sequence[HealthSpan]) -> Finding | None:
    """Says what could not be judged; that is no evidence against the result."""
    if leaps_are_judged(numbers):
        return None
    return Finding(
        Verdict.GOOD,
        "leaps not judged",
        f"Most frames are over {MAX_STEP_S:g} s apart, so that leaps cannot be told from real motion.",
    )


RULES: tuple[Rule, ...] = (
    _no_path,
    _losses,
    _withdrawn,
    _several_maps,
    _short_map,
    _leaps,
    _weak_tracking,
    _registration,
    _moving_things,
    _late_start,
    _keyframe_rate,
    _refused_loops,
    _scale,
    _guessed_camera,
    _sparse_footage,
)


def leaps_are_judged(numbers: HealthNumbers) -> bool:
    """Whether most steps are short enough in time to be told from a leap."""
    return numbers.judged_step_share is None or numbers.judged_step_share >= _MOSTLY


def _is_long(spans: Sequence[HealthSpan], kind: SpanKind, share: float) -> bool:
    """Whether one span of a kind lasts a second, or all are a share of the frames that matters."""
    longest_s = max((span.duration_s for span in spans if span.kind is kind), default=0.0)
    return longest_s >= LONG_S or share >= _SOME_LOST


def _level_of(missing: float) -> Verdict:
    """How grave it is that a share of all frames is missing, given that it matters at all."""
    return Verdict.NOT_TRUSTWORTHY if missing > _MUCH_LOST else Verdict.DOUBTFUL


def _where(spans: Sequence[HealthSpan], kind: SpanKind) -> str:
    """The longest spans of a kind, in order of time."""
    chosen = [span for span in spans if span.kind is kind]
    longest = sorted(chosen, key=lambda span: -span.duration_s)[:_SHOWN]
    named = ", ".join(str(span) for span in sorted(longest, key=lambda span: span.from_s))
    return f"{named}, ..." if len(chosen) > _SHOWN else named


def percent(share: float) -> str:
    """Whole per cents; never 0 for some, nor 100 for not all."""
    whole = round(100 * share)
    if share > 0 and whole == 0:
        return "under 1 %"
    return "over 99 %" if share < 1 and whole == 100 else f"{whole} %"
