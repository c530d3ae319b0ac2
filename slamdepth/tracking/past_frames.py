# SPDX-License-Identifier: Apache-2.0
"""The frames of earlier recordings in a map that a run goes on from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth.mapping.map_keyframe import AnchoredPose, MapKeyframe


class PastFrames:
    """Frames of saved recordings, relative to a keyframe each: they move with the map.

    See ``frames`` in :data:`slamdepth.mapstore.format.ARRAYS`.
    """

    def __init__(self) -> None:
        self._times_s: list[float] = []
        self._sessions: list[int] = []
        self._poses: list[AnchoredPose] = []

    def __len__(self) -> int:
        return len(self._poses)

    def count(self, session: int) -> int:
        """Number of frames of a recording."""
        return self._sessions.count(session)

    def add(self, timestamp_s: float, session: int, pose: AnchoredPose) -> None:
        """Remember one frame."""
        self._times_s.append(timestamp_s)
        self._sessions.append(session)
        self._poses.append(pose)

    def renumber_sessions(self, first: int) -> None:
        """The recordings follow behind ``first`` others from now on."""
        self._sessions = [first + session for session in self._sessions]

    def absorb(self, other: PastFrames) -> None:
        """Take over the frames of another map."""
        self._times_s += other._times_s
        self._sessions += other._sessions
        self._poses += other._poses

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The frames as arrays."""
        return {
            "timestamp_s": np.array(self._times_s, dtype=np.float64),
            "session": np.array(self._sessions, dtype=np.int64),
            **AnchoredPose.arrays(self._poses),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]], keyframes: Sequence[MapKeyframe]) -> None:
        """Remember what :meth:`arrays` gave."""
        self._times_s = arrays["timestamp_s"].tolist()
        self._sessions = arrays["session"].tolist()
        self._poses = AnchoredPose.of_arrays(arrays, keyframes)
