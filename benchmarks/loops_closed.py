# SPDX-License-Identifier: Apache-2.0
"""Which loops a tracker closed and refused: the only place that looks inside the tracker for them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from slamdepth.tracking import Tracker
from slamdepth.typing import Floats, Ints

_LOG = "slamdepth.loops"


@dataclass(frozen=True)
class ClosedLoop:
    """A loop in the pose graph.

    Attributes:
        earlier, later: ids of its keyframes.
        T_earlier_later: ``(4, 4)`` what the loop measured, in metres of the finished map.
    """

    earlier: int
    later: int
    T_earlier_later: Floats


@dataclass
class Refusals:
    """Loops that were verified by matches and then refused."""

    count: int = 0


def closed_loops(tracker: Tracker) -> list[ClosedLoop]:
    """The loops that ``tracker``, which has finished, accepted and did not take back."""
    units = tracker._map.units
    edges = [loop.in_units(units) for loop in tracker._integration.loops._loops]
    return [ClosedLoop(edge.i, edge.j, edge.T_i_j) for edge in edges]


def covisibility(tracker: Tracker) -> Ints:
    """How many landmarks each two keyframes share, ``(K, K)``."""
    return tracker._map.covisibility()


class _Counter(logging.Handler):
    def __init__(self, refusals: Refusals) -> None:
        super().__init__(logging.INFO)
        self._refusals = refusals

    def emit(self, record: logging.LogRecord) -> None:
        self._refusals.count += "refused" in record.getMessage()


@contextmanager
def counting_refusals() -> Iterator[Refusals]:
    """Count the refusals that the log tells of while the context lasts."""
    logger, refusals = logging.getLogger(_LOG), Refusals()
    handler, level = _Counter(refusals), logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield refusals
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
