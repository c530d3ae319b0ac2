# SPDX-License-Identifier: Apache-2.0
"""Values known at some pixels, spread over the image by its edges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slamdepth.typing import Bytes, Floats32

REACH_PX = 60.0
"""How far what a pixel says reaches over an even image."""

_EDGE_GREY = 8.0  # a step of so many grey values ties two pixels less by e
_LEAST_TIE = 1e-3
_COARSEST_PX = 24
_STEPS = 40


def spread(values: Floats32, weight: Floats32, grey: Bytes, range_px: float) -> Floats32:
    """Fill an image from weighted values, smoothly but for edges of the image.

    Minimises ``sum weight (x - value)^2 + sum tie (x_i - x_j)^2 + sum (x / range_px)^2`` over neighbours i
    and j (weighted least squares, Farbman et al., SIGGRAPH 2008), by conjugate gradients from coarse to
    fine. Far from any value, in units of ``range_px``, the result goes to zero.

    Args:
        values: ``(h, w)``, finite.
        weight: ``(h, w)``, 0 where the value says nothing; 1 counts as much as one neighbour.
        grey: ``(h, w)``.
        range_px: how far a value reaches over an even image.

    Returns:
        ``(h, w)``.
    """
    right = (values * weight).astype(np.float32)
    return _solved(right, weight.astype(np.float32), grey.astype(np.float32), range_px)


def _solved(right: Floats32, weight: Floats32, grey: Floats32, range_px: float) -> Floats32:
    import cv2

    height, width = weight.shape
    start = np.zeros_like(right)
    if min(height, width) >= 2 * _COARSEST_PX:
        size = (width // 2, height // 2)

        def half(image: Floats32) -> Floats32:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

        # a coarse pixel stands for four: its data count four times as much, its ties as before
        coarse = _solved(4.0 * half(right), 4.0 * half(weight), half(grey), range_px / 2)
        start = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    across = _ties(np.abs(np.diff(grey, axis=1)))
    down = _ties(np.abs(np.diff(grey, axis=0)))
    own = weight + np.float32(range_px**-2)
    diagonal = own.copy()
    diagonal[:, :-1] += across
    diagonal[:, 1:] += across
    diagonal[:-1] += down
    diagonal[1:] += down

    def product(x: Floats32) -> Floats32:
        result = own * x
        step = across * (x[:, :-1] - x[:, 1:])
        result[:, :-1] += step
        result[:, 1:] -= step
        step = down * (x[:-1] - x[1:])
        result[:-1] += step
        result[1:] -= step
        return np.asarray(result, np.float32)

    return _conjugate_gradients(product, diagonal, right, start)


def _ties(step: Floats32) -> Floats32:
    return np.asarray(np.exp(-step / _EDGE_GREY) + _LEAST_TIE, np.float32)


def _conjugate_gradients(
    product: Callable[[Floats32], Floats32], diagonal: Floats32, right: Floats32, x: Floats32
) -> Floats32:
    """Some steps from ``x`` to where ``product(x)`` is ``right``, preconditioned by the diagonal."""
    residual = right - product(x)
    z = residual / diagonal
    direction = z.copy()
    old = _dot(residual, z)
    for _ in range(_STEPS):
        if old <= 0.0:
            break
        image = product(direction)
        step = np.float32(old / max(_dot(direction, image), 1e-30))
        x = x + step * direction
        residual = residual - step * image
        z = residual / diagonal
        new = _dot(residual, z)
        direction = z + np.float32(new / old) * direction
        old = new
    return x


def _dot(a: Floats32, b: Floats32) -> float:
    return float(np.einsum("ij,ij->", a, b, dtype=np.float64))
