# SPDX-License-Identifier: Apache-2.0
"""Values known at some pixels, spread over the image by its edges."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Bytes, Floats32

_EDGE_GREY = 8.0  # a step of so many grey values ties two pixels less by e
_LEAST_TIE = 1e-3
_COARSEST_PX = 24
_STEPS = 40


def spread(values: Floats32, weight: Floats32, grey: Bytes, range_px: float) -> tuple[Floats32, Floats32]:
    """Fill an image from weighted values, smoothly but for edges of the image.

    Minimises ``sum weight (x - value)^2 + sum tie (x_i - x_j)^2 + sum (x / range_px)^2`` over neighbours i and
    j (weighted least squares, Farbman et al., SIGGRAPH 2008), by conjugate gradients from coarse to fine. Far
    from any value, in units of ``range_px``, the result goes to zero.

    Args:
        values: ``(h, w)``, finite.
        weight: ``(h, w)``, 0 where the value says nothing; 1 counts as much as one neighbour.
        grey: ``(h, w)``.
        range_px: how far a value reaches over an even image.

    Returns:
        ``(x (h, w), share (h, w))``: the second is the same of values of one, so the share of the result
        that values account for, 0 to 1.
    """
    both = np.stack([values * weight, weight]).astype(np.float32)
    x = _solved(both, weight.astype(np.float32), grey.astype(np.float32), float(range_px))
    return x[0], np.clip(x[1], 0.0, 1.0)


def _solved(right: Floats32, weight: Floats32, grey: Floats32, range_px: float) -> Floats32:
    import cv2

    height, width = weight.shape
    start = np.zeros_like(right)
    if min(height, width) >= 2 * _COARSEST_PX:
        size = (width // 2, height // 2)

        def half(image: Floats32) -> Floats32:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

        # a coarse pixel stands for four: its data count four times as much, its ties as before
        coarse = _solved(
            4.0 * np.stack([half(one) for one in right]), 4.0 * half(weight), half(grey), range_px / 2
        )
        for n, one in enumerate(coarse):
            start[n] = cv2.resize(one, (width, height), interpolation=cv2.INTER_LINEAR)
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
        step = across * (x[:, :, :-1] - x[:, :, 1:])
        result[:, :, :-1] += step
        result[:, :, 1:] -= step
        step = down * (x[:, :-1] - x[:, 1:])
        result[:, :-1] += step
        result[:, 1:] -= step
        return np.asarray(result, np.float32)

    return _conjugate_gradients(product, diagonal, right, start)


def _ties(step: Floats32) -> Floats32:
    return np.asarray(np.exp(-step / _EDGE_GREY) + _LEAST_TIE, np.float32)


def _conjugate_gradients(product, diagonal: Floats32, right: Floats32, x: Floats32) -> Floats32:  # type: ignore[no-untyped-def]
    """Preconditioned by the diagonal; two right-hand sides at a time."""
    residual = right - product(x)
    z = residual / diagonal
    direction = z.copy()
    old = _dot(residual, z)
    for _ in range(_STEPS):
        image = product(direction)
        step = old / np.maximum(_dot(direction, image), 1e-20)
        x = x + step * direction
        residual = residual - step * image
        z = residual / diagonal
        new = _dot(residual, z)
        direction = z + (new / np.maximum(old, 1e-20)) * direction
        old = new
    return x


def _dot(a: Floats32, b: Floats32) -> Floats32:
    return np.asarray(np.einsum("nij,nij->n", a, b, dtype=np.float64)[:, None, None], np.float32)
