# SPDX-License-Identifier: Apache-2.0
"""An AprilTag or ArUco marker on a wall of the synthetic room."""

from __future__ import annotations

import numpy as np

from slamdepth.fiducial import MarkerSpec
from slamdepth.synth.paint import flat
from slamdepth.synth.shapes import Paint, Surface, quad
from slamdepth.typing import Floats32

_CENTRE_M = (2.27, 3.994, 1.05)
"""On the north wall, over the desk, between the screen and the lamp."""
_FINE = 40  # pixels per cell before the print is brought to the size of the texture


def marker_print(spec: MarkerSpec) -> Paint:
    """The marker (number 0 unless ``spec`` names one) with a quiet zone of one cell on paper."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        import cv2

        dictionary = spec.dictionary()
        cells = dictionary.markerSize + 2
        fine = cv2.aruco.generateImageMarker(dictionary, spec.id or 0, cells * _FINE)
        fine = cv2.copyMakeBorder(fine, _FINE, _FINE, _FINE, _FINE, cv2.BORDER_CONSTANT, value=255)
        ink = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        image = flat(height, width, (0.04, 0.04, 0.05))
        image += ink[..., None] * (flat(height, width, (0.92, 0.92, 0.90)) - image)
        return image

    return paint


def hung_marker(spec: MarkerSpec) -> Surface:
    """The marker as a sheet on the north wall, its black square ``spec.side_m`` wide."""
    cells = spec.dictionary().markerSize + 2
    side = spec.side_m * (cells + 2) / cells
    x, y, z = _CENTRE_M
    corner = (x - side / 2, y, z + side / 2)
    return quad(corner, (side, 0.0, 0.0), (0.0, 0.0, -side), marker_print(spec))
