# SPDX-License-Identifier: Apache-2.0
"""How long the stages of each frame take."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds by the name of the stage, for the frame at hand and on average."""

    def __init__(self) -> None:
        self.frame_ms: dict[str, float] = {}
        self._total_ms: dict[str, float] = defaultdict(float)
        self._times: dict[str, int] = defaultdict(int)

    def next_frame(self) -> None:
        """Begin with another frame; what was handed out stays as it is."""
        self.frame_ms = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measure what happens inside."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, (time.perf_counter() - start) * 1e3)

    def add(self, stage: str, ms: float) -> None:
        """Count time that was measured elsewhere."""
        self.frame_ms[stage] = self.frame_ms.get(stage, 0.0) + ms
        self._total_ms[stage] += ms
        self._times[stage] += 1

    def mean_ms(self) -> dict[str, float]:
        """Mean over all times a stage was measured."""
        return {stage: total / self._times[stage] for stage, total in self._total_ms.items()}

    def calls(self) -> dict[str, int]:
        """How often each stage was measured."""
        return dict(self._times)
