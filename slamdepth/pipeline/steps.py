# SPDX-License-Identifier: Apache-2.0
"""The results of frames as arrays, for checkpoints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.io.tree import Tree
from slamdepth.types import StepResult, TrackingStatus

_STATUSES = tuple(TrackingStatus)


def steps_state(steps: Sequence[StepResult]) -> Tree:
    """Results as arrays."""
    count = len(steps)
    none, no_covariance = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    stages = list(dict.fromkeys(stage for step in steps for stage in step.timings_ms))
    return {
        "numbers": np.array(
            [
                (
                    step.index,
                    _STATUSES.index(step.status),
                    step.inliers,
                    step.is_keyframe,
                    step.keyframes,
                    step.loop_closures,
                    step.map_id,
                )
                for step in steps
            ],
            dtype=np.int64,
        ).reshape(count, 7),
        "timestamp_s": np.array([step.timestamp_s for step in steps], dtype=np.float64),
        "quality": np.array([step.quality for step in steps], dtype=np.float64),
        "moving_share": np.array(
            [np.nan if step.moving_share is None else step.moving_share for step in steps], dtype=np.float64
        ),
        "T_world_camera": np.array(
            [none if step.T_world_camera is None else step.T_world_camera for step in steps]
        ).reshape(count, 4, 4),
        "covariance": np.array(
            [no_covariance if step.covariance is None else step.covariance for step in steps]
        ).reshape(count, 6, 6),
        "stages": stages,
        "timings_ms": np.array(
            [[step.timings_ms.get(stage, np.nan) for stage in stages] for step in steps], dtype=np.float64
        ).reshape(count, len(stages)),
    }


def steps_of(state: Tree) -> tuple[StepResult, ...]:
    """What :func:`steps_state` was given."""
    steps = []
    for n, (index, status, inliers, is_keyframe, keyframes, loops, map_id) in enumerate(
        state["numbers"].tolist()
    ):
        pose, covariance = state["T_world_camera"][n], state["covariance"][n]
        moving = float(state["moving_share"][n])
        timings = zip(state["stages"], state["timings_ms"][n].tolist(), strict=True)
        steps.append(
            StepResult(
                index=index,
                timestamp_s=float(state["timestamp_s"][n]),
                status=_STATUSES[status],
                T_world_camera=None if np.isnan(pose).any() else pose,
                inliers=inliers,
                is_keyframe=bool(is_keyframe),
                keyframes=keyframes,
                loop_closures=loops,
                timings_ms={stage: ms for stage, ms in timings if ms == ms},
                map_id=map_id,
                covariance=None if np.isnan(covariance).any() else covariance,
                quality=float(state["quality"][n]),
                moving_share=None if np.isnan(moving) else moving,
            )
        )
    return tuple(steps)
