# SPDX-License-Identifier: Apache-2.0
"""Features of two images that move together against a static world."""

from __future__ import annotations

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.frontend.features import Features
from slamdepth.frontend.matching import best_matches
from slamdepth.frontend.pose import CELLS, cells_of
from slamdepth.geometry import backproject, transform
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_REACH = 0.08  # of the image's width: what moves farther is not found again
_RATIO = 0.8
_NEAREST = 0.1  # of the scene's distance: nothing static is taken to be nearer
_SIGMAS, _POSE_PX = 3.0, 1.5  # that a static feature may be off its line, and for the error of the poses
_FEWEST_PAIRS = 50
_NEVER, _LEVELS = -100, 256  # a level that no feature is near to, and more levels than any extractor has
_FEWEST_TOGETHER = 5  # in a cell of the image; with fewer, wrong matches point the same way by chance


def moving_share(
    camera: Camera,
    before: Features,
    now: Features,
    free_before: Ints,
    free_now: Ints,
    static_px: Floats,
    T_now_before: Floats,
    distance: float,
) -> float | None:
    """Share of the features seen in both images that move together against the static world.

    A static feature moves along its epipolar line, from where it would be at infinity to where it would be
    at a tenth of the scene's distance. Of those that do not, only groups count: five or more in one of
    8 x 8 cells of the image, no fewer than half of the static ones there, whose mean offset from that line is
    larger than their scatter about it. Wrong matches point in all directions; repeated patterns, whose wrong
    matches do not, are mostly refused by the ratio test.

    Args:
        camera: without distortion.
        free_before, free_now: indices ``(N,)`` and ``(M,)`` of the features that are not known to be static.
        static_px: ``(S, 2)`` where those that both images are known to show lie now.
        T_now_before: ``(4, 4)`` motion of the camera.
        distance: of the scene, in the unit of the motion.

    Returns:
        None where fewer than 50 features are seen in both images.
    """
    at_before, at_now = _matched(camera, before, now, free_before, free_now, T_now_before, distance)
    total = len(at_now) + len(static_px)
    if total < _FEWEST_PAIRS:
        return None
    px = now.px[at_now]
    off = _off_line(camera, before.px[at_before], px, T_now_before, distance)
    limit = _POSE_PX + _SIGMAS * np.hypot(before.sigma_px[at_before], now.sigma_px[at_now])
    is_off = np.einsum("ni,ni->n", off, off) > limit * limit
    count = CELLS * CELLS
    static = np.bincount(cells_of(camera, static_px.T), minlength=count)
    static += np.bincount(cells_of(camera, px[~is_off].T), minlength=count)
    cell, off = cells_of(camera, px[is_off].T), off[is_off]
    together = np.bincount(cell, minlength=count)
    some = np.maximum(together, 1)
    mean = np.stack([np.bincount(cell, of_one, count) / some for of_one in off.T])
    mean_square = np.bincount(cell, np.sum(off * off, axis=1), count) / some
    is_together = 2.0 * np.sum(mean * mean, axis=0) > mean_square  # the mean exceeds the scatter
    is_moving = is_together & (together >= _FEWEST_TOGETHER) & (2 * together >= static)
    return float(together[is_moving].sum()) / total


def _matched(
    camera: Camera,
    before: Features,
    now: Features,
    free_before: Ints,
    free_now: Ints,
    T_now_before: Floats,
    distance: float,
) -> tuple[Ints, Ints]:
    """Free features of both images, matched near where the motion of the camera takes them."""
    expected = _seen_at(camera, before.px[free_before], T_now_before, distance)
    words_before, words, fast = before.words, now.words, loops()
    if fast is not None and words_before is not None and words is not None and len(now) and len(free_before):
        free_level = np.full(len(now), _NEVER)
        free_level[free_now] = now.octave[free_now]
        reach = _REACH * camera.width
        b, n, _ = fast.matching.match(
            expected,
            np.zeros((len(expected), 2, 2)),
            before.octave[free_before],
            words_before[free_before],
            *now.grid.cells,
            now.px,
            free_level,
            words,
            np.full(_LEVELS, 1.0),
            reach * (1.0 + 1e-9),  # the ellipse is open, the circle of the largest distance closed
            reach,
            0.0,
            1.0,
            now.metric.strict_distance,
            _RATIO,
        )
        return free_before[b], n
    b, n = now.grid.pairs_within(expected, np.full(len(expected), _REACH * camera.width))
    b = free_before[b]
    is_free = np.zeros(len(now), dtype=bool)
    is_free[free_now] = True
    ok = np.flatnonzero(is_free[n] & (np.abs(now.octave[n] - before.octave[b]) <= 1))
    b, n = b[ok], n[ok]
    metric = now.metric
    apart = metric.between(before.descriptors[b], now.descriptors[n])
    b, n, _ = best_matches(b, n, apart, max_distance=metric.strict_distance, ratio=_RATIO)
    return b, n


def _off_line(camera: Camera, px_before: Floats, px_now: Floats, T: Floats, distance: float) -> Floats:
    """Offsets ``(N, 2)`` of pixels from the nearest point of where a static feature could be seen."""
    far = _seen_at(camera, px_before, T, np.inf)
    way = _seen_at(camera, px_before, T, _NEAREST * distance) - far
    off = px_now - far
    share = np.einsum("ni,ni->n", off, way) / np.maximum(np.einsum("ni,ni->n", way, way), 1e-12)
    return np.asarray(off - np.clip(share, 0.0, 1.0)[:, None] * way)


def _seen_at(camera: Camera, px: Floats, T: Floats, depth: float) -> Floats:
    """Pixels ``(N, 2)`` after a motion ``(4, 4)`` of points at one depth; infinity leaves the rotation."""
    rays = backproject(camera, px, np.ones(len(px)))
    moved = rays @ T[:3, :3].T if np.isinf(depth) else transform(T, depth * rays)
    z = np.maximum(moved[:, 2], 1e-3)
    return np.column_stack([camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy])
