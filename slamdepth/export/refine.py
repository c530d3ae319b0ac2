# SPDX-License-Identifier: Apache-2.0
"""Keypoints moved to where the images agree to a part of a pixel, and points triangulated from them.

A tracker's keypoints are as coarse as the scale they were found at: up to 3.6 pixels. Each point is therefore
followed from one of its views into the others (Lucas and Kanade 1981), starting at the keypoint. Where the
way back does not lead home, the observation is left out. Poses stay as they are. Lindenberger et al.
("Pixel-Perfect Structure-from-Motion", ICCV 2021) adjust keypoints to the same end.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np

from slamdepth.export.images import ExportImages
from slamdepth.export.scene import ExportScene
from slamdepth.export.tracks import MAX_ERROR_PX, Tracks, numbered
from slamdepth.geometry import invert
from slamdepth.mapping.codec import Encoded, encode_image
from slamdepth.typing import Bools, Bytes, Floats, Ints

_WORKING_PX = 1280  # longest side of the images that are compared
_WINDOW_PX = 21
_HOME_PX = 0.5  # the way there and back
_STEPS = (30, 0.01)  # at most, and until a step is so many pixels
_TRIANGULATIONS = 8
_DAMPING = 1e-3  # of a Gauss-Newton step
_HUBER_PX = 1.0
_OPEN = 32  # images decoded at a time


class GreyImages:
    """Grey images of the views at a working size, compressed in memory."""

    def __init__(self) -> None:
        self._encoded: dict[int, Encoded] = {}
        self._decoded: OrderedDict[int, Bytes] = OrderedDict()
        self.share = 1.0
        """Pixels of the working size in one of the exported image."""

    def add(self, number: int, image_rgb: Bytes) -> None:
        """Take the exported image ``(H, W, 3)`` of a view."""
        import cv2

        height, width = image_rgb.shape[:2]
        self.share = min(1.0, _WORKING_PX / max(height, width))
        if self.share < 1.0:
            size = round(width * self.share), round(height * self.share)
            image_rgb = np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        self._encoded[number] = encode_image(image_rgb)

    def __contains__(self, number: int) -> bool:
        return number in self._encoded

    def load(self, number: int) -> Bytes:
        """The image ``(h, w)`` of a view."""
        import cv2

        if number not in self._decoded:
            encoded = self._encoded[number]
            self._decoded[number] = np.asarray(cv2.cvtColor(encoded.array(), cv2.COLOR_RGB2GRAY), np.uint8)
            if len(self._decoded) > _OPEN:
                self._decoded.popitem(last=False)
        self._decoded.move_to_end(number)
        return self._decoded[number]


def refine_tracks(
    scene: ExportScene, images: ExportImages, tracks: Tracks, greys: GreyImages
) -> tuple[Tracks, Ints]:
    """Refine keypoints and points.

    Returns:
        The refined tracks, and ``(P,)`` which point of ``tracks`` each of their points was; ``tracks``
        themselves where no point is seen by two images.
    """
    view = np.concatenate([np.full(len(rows), n) for n, rows in enumerate(tracks.rows)])
    point = np.concatenate(tracks.rows)
    px = np.concatenate(tracks.keypoints_px)
    T_camera_world = invert(np.array([one.T_world_camera for one in scene.views]))
    seen = np.flatnonzero((point >= 0) & np.array([n in greys for n in range(len(scene.views))])[view])
    moved = px.copy()
    found = np.zeros(len(px), np.bool_)
    depth = _depth(T_camera_world[view[seen]], tracks.points_m[point[seen]])
    moved[seen], found[seen] = _followed(
        view[seen], point[seen], px[seen], depth, greys, images.magnification
    )
    count = np.bincount(point[found], minlength=len(tracks.points_m))
    found[found] = count[point[found]] >= 2
    if not found.any():
        return tracks, np.arange(len(tracks.points_m))
    pinhole_px = images.camera.undistort_points(moved[found])
    points_m = _triangulated(
        tracks.points_m, T_camera_world[view[found]], point[found], pinhole_px, images.camera.K
    )
    error = np.full(len(px), np.inf)
    for number, one in enumerate(scene.views):
        at = np.flatnonzero(found & (view == number))
        predicted, ahead = images.project(one, points_m[point[at]])
        error[at] = np.where(ahead, np.linalg.norm(predicted - moved[at], axis=1), np.inf)
    rows = np.where(error <= MAX_ERROR_PX * images.magnification, point, -1)
    ends = np.cumsum([len(one) for one in tracks.rows])[:-1]
    return numbered(
        points_m,
        np.split(moved, ends),
        np.split(rows, ends),
        np.split(np.where(np.isfinite(error), error, 0.0), ends),
        tracks.observations + tracks.dropped,
    )


def _followed(
    view: Ints, point: Ints, px: Floats, depth: Floats, greys: GreyImages, magnification: float
) -> tuple[Floats, Bools]:
    """Pixels ``(M, 2)`` of observations as followed from each point's reference, and which were found.

    The reference of a point is the view whose distance is nearest to the mean of all: no view shows it much
    larger or smaller.
    """
    log_depth = np.log(depth)
    mean = np.bincount(point, log_depth) / np.maximum(np.bincount(point), 1)
    order = np.lexsort((np.abs(log_depth - mean[point]), point))
    reference = np.full(len(mean), -1)
    names, first = np.unique(point[order], return_index=True)
    reference[names] = order[first]
    source = reference[point]
    found = source == np.arange(len(point))  # a reference is where it is
    moved = px.copy()
    others = np.flatnonzero(~found)
    pairs = np.stack([view[source[others]], view[others]], axis=1)
    for pair in np.unique(pairs, axis=0):
        at = others[(pairs == pair).all(axis=1)]
        there, good = _flow(greys, pair[0], pair[1], px[source[at]], px[at], magnification)
        moved[at[good]], found[at] = there[good], good
    return moved, found


def _flow(
    greys: GreyImages, a: int, b: int, px_a: Floats, px_b: Floats, magnification: float
) -> tuple[Floats, Bools]:
    """Follow pixels from image ``a`` into ``b``, near ``px_b``; which lead back home."""
    import cv2

    image_a, image_b = greys.load(a), greys.load(b)
    reach_px = MAX_ERROR_PX * greys.share * magnification
    start, guess = (((px + 0.5) * greys.share - 0.5).astype(np.float32)[:, None] for px in (px_a, px_b))
    settings: dict[str, Any] = {
        "winSize": (_WINDOW_PX, _WINDOW_PX),
        "maxLevel": 1 if reach_px <= MAX_ERROR_PX else 2,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, *_STEPS),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(image_a, image_b, start, guess.copy(), **settings)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(image_b, image_a, there, start.copy(), **settings)
    good = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    good &= np.linalg.norm(back - start, axis=2)[:, 0] < _HOME_PX
    good &= np.linalg.norm(there - guess, axis=2)[:, 0] < reach_px
    return (there[:, 0].astype(np.float64) + 0.5) / greys.share - 0.5, np.asarray(good, np.bool_)


def _triangulated(points_m: Floats, T_camera_world: Floats, point: Ints, px: Floats, K: Floats) -> Floats:
    """Points ``(P, 3)`` by least squares of their reprojection errors (Huber), with fixed cameras."""
    points_m, count = points_m.copy(), len(points_m)
    for _ in range(_TRIANGULATIONS):
        points_c, predicted = _projected(T_camera_world, points_m[point], K)
        z = points_c[:, 2]
        by_camera = np.zeros((len(z), 2, 3))
        by_camera[:, 0, 0], by_camera[:, 0, 2] = K[0, 0] / z, -K[0, 0] * points_c[:, 0] / z**2
        by_camera[:, 1, 1], by_camera[:, 1, 2] = K[1, 1] / z, -K[1, 1] * points_c[:, 1] / z**2
        J = by_camera @ T_camera_world[:, :3, :3]
        off = px - predicted
        weight = np.minimum(1.0, _HUBER_PX / np.maximum(np.linalg.norm(off, axis=1), 1e-12))
        H, g = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(H, point, np.einsum("nij,nik,n->njk", J, J, weight))
        np.add.at(g, point, np.einsum("nij,ni,n->nj", J, off, weight))
        seen = np.flatnonzero(np.trace(H, axis1=1, axis2=2) > 0)
        damping = _DAMPING * np.trace(H[seen], axis1=1, axis2=2)[:, None, None] * np.eye(3)
        points_m[seen] += np.linalg.solve(H[seen] + damping, g[seen][:, :, None])[:, :, 0]
    return points_m


def _projected(T_camera_world: Floats, points_w: Floats, K: Floats) -> tuple[Floats, Floats]:
    """Points ``(M, 3)`` in their cameras, and their pixels ``(M, 2)``."""
    points_c = np.einsum("nij,nj->ni", T_camera_world[:, :3, :3], points_w) + T_camera_world[:, :3, 3]
    px = points_c[:, :2] / points_c[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    return points_c, px


def _depth(T_camera_world: Floats, points_w: Floats) -> Floats:
    """Depth ``(M,)`` of points in their cameras, positive."""
    z = np.einsum("nj,nj->n", T_camera_world[:, 2, :3], points_w) + T_camera_world[:, 2, 3]
    return np.asarray(np.maximum(z, 1e-6), np.float64)
