# SPDX-License-Identifier: Apache-2.0
"""Manhattan frames of an image: three orthogonal directions in space that its straight lines run along.

Lines that are parallel in space meet in a vanishing point, and the ray through it is their direction.
Buildings and furniture mostly have three such directions at right angles (Coughlan and Yuille, "Manhattan
World", ICCV 1999), one of which is vertical. Frames are sampled from random lines, two for the first
direction and one for the second (after Zhang et al., "Vanishing point estimation and line classification in
a Manhattan world", ACCV 2012), and the frames with most inlier lines are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.geometry import so3_exp
from slamdepth.types import Camera
from slamdepth.typing import Floats

_LONGER_SIDE_PX = 340
"""Lines are detected in an image whose longer side has about so many pixels: finer ones are texture."""
_SHORTEST = 0.04  # of the image's longer side
_LONGEST = 0.3  # longer ones weigh no more; tangents of angles
_FEWEST_LINES = 8
_TRIALS = 1000
_WITHIN_RAD = np.radians(2.0)
_REFINEMENTS = (0.03, 0.015, 0.007)
_REFINING = 150
_SAME_RAD = np.radians(8.0)
_UPRIGHT_RAD = np.radians(45.0)


@dataclass(frozen=True)
class Lines:
    """Straight lines of an image, in the camera's frame.

    Attributes:
        normals: ``(N, 3)`` unit normals of the planes through the camera and each line.
        middles: ``(N, 3)`` unit rays through the middle of each line.
        weights: ``(N,)``, which grow with length.
    """

    normals: Floats
    middles: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.weights)


@dataclass(frozen=True)
class ManhattanFrame:
    """Three orthogonal directions.

    Attributes:
        axes: ``(3, 3)``, one unit vector of the camera's frame per row; its sense is arbitrary.
        support: ``(3,)``, the share of all lines' weight that runs along each.
    """

    axes: Floats
    support: Floats


def find_lines(image_rgb: NDArray[np.uint8], camera: Camera) -> Lines:
    """Straight lines of a raw image ``(H, W, 3)`` by LSD (von Gioi et al. 2010), undistorted."""
    scale = min(1.0, _LONGER_SIDE_PX / max(image_rgb.shape[:2]))
    grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    ends = ends[length > _SHORTEST * max(grey.shape)]
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
    """Manhattan frames of ``lines``, at most ``count`` different ones, the one with most inliers first.

    The result depends on the lines alone: the random numbers are seeded. It is empty with fewer than 8 lines.
    """
    if len(lines) < _FEWEST_LINES:
        return []
    rng = np.random.default_rng(0)
    axes = _sampled(lines, rng)
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


def gravity_if_upright(image_rgb: NDArray[np.uint8], camera: Camera) -> Floats | None:
    """Direction of gravity in an image of a camera that was held roughly upright.

    Args:
        image_rgb: ``(H, W, 3)``, raw.
        camera: that took it.

    Returns:
        ``(3,)`` unit vector in the camera's frame (x right, y down, z forward). None where there are too few
        lines, or none of their directions is within 45 degrees of the image's vertical axis.
    """
    frames = manhattan_frames(find_lines(image_rgb, camera))
    if not frames:
        return None
    axes = frames[0].axes
    vertical = axes[np.abs(axes[:, 1]).argmax()]
    gravity = vertical * np.sign(vertical[1])
    return gravity if abs(np.arctan2(gravity[0], gravity[1])) < _UPRIGHT_RAD else None


def _sampled(lines: Lines, rng: np.random.Generator) -> Floats:
    """Random frames ``(N, 3, 3)``.

    The first axis is the direction of two lines, the second the orthogonal direction of a third line, and the
    third their cross product.
    """
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
    """Inlier weight of each frame ``(N,)``, and ``(N, 3, lines)`` how well each line fits each axis, 0 to 1.

    Most of the time goes here, so it is in single precision: the error is far below that of the lines.
    """
    flat, normals, middles = (
        each.astype(np.float32) for each in (axes.reshape(-1, 3), lines.normals, lines.middles)
    )
    off = (flat @ normals.T) ** 2
    off /= np.maximum(1.0 - (flat @ middles.T) ** 2, 1e-4)
    along = np.maximum(1.0 - off * np.float32(_WITHIN_RAD**-2), 0.0).reshape(len(axes), 3, len(lines))
    return along.max(axis=1) @ lines.weights.astype(np.float32), along


def _differ(axes: Floats, other: Floats) -> bool:
    """True where some axis of one frame is not within 8 degrees of any axis of the other."""
    return bool(np.abs(axes @ other.T).max(axis=1).min() < np.cos(_SAME_RAD))
