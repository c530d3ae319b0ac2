# SPDX-License-Identifier: Apache-2.0
"""How sure the scale is that predicted depth gives a map.

A network errs on a place as a whole, so its error does not average out over the keyframes of one place:

    sigma^2 = sigma_common^2 + spread^2 / n

``sigma_common`` is the error that the model states for an image as a whole, but at least the ``spread`` of
the keyframes' votes, since an error that varies so much from view to view is not smaller as a whole. ``n`` is
the number of independent votes: not more than there are distinct views, and not more than the votes' own
correlation along the run allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.robust import robust_deviation
from slamdepth.types import DepthKind
from slamdepth.typing import Floats

_OUTLYING = 3.0  # robust standard deviations
_SAME_VIEW = 0.25  # of the median distance of what is seen, and of a field of view
_DRIFT_SIGMAS = 3.0


@dataclass(frozen=True)
class VotedScale:
    """The scale of a map of predicted depth.

    Attributes:
        sigma_log: standard deviation of the natural log of the scale; infinite where most images are like
            nothing the model knows, None where the model does not say.
        votes: number of keyframes that voted.
        independent: number of independent votes among them.
        spread: robust standard deviation of the votes; None without votes.
        drift: change of the votes from the first keyframe to the last where it is significant, else None.
    """

    sigma_log: float | None
    votes: int
    independent: float
    spread: float | None
    drift: float | None = None


def judge_votes(reconstruction: Reconstruction) -> VotedScale:
    """How sure the scale of a map is, from its keyframes' predictions and votes."""
    votes = np.array(reconstruction.statistics.scale_votes, dtype=np.float64)
    common = common_sigma_log([k.prediction.scale_sigma_log for k in reconstruction.keyframes])
    if not len(votes):
        return VotedScale(common, 0, 0.0, None)
    spread = robust_spread(votes)
    independent = max(1.0, min(independent_values(votes), float(distinct_views(reconstruction.keyframes))))
    sigma_log = common
    if common is not None:
        sigma_log = math.hypot(max(common, spread), spread / math.sqrt(independent))
    return VotedScale(sigma_log, len(votes), independent, spread, significant_drift(votes))


def common_sigma_log(stated: Sequence[float | None]) -> float | None:
    """The median of what single images state; infinite where most are, None where most state nothing."""
    known = [sigma for sigma in stated if sigma is not None]
    if 2 * len(known) <= len(stated):
        return None
    median = float(np.quantile(known, 0.5, method="higher"))
    return median if math.isfinite(median) else math.inf


def robust_spread(values: Floats) -> float:
    """Standard deviation ``(N,)`` from the median absolute deviation; of fewer than five, the plain one."""
    if len(values) < 5:
        return float(np.std(values))
    return robust_deviation(values)


def independent_values(values: Floats) -> float:
    """Number of independent values ``(N,)`` that tell the mean of a correlated series as well.

    N divided by the integrated autocorrelation time, estimated by the initial positive sequence (Geyer 1992).
    Outliers are clipped, since they would hide the correlation of the others.
    """
    n = len(values)
    centre, limit = np.median(values), _OUTLYING * robust_spread(values)
    clipped = np.clip(values, centre - limit, centre + limit)
    clipped = clipped - clipped.mean()
    variance = float(clipped @ clipped)
    if n < 4 or variance <= 0:
        return 1.0
    rho = np.correlate(clipped, clipped, mode="full")[n - 1 :] / variance
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    end = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    time = max(1.0, 2.0 * float(pairs[:end].sum()) - 1.0)
    return max(1.0, n / time)


def distinct_views(keyframes: Sequence[Keyframe]) -> int:
    """Number of keyframes that see something that no earlier one sees from about the same place.

    Two views are the same where the places are within a quarter of the median distance of what is seen, and
    the directions within a quarter of the field of view. This is relative, so that the map's own scale does
    not matter.
    """
    kept: list[tuple[Floats, Floats, float, float]] = []
    for keyframe in keyframes:
        values = keyframe.prediction.load().values[::8, ::8]
        seen = values[np.isfinite(values) & (values > 0)]
        if keyframe.prediction.kind is not DepthKind.METRIC or not len(seen):
            continue
        camera, T = keyframe.frame.camera, keyframe.T_world_camera
        near = _SAME_VIEW * keyframe.depth_scale * float(np.median(seen))
        turn = 2 * math.atan(camera.width / (2 * camera.fx))
        place, axis = T[:3, 3], T[:3, 2]
        if not any(
            np.linalg.norm(place - p) < min(near, r) and float(axis @ a) > math.cos(_SAME_VIEW * min(turn, f))
            for p, a, r, f in kept
        ):
            kept.append((place, axis, near, turn))
    return len(kept)


def significant_drift(votes: Floats) -> float | None:
    """Change of ``votes (N,)`` from first to last by a robust line (Theil 1950, Sen 1968).

    None where it is within three standard deviations, or within one of the votes about the line.
    """
    n = len(votes)
    if n < 8:
        return None
    i, j = np.triu_indices(n, k=1)
    slope = float(np.median((votes[j] - votes[i]) / (j - i)))
    rest = votes - slope * np.arange(n)
    drift = slope * (n - 1)
    freedom = max(2.0, min(independent_values(rest), n - 2.0))
    sigma = math.sqrt(12.0 / freedom) * robust_spread(rest)
    return drift if abs(drift) > _DRIFT_SIGMAS * sigma and abs(drift) > robust_spread(rest) else None
