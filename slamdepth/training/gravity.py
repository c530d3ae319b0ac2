# SPDX-License-Identifier: Apache-2.0
"""Where down is in an image of a place."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamdepth.depth.vanishing import gravity_if_upright
from slamdepth.training.data import Place
from slamdepth.types import Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_MOST_REMEMBERED = 1 << 16
_MOST_PLACES = 256

_found: dict[tuple[str, str, int], NDArray[np.float64] | None] = {}
_fingerprints: dict[int, tuple[Place, str]] = {}


def down_of(place: Place, index: int, frame: Frame | None = None) -> NDArray[np.float64] | None:
    """Unit direction of gravity ``(3,)`` in the camera's frame: what ``place`` says of image ``index``
    or else its lines, remembered; None where neither tells.

    Args:
        frame: the image, where it is at hand.
    """
    if (told := place.down(index)) is not None:
        return told
    key = (_fingerprint(place), place.name, index)
    if key not in _found:
        frame = place.read(index) if frame is None else frame
        while len(_found) >= _MOST_REMEMBERED:
            del _found[next(iter(_found))]
        _found[key] = gravity_if_upright(frame.image_rgb, frame.camera)
    return _found[key]


def _fingerprint(place: Place) -> str:
    """That of ``place``, which looks at all its files, found once."""
    if id(place) not in _fingerprints:
        if len(_fingerprints) >= _MOST_PLACES:
            _fingerprints.clear()
        _fingerprints[id(place)] = (place, place.fingerprint)  # held, so that no other gets its id
    return _fingerprints[id(place)][1]
