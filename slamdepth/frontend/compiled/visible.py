# SPDX-License-Identifier: Apache-2.0
"""Which landmarks an image should show, compiled.

The twin in NumPy is :func:`slamdepth.tracking.landmark_search.visible_landmarks`, which says what the numbers
mean.
"""

from __future__ import annotations

import math

import numpy as np

from slamdepth.frontend.compiled.jit import compiled
from slamdepth.typing import Floats, Ints


@compiled
def visible(
    ids: Ints,
    position_w: Floats,
    covariance_w: Floats,
    direction_w: Floats,
    distance_m: Floats,
    level: Ints,
    T_camera_world: Floats,
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    levels: tuple[float, int],
    nearest_m: float,
    margin_px: float,
    least_cosine: float,
) -> tuple[Ints, Floats, Floats, Ints]:
    """Landmarks expected in an image: ids, pixels ``(N, 2)``, their covariances ``(N, 2, 2)`` and levels.

    Args:
        ids: ``(M,)`` that are tried, rows of the arrays of all landmarks after it.
        intrinsics: fx, fy, cx, cy; ``size``: width, height; ``levels``: their factor and count.
    """
    fx, fy, cx, cy = intrinsics
    width, height = size
    factor, count = levels
    log_factor = math.log(factor)
    T = T_camera_world
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    center_x = -(r00 * tx + r10 * ty + r20 * tz)
    center_y = -(r01 * tx + r11 * ty + r21 * tz)
    center_z = -(r02 * tx + r12 * ty + r22 * tz)
    out_ids = np.empty(len(ids), np.int64)
    out_px = np.empty((len(ids), 2))
    out_covariance = np.empty((len(ids), 2, 2))
    out_level = np.empty(len(ids), np.int64)
    n = 0
    for id_ in ids:
        x, y, z = position_w[id_, 0], position_w[id_, 1], position_w[id_, 2]
        zc = r20 * x + r21 * y + r22 * z + tz
        if zc <= nearest_m:
            continue
        slope_x = (r00 * x + r01 * y + r02 * z + tx) / zc
        slope_y = (r10 * x + r11 * y + r12 * z + ty) / zc
        u, v = fx * slope_x + cx, fy * slope_y + cy
        if not (-margin_px < u < width + margin_px and -margin_px < v < height + margin_px):
            continue
        ox, oy, oz = x - center_x, y - center_y, z - center_z
        distance = max(math.sqrt(ox * ox + oy * oy + oz * oz), 1e-9)
        along = ox * direction_w[id_, 0] + oy * direction_w[id_, 1] + oz * direction_w[id_, 2]
        if along <= least_cosine * distance:
            continue
        found_at = np.rint(level[id_] + math.log(distance_m[id_] / distance) / log_factor)
        if not -1.0 <= found_at <= count:
            continue
        out_ids[n] = id_
        out_px[n, 0], out_px[n, 1] = u, v
        out_level[n] = min(max(int(found_at), 0), count - 1)
        # derivatives of the pixel by the point
        scale_u, scale_v = fx / zc, fy / zc
        u0, u1, u2 = r00 - slope_x * r20, r01 - slope_x * r21, r02 - slope_x * r22
        v0, v1, v2 = r10 - slope_y * r20, r11 - slope_y * r21, r12 - slope_y * r22
        C = covariance_w[id_]
        cu0 = C[0, 0] * u0 + C[0, 1] * u1 + C[0, 2] * u2
        cu1 = C[1, 0] * u0 + C[1, 1] * u1 + C[1, 2] * u2
        cu2 = C[2, 0] * u0 + C[2, 1] * u1 + C[2, 2] * u2
        cv0 = C[0, 0] * v0 + C[0, 1] * v1 + C[0, 2] * v2
        cv1 = C[1, 0] * v0 + C[1, 1] * v1 + C[1, 2] * v2
        cv2 = C[2, 0] * v0 + C[2, 1] * v1 + C[2, 2] * v2
        uv = scale_u * scale_v * (u0 * cv0 + u1 * cv1 + u2 * cv2)
        out_covariance[n, 0, 0] = scale_u * scale_u * (u0 * cu0 + u1 * cu1 + u2 * cu2)
        out_covariance[n, 0, 1] = uv
        out_covariance[n, 1, 0] = uv
        out_covariance[n, 1, 1] = scale_v * scale_v * (v0 * cv0 + v1 * cv1 + v2 * cv2)
        n += 1
    return out_ids[:n].copy(), out_px[:n].copy(), out_covariance[:n].copy(), out_level[:n].copy()


def load() -> None:
    """Compile everything here, or read it from the cache."""
    places, covariance, one, ids = np.ones((1, 3)), np.ones((1, 3, 3)), np.ones(1), np.zeros(1, np.int64)
    of_map = places, covariance, places.copy(), one, ids.copy()
    for array in of_map:
        array.flags.writeable = False  # as those of a map are
    visible(ids, *of_map, np.eye(4), (1.0, 1.0, 0.0, 0.0), (8, 8), (1.2, 8), 0.1, 8.0, 0.5)
