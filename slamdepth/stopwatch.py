# SPDX-License-Identifier: Apache-2.0
"""Wall time of the stages of a run."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds per stage, of the current frame and on average."""

    def __init__(self) -> None:
        self.frame_ms: dict[str, float] = {}
        self._total_ms: dict[str, float] = defaultdict(float)
        self._times: dict[str, int] = defaultdict(int)

    def next_frame(self) -> None:
        """Start the next frame; dictionaries handed out before do not change."""
        self.frame_ms = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measure the body of a ``with`` statement."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, (time.perf_counter() - start) * 1e3)

    def add(self, stage: str, ms: float) -> None:
        """Add time that was measured elsewhere."""
        self.frame_ms[stage] = self.frame_ms.get(stage, 0.0) + ms
        self._total_ms[stage] += ms
        self._times[stage] += 1

    def mean_ms(self) -> dict[str, float]:
        """Mean over all calls of each stage."""
        return {stage: total / self._times[stage] for stage, total in self._total_ms.items()}

    def state(self) -> dict[str, list[float]]:
        """Total milliseconds and number of calls of each stage."""
        return {stage: [total, self._times[stage]] for stage, total in self._total_ms.items()}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Go on from what :meth:`state` gave."""
        for stage, (total, times) in state.items():
            self._total_ms[stage], self._times[stage] = total, int(times)

    def calls(self) -> dict[str, int]:
        """Number of calls of each stage."""
        return dict(self._times)
