# SPDX-License-Identifier: Apache-2.0
"""Alignment of patches, compiled; the twin in NumPy is :func:`slamdepth.frontend.patch_alignment.align`."""

from __future__ import annotations

import math

import numpy as np

from slamdepth.frontend.compiled.jit import compiled, inlined
from slamdepth.typing import Floats, Floats32


@inlined
def _look(
    image: Floats32, scale: float, u: float, v: float, offsets: Floats, weights: Floats32, found: Floats
) -> None:
    """Grey values of a patch about ``u, v`` into ``found (S,)``, with weighted mean 0 and square 1."""
    height, width = image.shape
    mean = 0.0
    for s in range(len(found)):
        x = (u + offsets[s, 0] + 0.5) * scale - 0.5
        y = (v + offsets[s, 1] + 0.5) * scale - 0.5
        x = min(max(x, 0.0), width - 1.0)
        y = min(max(y, 0.0), height - 1.0)
        left, top = int(x), int(y)
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        a, b = x - left, y - top
        above = image[top, left] + a * (image[top, right] - image[top, left])
        below = image[bottom, left] + a * (image[bottom, right] - image[bottom, left])
        found[s] = above + b * (below - above)
        mean += found[s] * weights[s]
    square = 0.0
    for s in range(len(found)):
        found[s] -= mean
        square += found[s] * found[s] * weights[s]
    norm = 1.0 / max(math.sqrt(square), 1e-3)
    for s in range(len(found)):
        found[s] *= norm


@compiled
def align(
    images: tuple[Floats32, Floats32, Floats32],
    count: int,
    values: Floats32,
    gradient: Floats32,
    inverse: Floats,
    spacing_px: Floats,
    warp: Floats,
    px: Floats,
    samples: Floats32,
    weights: Floats32,
    steps: int,
    converged_px: float,
    longest: float,
) -> tuple[Floats, Floats]:
    """Pixels ``(N, 2)`` and correlations ``(N,)``; 0 where a pixel or a warp is not finite.

    Args:
        images: levels of the pyramid, the first ``count`` of which are there.
        values, gradient, inverse, spacing_px: of the templates.
        samples: ``(S, 2)`` of a patch at spacing 1; ``weights``: ``(S,)`` of them.
    """
    n_samples = len(weights)
    out_px, correlation = np.empty((len(px), 2)), np.empty(len(px))
    offsets, found = np.empty((n_samples, 2)), np.empty(n_samples)
    for i in range(len(px)):
        A, B, apart = warp[i], inverse[i], spacing_px[i]
        for s in range(n_samples):
            x, y = samples[s, 0] * apart, samples[s, 1] * apart
            offsets[s, 0] = A[0, 0] * x + A[0, 1] * y
            offsets[s, 1] = A[1, 0] * x + A[1, 1] * y
        spacing = apart * math.sqrt(abs(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]))
        u, v = px[i, 0], px[i, 1]
        out_px[i, 0], out_px[i, 1], correlation[i] = u, v, 0.0
        if not math.isfinite(spacing + u + v):
            continue
        level = min(int(math.log2(max(spacing, 1.0))), count - 1)
        image, scale = images[level], 0.5**level
        for _ in range(steps):
            _look(image, scale, u, v, offsets, weights, found)
            gx, gy = 0.0, 0.0
            for s in range(n_samples):
                off = (found[s] - values[i, s]) * weights[s]
                gx += gradient[0, i, s] * off
                gy += gradient[1, i, s] * off
            hx = B[0, 0] * gx + B[0, 1] * gy
            hy = B[1, 0] * gx + B[1, 1] * gy
            du = -(A[0, 0] * hx + A[0, 1] * hy)
            dv = -(A[1, 0] * hx + A[1, 1] * hy)
            length = math.sqrt(du * du + dv * dv)
            shorter = min(1.0, longest * spacing / max(length, 1e-9))
            u += shorter * du
            v += shorter * dv
            if not (length >= converged_px and math.isfinite(u + v)):
                break
        if not math.isfinite(u + v):
            continue
        _look(image, scale, u, v, offsets, weights, found)
        fit = 0.0
        for s in range(n_samples):
            fit += found[s] * values[i, s] * weights[s]
        out_px[i, 0], out_px[i, 1], correlation[i] = u, v, fit
    return out_px, correlation


def load() -> None:
    """Compile everything here, or read it from the cache."""
    image, one = np.zeros((2, 2), np.float32), np.zeros((1, 1), np.float32)
    align(
        (image, image, image), 1, one, np.zeros((2, 1, 1), np.float32), np.zeros((1, 2, 2)), np.ones(1),
        np.ones((1, 2, 2)), np.zeros((1, 2)), np.zeros((1, 2), np.float32), np.ones(1, np.float32),
        1, 0.1, 1.0,
    )  # fmt: skip
