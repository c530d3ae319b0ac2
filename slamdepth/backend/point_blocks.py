# SPDX-License-Identifier: Apache-2.0
"""Algebra of many 3 x 3 blocks at once, kept by coordinate: ``(6, P)`` is the triangle of P blocks."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""The elements that are kept of a symmetric block, in their order."""


def inverse_factor(H: Floats, damping: float) -> Floats:
    """``(6, P)`` M, lower triangular by rows, with ``M^T M`` the inverse of the damped ``H``."""
    h00, h01, h02, h11, h12, h22 = H
    c00 = np.sqrt(h00 * (1.0 + damping) + 1e-6)
    c10, c20 = h01 / c00, h02 / c00
    c11 = np.sqrt(np.maximum(h11 * (1.0 + damping) + 1e-6 - c10 * c10, 1e-12))
    c21 = (h12 - c20 * c10) / c11
    c22 = np.sqrt(np.maximum(h22 * (1.0 + damping) + 1e-6 - c20 * c20 - c21 * c21, 1e-12))
    m00, m11, m22 = 1.0 / c00, 1.0 / c11, 1.0 / c22
    m10 = -c10 * m00 * m11
    return np.stack([m00, m10, m11, -(c20 * m00 + c21 * m10) * m22, -c21 * m11 * m22, m22])


def times(M: Floats, v: Floats) -> Floats:
    """``M v`` for ``(6, P)`` and ``(3, P)``."""
    return np.stack([M[0] * v[0], M[1] * v[0] + M[2] * v[1], M[3] * v[0] + M[4] * v[1] + M[5] * v[2]])


def transposed_times(M: Floats, v: Floats) -> Floats:
    """``M^T v``."""
    return np.stack([M[0] * v[0] + M[1] * v[1] + M[3] * v[2], M[2] * v[1] + M[4] * v[2], M[5] * v[2]])


def times_transposed(B: Floats, M: Floats) -> Floats:
    """``B M^T`` for ``(C, 3, N)`` and ``(6, N)``."""
    out = np.empty_like(B)
    np.multiply(B[:, 0], M[0], out=out[:, 0])
    np.multiply(B[:, 0], M[1], out=out[:, 1])
    out[:, 1] += B[:, 1] * M[2]
    np.multiply(B[:, 0], M[3], out=out[:, 2])
    out[:, 2] += B[:, 1] * M[4]
    out[:, 2] += B[:, 2] * M[5]
    return out


def inverse(H: Floats) -> Floats:
    """Inverses ``(P, 3, 3)`` of positive definite blocks ``(6, P)``."""
    h00, h01, h02, h11, h12, h22 = H
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    inv_det = 1.0 / (h00 * c00 + h01 * c01 + h02 * c02)
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    full = np.empty((H.shape[1], 3, 3))
    for cofactor, (i, j) in zip((c00, c01, c02, c11, c12, c22), SYMMETRIC, strict=True):
        full[:, i, j] = full[:, j, i] = cofactor * inv_det
    return full
