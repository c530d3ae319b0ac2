# SPDX-License-Identifier: Apache-2.0
"""Which images of a board are used: sharp ones, as different from each other as can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.boards.board import Board, Sighting
from slamdepth.typing import Bytes, Floats

MOST_VIEWS = 40
"""More views make a calibration hardly any more certain, but slower."""

_PROFILE = 41
_REACH = {"charuco": 0.11, "checkerboard": 0.3}
"""How far from an edge its profile is measured, as a share of a square: nothing else is printed there."""
_SHARP_PX = 2.5
"""Width of an edge in a sharp image: the pixel and the lens alone make 1.5."""


@dataclass(frozen=True)
class View:
    """One image of a board.

    Attributes:
        name: of the image, or "frame 12".
        sighting: its corners.
        edge_px: width of the edges between squares: how blurred the image is.
    """

    name: str
    sighting: Sighting
    edge_px: float


def edge_width_px(board: Board, sighting: Sighting, grey: Bytes) -> float:
    """Width of the blurred edges between squares in pixels; infinity where none can be measured.

    An edge's contrast over its steepest slope. Motion blurs edges of one direction: the 80 % quantile counts.
    """
    import cv2

    rows, columns = board.corner_grid
    at = np.full((rows * columns, 2), np.nan)
    at[sighting.ids] = sighting.px
    grid = at.reshape(rows, columns, 2)
    pairs = [(grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])]
    starts = np.concatenate([a.reshape(-1, 2) for a, _ in pairs])
    ends = np.concatenate([b.reshape(-1, 2) for _, b in pairs])
    known = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
    starts, ends = starts[known], ends[known]
    if not len(starts):
        return float("inf")
    along = ends - starts
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length
    reach = _REACH[board.kind] * length
    steps = np.linspace(-1.0, 1.0, _PROFILE)
    places = ((starts + ends) / 2.0)[:, None] + steps[None, :, None] * (across * reach)[:, None]
    maps = places.astype(np.float32)
    profiles = cv2.remap(grey.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    profiles = np.asarray(profiles, np.float64)
    step_px = 2.0 * reach[:, 0] / (_PROFILE - 1)
    contrast = np.abs(profiles[:, -3:].mean(axis=1) - profiles[:, :3].mean(axis=1))
    smooth = (profiles[:, 2:] - profiles[:, :-2]) / 2.0
    slope = np.abs(smooth).max(axis=1) / step_px
    widths = contrast / np.maximum(slope, 1e-9)
    return float(np.quantile(widths, 0.8))


def chosen_views(views: Sequence[View], board: Board, size: tuple[int, int]) -> list[View]:
    """Up to :data:`MOST_VIEWS` views, in their order: farthest points among the sharp ones.

    Views are compared by where the board is, how large, and how it is tilted.
    """
    if not views:
        return []
    widths = np.array([view.edge_px for view in views])
    limit = max(_SHARP_PX, float(np.median(widths)))
    sharp = [view for view in views if view.edge_px <= limit]
    features = np.array([_feature(view.sighting, board, size) for view in sharp])
    weight = 1.0 / np.maximum([view.edge_px for view in sharp], 1.0)
    chosen = [int(np.argmax(weight))]
    nearest = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < min(MOST_VIEWS, len(sharp)):
        best = int(np.argmax(nearest * weight))
        if nearest[best] <= 0:
            break
        chosen.append(best)
        nearest = np.minimum(nearest, np.linalg.norm(features - features[best], axis=1))
    return [sharp[index] for index in sorted(chosen)]


def _feature(sighting: Sighting, board: Board, size: tuple[int, int]) -> Floats:
    """Middle, size and tilt ``(5,)`` of a board in an image, each of about unit range."""
    import cv2

    middle = sighting.px.mean(axis=0) / size
    spread = float(np.sqrt(np.prod(np.std(sighting.px, axis=0) / size)))
    xy = board.corners_mm[sighting.ids, :2]
    xy = (xy - xy.mean(axis=0)) / np.abs(xy - xy.mean(axis=0)).max()
    H, _ = cv2.findHomography(xy, sighting.px, 0)
    tilt = np.zeros(2) if H is None else np.clip(H[2, :2] / H[2, 2], -1.0, 1.0)
    return np.array([*middle, 2.0 * spread, *(2.0 * tilt)])
