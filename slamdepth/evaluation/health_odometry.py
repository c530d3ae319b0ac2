# SPDX-License-Identifier: Apache-2.0
"""How certain the odometry of a run was: by how many points it was held, and how far it was corrected."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from slamdepth.evaluation.health_facts import RunFacts
from slamdepth.evaluation.health_spans import LONG_S
from slamdepth.geometry import umeyama


def correction_share(facts: RunFacts) -> float | None:
    """The largest distance that a pose was moved by after it was first placed, as a share of the path.

    Loops and adjustment move poses. The poses as they were first placed are aligned with the final ones by a
    similarity (with a sensor by a rigid motion), in parts, where maps were joined.

    Returns:
        None where steps were not kept, or the camera stood still.
    """
    trajectory = facts.trajectory
    final_w = dict(zip(trajectory.timestamps_s.tolist(), trajectory.T_world_camera[:, :3, 3], strict=True))
    length = float(np.linalg.norm(np.diff(trajectory.T_world_camera[:, :3, 3], axis=0), axis=1).sum())
    if not length > 0.0:
        return None
    placed = [
        (step.map_id, step.T_world_camera[:3, 3], final_w[step.timestamp_s])
        for step in facts.steps
        if step.T_world_camera is not None and step.timestamp_s in final_w
    ]
    moved = []
    for _, part in groupby(sorted(placed, key=lambda one: one[0]), key=lambda one: one[0]):
        _, first, final = zip(*part, strict=True)
        source, target = np.array(first), np.array(final)
        scale, R, t = umeyama(source, target, with_scale=not facts.depth_is_measured)
        moved.append(float(np.linalg.norm(scale * source @ R.T + t - target, axis=1).max()))
    return max(moved) / length if moved else None


def weakest_second(facts: RunFacts) -> float | None:
    """The fewest points that held poses for a second: the smallest median of inliers over a second.

    Returns:
        None where fewer than two frames are a second apart.
    """
    inside = [step for step in facts.steps if step.timestamp_s in facts.members]
    times_s = np.array([step.timestamp_s for step in inside])
    inliers = np.array([step.inliers for step in inside])
    ends = np.searchsorted(times_s, times_s + LONG_S, side="right")
    whole = np.flatnonzero(times_s <= times_s[-1:] - LONG_S)
    return min((float(np.median(inliers[n : ends[n]])) for n in whole), default=None)
