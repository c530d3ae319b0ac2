# SPDX-License-Identifier: Apache-2.0
"""Which keyframes may see any of some landmarks, without looking at all keyframes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from slamdepth.typing import Bools, Ints

_BUCKET = 64  # landmarks; neighbouring ids were created together, and so are seen together


class SightIndex:
    """Buckets of landmarks that each keyframe has ever seen.

    An answer holds all keyframes that see a landmark and some that do not, or do no longer.
    """

    def __init__(self) -> None:
        self._seen = np.zeros((1, 1), dtype=np.bool_)  # (buckets, keyframes)

    def note(self, keyframe: int, ids: Ints) -> None:
        """A keyframe sees the landmarks ``ids``, -1 for none."""
        if len(ids) == 0:
            return
        buckets = int(ids.max()) // _BUCKET + 1
        if buckets > self._seen.shape[0] or keyframe >= self._seen.shape[1]:
            self._grow(buckets, keyframe + 1)
        self._seen[ids[ids >= 0] // _BUCKET, keyframe] = True

    def _grow(self, buckets: int, keyframes: int) -> None:
        shape = [max(have, 2 * need) if have < need else have
                 for have, need in zip(self._seen.shape, (buckets, keyframes), strict=True)]  # fmt: skip
        grown = np.zeros(shape, dtype=np.bool_)
        grown[: self._seen.shape[0], : self._seen.shape[1]] = self._seen
        self._seen = grown

    def rebuild(self, landmark_ids: Iterable[Ints]) -> None:
        """Forget all, and note what each keyframe sees."""
        self._seen = np.zeros_like(self._seen)
        for keyframe, ids in enumerate(landmark_ids):
            self.note(keyframe, ids)

    def candidates(self, is_wanted: Bools) -> list[int]:
        """Keyframes, ascending, that may see any of some landmarks.

        Args:
            is_wanted: ``(size + 1,)`` by landmark; the last stands for none.
        """
        wanted = is_wanted[:-1]
        starts = np.arange(0, len(wanted), _BUCKET)
        if len(starts) == 0:
            return []
        buckets = np.flatnonzero(np.logical_or.reduceat(wanted, starts))
        buckets = buckets[buckets < self._seen.shape[0]]
        return [int(k) for k in np.flatnonzero(self._seen.take(buckets, axis=0).any(axis=0))]
