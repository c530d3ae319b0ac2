# SPDX-License-Identifier: Apache-2.0
"""Which keypoints of which views see a point, and how well they fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.errors import InputError
from slamdepth.export.images import ExportImages
from slamdepth.export.scene import ExportScene
from slamdepth.typing import Bytes, Floats, Ints

MAX_ERROR_PX = 4.0
"""Pixels as tracked. Farther observations are left out, as by COLMAP (``filter_max_reproj_error``)."""
_GREY = 128


@dataclass(frozen=True)
class Tracks:
    """Points with the keypoints that see them; each is seen by two views at least.

    Attributes:
        points_m: ``(P, 3)`` world frame.
        error_px: ``(P,)`` mean reprojection error of each point.
        keypoints_px: of each view, ``(N, 2)`` pixels of the exported image.
        rows: of each view, ``(N,)`` row of the point that each keypoint sees, -1 for none.
        mean_error_px: over all observations.
        dropped: observations that were left out.
    """

    points_m: Floats
    error_px: Floats
    keypoints_px: tuple[Floats, ...]
    rows: tuple[Ints, ...]
    mean_error_px: float
    dropped: int

    @property
    def observations(self) -> int:
        """Number of keypoints that see a point."""
        return sum(int(np.count_nonzero(rows >= 0)) for rows in self.rows)


def build_tracks(scene: ExportScene, images: ExportImages) -> Tracks:
    """Project every landmark into the views that see it, and keep what fits.

    Raises:
        InputError: no landmark is seen twice.
    """
    keypoints: list[Floats] = []
    kept: list[Ints] = []
    errors: list[Floats] = []
    offered = 0
    for view in scene.views:
        px, shown = images.keypoints(view)
        rows = np.where(shown, view.point_rows, -1)
        at = np.flatnonzero(rows >= 0)
        projected, ahead = images.project(view, scene.points_m[rows[at]])
        error = np.linalg.norm(projected - px[at], axis=1)
        offered += int(np.count_nonzero(view.point_rows >= 0))
        rows[at[~(ahead & (error <= MAX_ERROR_PX * images.magnification))]] = -1
        full = np.zeros(len(px))
        full[at] = error
        keypoints.append(px[shown])
        kept.append(_once(rows[shown], full[shown]))
        errors.append(full[shown])
    return numbered(scene.points_m, keypoints, kept, errors, offered)[0]


def _once(rows: Ints, error: Floats) -> Ints:
    """Of keypoints of one image that see the same point, only the closest is left."""
    order = np.argsort(error, kind="stable")
    first = order[np.unique(rows[order], return_index=True)[1]]
    keeps = np.zeros(len(rows), np.bool_)
    keeps[first] = True
    return np.where(keeps, rows, -1)


def numbered(
    points_m: Floats,
    keypoints_px: Sequence[Floats],
    rows: Sequence[Ints],
    error_px: Sequence[Floats],
    offered: int,
) -> tuple[Tracks, Ints]:
    """The tracks of the points that two views see or more, numbered anew.

    Args:
        points_m: ``(P, 3)``.
        keypoints_px, rows, error_px: of each view, see :class:`Tracks`.
        offered: observations that there were.

    Returns:
        The tracks, and ``(Q,)`` which of the points each of theirs was.

    Raises:
        InputError: there is no such point.
    """
    views_of = np.zeros(len(points_m), np.int64)
    for one in rows:
        views_of[one[one >= 0]] += 1
    used: Ints = np.flatnonzero(views_of >= 2)
    if len(used) == 0:
        raise InputError("no landmark of this run is seen by two views: there is nothing to export")
    number = np.full(len(points_m) + 1, -1)  # the last is that of no point
    number[used] = np.arange(len(used))
    found = tuple(number[one] for one in rows)
    sums, count = np.zeros(len(used)), np.zeros(len(used))
    for row, error in zip(found, error_px, strict=True):
        at = row >= 0
        np.add.at(sums, row[at], error[at])
        np.add.at(count, row[at], 1.0)
    dropped = offered - int(count.sum())
    tracks = Tracks(
        points_m[used], sums / count, tuple(keypoints_px), found, float(sums.sum() / count.sum()), dropped
    )
    return tracks, used


class Colours:
    """Colours of points, averaged over the views that see them; grey where no image was added."""

    def __init__(self, tracks: Tracks) -> None:
        self._tracks = tracks
        self._sums = np.zeros((len(tracks.points_m), 3))
        self._count = np.zeros(len(tracks.points_m))

    def add(self, number: int, image_rgb: Bytes) -> None:
        """Take the colours of the ``number``-th view from its exported image."""
        rows = self._tracks.rows[number]
        at = rows >= 0
        x, y = np.rint(self._tracks.keypoints_px[number][at]).astype(np.int64).T
        height, width = image_rgb.shape[:2]
        seen = image_rgb[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        np.add.at(self._sums, rows[at], seen.astype(np.float64))
        np.add.at(self._count, rows[at], 1.0)

    def rgb(self) -> Bytes:
        """``(P, 3)`` uint8."""
        mean = self._sums / np.maximum(self._count, 1.0)[:, None]
        return np.where(self._count[:, None] > 0, np.rint(mean), _GREY).astype(np.uint8)
