# SPDX-License-Identifier: Apache-2.0
"""Directions that an image's straight lines run along in space: three at right angles.

Lines that are parallel in space meet in a vanishing point, and the ray through it is their direction.
Rooms and furniture are mostly made of three such directions at right angles (Coughlan and Yuille,
"Manhattan World", ICCV 1999), one of which is vertical. Frames of three are drawn from random lines,
two for a direction and one for another (after Zhang et al., "Vanishing point estimation and line
classification in a Manhattan world", ACCV 2012), and those most lines agree with are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.geometry import so3_exp
from slamdepth.types import Camera
from slamdepth.typing import Floats

_WIDTH_PX = 340
"""Lines are looked for in an image of about this width: finer ones are texture."""
_SHORTEST = 0.04  # of the image's width
_LONGEST = 0.3  # longer ones count no more; tangents of angles
_FEWEST_LINES = 8
_TRIALS = 1000
_WITHIN_RAD = np.radians(2.0)
_REFINEMENTS = (0.03, 0.015, 0.007)
_REFINING = 150
_SAME_RAD = np.radians(8.0)
_UPRIGHT_RAD = np.radians(45.0)


@dataclass(frozen=True)
class Lines:
    """Straight lines of an image.

    Attributes:
        normals: ``(N, 3)`` unit normals of the planes through the camera and each line.
        middles: ``(N, 3)`` unit rays through their middles.
        weights: ``(N,)`` by length.
    """

    normals: Floats
    middles: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.weights)


@dataclass(frozen=True)
class ManhattanFrame:
    """Three directions at right angles.

    Attributes:
        axes: ``(3, 3)``, one unit direction of the camera's frame a row; either sense may be meant.
        support: ``(3,)``, the share of all lines' weight that runs along each.
    """

    axes: Floats
    support: Floats


def find_lines(image_rgb: NDArray[np.uint8], camera: Camera) -> Lines:
    """Straight lines of a raw image ``(H, W, 3)`` by LSD (von Gioi et al. 2010); distortion is undone."""
    scale = min(1.0, _WIDTH_PX / image_rgb.shape[1])
    grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    ends = ends[length > _SHORTEST * grey.shape[1]]
    ratio = np.array([image_rgb.shape[1] / grey.shape[1], image_rgb.shape[0] / grey.shape[0]])
    raw_px = (ends.reshape(-1, 2) + 0.5) * ratio - 0.5
    px = camera.undistort_points(raw_px) if len(raw_px) else raw_px
    xy = ((px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).reshape(-1, 2, 2)
    rays = np.concatenate([xy, np.ones((len(xy), 2, 1))], axis=2)
    normals = np.cross(rays[:, 0], rays[:, 1])
    size = np.linalg.norm(normals, axis=1)
    rays, xy, normals = rays[size > 1e-9], xy[size > 1e-9], normals[size > 1e-9]
    middles = rays.mean(axis=1)
    return Lines(
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        middles / np.linalg.norm(middles, axis=1, keepdims=True),
        np.minimum(np.linalg.norm(xy[:, 1] - xy[:, 0], axis=1), _LONGEST),
    )


def manhattan_frames(lines: Lines, count: int = 1) -> list[ManhattanFrame]:
    """At most ``count`` frames that differ, those most lines run along first; the same for the same lines.

    Empty where there are too few lines to tell.
    """
    if len(lines) < _FEWEST_LINES:
        return []
    rng = np.random.default_rng(0)
    axes = _drawn(lines, rng)
    order = np.argsort(-_agreement(axes, lines)[0], kind="stable")
    chosen: list[Floats] = []
    for k in order:
        if len(chosen) == count:
            break
        if all(_differ(axes[k], other) for other in chosen):
            chosen.append(axes[k])
    frames = []
    for each in chosen:
        best = each
        for deviation in _REFINEMENTS:
            turns = rng.normal(0.0, deviation, (_REFINING, 3))
            turns[0] = 0.0
            tried = best @ so3_exp(turns)
            best = tried[_agreement(tried, lines)[0].argmax()]
        along = _agreement(best[None], lines)[1][0]
        frames.append(ManhattanFrame(best, along @ lines.weights / lines.weights.sum()))
    return frames


def held_upright_down(image_rgb: NDArray[np.uint8], camera: Camera) -> Floats | None:
    """Direction of gravity ``(3,)`` in the camera's frame, of an image that was held roughly upright.

    None where the lines do not tell, or none of their directions is within 45 degrees of the image's own
    vertical.
    """
    frames = manhattan_frames(find_lines(image_rgb, camera))
    if not frames:
        return None
    axes = frames[0].axes
    down = axes[np.abs(axes[:, 1]).argmax()]
    down = down * np.sign(down[1])
    return down if abs(np.arctan2(down[0], down[1])) < _UPRIGHT_RAD else None


def _drawn(lines: Lines, rng: np.random.Generator) -> Floats:
    """Random frames ``(N, 3, 3)``: where two lines meet, what a third says at right angles, and the rest."""
    share = lines.weights / lines.weights.sum()
    i, j, k = (lines.normals[rng.choice(len(lines), _TRIALS, p=share)] for _ in range(3))
    first = np.cross(i, j)
    second = np.cross(first, k)
    size = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    good = (size[0] > 0.05) & (size[1] > 0.05 * size[0])
    first = first[good] / size[0][good, None]
    second = second[good] / size[1][good, None]
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _agreement(axes: Floats, lines: Lines) -> tuple[Floats, Floats]:
    """Line weight that agrees with each frame ``(N,)``; how much each line does with each axis, 0 to 1.

    Most of the time goes here, so it is in single precision: that moves a direction by far less than lines
    tell it to.
    """
    flat, normals, middles = (
        each.astype(np.float32) for each in (axes.reshape(-1, 3), lines.normals, lines.middles)
    )
    off = (flat @ normals.T) ** 2
    off /= np.maximum(1.0 - (flat @ middles.T) ** 2, 1e-4)
    along = np.maximum(1.0 - off * np.float32(_WITHIN_RAD**-2), 0.0).reshape(len(axes), 3, len(lines))
    return along.max(axis=1) @ lines.weights.astype(np.float32), along


def _differ(axes: Floats, other: Floats) -> bool:
    """True where some axis of one frame is along none of the other."""
    return bool(np.abs(axes @ other.T).max(axis=1).min() < np.cos(_SAME_RAD))
