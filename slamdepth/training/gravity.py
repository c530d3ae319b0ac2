# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity in the images of a place."""

from __future__ import annotations

from slamdepth.depth.vanishing import gravity_if_upright
from slamdepth.training.data import Place
from slamdepth.types import Frame
from slamdepth.typing import Floats

_MAX_CACHED = 1 << 16
_MAX_PLACES = 256

_found: dict[tuple[str, str, int], Floats | None] = {}
_fingerprints: dict[int, tuple[Place, str]] = {}


def gravity_of(place: Place, index: int, frame: Frame | None = None) -> Floats | None:
    """Unit direction of gravity ``(3,)`` in the camera frame of image ``index`` of ``place``.

    It is the recorded one or else estimated from the lines in the image; estimates are cached.
    None if neither is available.

    Args:
        frame: the image, if it has been read already.
    """
    if (recorded := place.gravity(index)) is not None:
        return recorded
    key = (_fingerprint(place), place.name, index)
    if key not in _found:
        frame = place.read(index) if frame is None else frame
        while len(_found) >= _MAX_CACHED:
            del _found[next(iter(_found))]
        _found[key] = gravity_if_upright(frame.image_rgb, frame.camera)
    return _found[key]


def _fingerprint(place: Place) -> str:
    """The fingerprint of ``place``, computed once: it looks at all files."""
    if id(place) not in _fingerprints:
        if len(_fingerprints) >= _MAX_PLACES:
            _fingerprints.clear()
        _fingerprints[id(place)] = (place, place.fingerprint)  # kept alive, so that its id stays unique
    return _fingerprints[id(place)][1]
