# SPDX-License-Identifier: Apache-2.0
"""Loops of the tracker compiled by numba, where it can be imported.

Each has a twin in NumPy or OpenCV that is used without numba. They take one core and release the interpreter
lock. The first run compiles them, which takes some 15 seconds; later ones read them from numba's cache.
"""

from __future__ import annotations

import importlib.util
import logging
import os
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

log = logging.getLogger(__name__)

VARIABLE = "SLAMDEPTH_COMPILED"
"""Environment variable that turns compiled loops off with ``0``."""


@dataclass(frozen=True)
class Loops:
    """The compiled loops, as modules of functions.

    Attributes:
        alignment: see :mod:`slamdepth.frontend.compiled.alignment`.
        visible: see :mod:`slamdepth.frontend.compiled.visible`.
        matching: see :mod:`slamdepth.frontend.compiled.matching`.
        pose: see :mod:`slamdepth.frontend.compiled.pose`.
        orb: see :mod:`slamdepth.frontend.compiled.orb`.
        retain: see :mod:`slamdepth.frontend.compiled.retain`.
    """

    alignment: Any
    visible: Any
    matching: Any
    pose: Any
    orb: Any
    retain: Any


def loops() -> Loops | None:
    """The compiled loops; None without numba, or where ``SLAMDEPTH_COMPILED`` is 0."""
    return None if os.environ.get(VARIABLE) == "0" else _loops()


def load() -> None:
    """Compile what tracking needs, or read it from the cache, so that no frame waits for it."""
    if (fast := loops()) is not None:
        log.info("loading compiled loops (the first run compiles them, for some 15 seconds)")
        fast.alignment.load()
        fast.visible.load()
        fast.matching.load()
        fast.pose.load()


@lru_cache(maxsize=1)
def _loops() -> Loops | None:
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        from slamdepth.frontend.compiled import alignment, matching, orb, pose, retain, visible
    except ImportError as error:  # a numba that this NumPy is too new for
        log.warning("numba cannot be used, tracking takes twice as long: %s", error)
        return None
    return Loops(alignment=alignment, visible=visible, matching=matching, pose=pose, orb=orb, retain=retain)
