# SPDX-License-Identifier: Apache-2.0
"""Keypoints moved to where the images agree to a part of a pixel, and points triangulated from them.

A tracker's keypoints are those of its images, which may be smaller than the exported ones, and as coarse as
the scale they were found at where the run did not align them. The patch of each point in one of its views is
therefore found again in the others (:mod:`slamdepth.frontend.patch_alignment`), starting at the keypoint.
Where it is not found, the observation is left out. Poses stay as they are. Lindenberger et al.
("Pixel-Perfect Structure-from-Motion", ICCV 2021) adjust keypoints to the same end.
"""

from __future__ import annotations

import numpy as np

from slamdepth.export.images import ExportImages
from slamdepth.export.scene import ExportScene
from slamdepth.export.tracks import MAX_ERROR_PX, Tracks, numbered
from slamdepth.frontend.patch_alignment import (
    ImagePyramid,
    Templates,
    align_near,
    central_views,
    facing_warp,
)
from slamdepth.geometry import invert
from slamdepth.mapping.codec import Encoded, encode_image
from slamdepth.typing import Bools, Bytes, Floats, Ints

_WORKING_PX = 1280  # longest side of the images that are compared
_SPACING_PX = 1.5  # of a patch's samples
_TRIANGULATIONS = 8
_DAMPING = 1e-3  # of a Gauss-Newton step
_HUBER_PX = 1.0


class SmallImages:
    """Images of the views at a working size, compressed in memory."""

    def __init__(self) -> None:
        self._encoded: dict[int, Encoded] = {}
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

    def load(self, number: int) -> ImagePyramid:
        """The image of a view."""
        return ImagePyramid(np.asarray(self._encoded[number].array(), np.uint8))


def refine_tracks(
    scene: ExportScene, images: ExportImages, tracks: Tracks, small: SmallImages
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
    seen = np.flatnonzero((point >= 0) & np.array([n in small for n in range(len(scene.views))])[view])
    if len(seen) == 0:
        return tracks, np.arange(len(tracks.points_m))
    moved = px.copy()
    found = np.zeros(len(px), np.bool_)
    moved[seen], found[seen] = _aligned(
        T_camera_world, tracks.points_m, view[seen], point[seen], px[seen], images, small
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


def _aligned(
    T_camera_world: Floats,
    points_m: Floats,
    view: Ints,
    point: Ints,
    px: Floats,
    images: ExportImages,
    small: SmallImages,
) -> tuple[Floats, Bools]:
    """Pixels ``(M, 2)`` of observations: where the patch of each point's reference is; which were found."""
    center_w = invert(T_camera_world)[:, :3, 3]
    reference = central_views(center_w[view] - points_m[point], point, len(points_m))[point]
    own = np.flatnonzero(reference == np.arange(len(point)))
    own = own[np.argsort(view[own], kind="stable")]
    working_px = (px + 0.5) * small.share - 0.5
    patches = Templates.joined(
        [
            Templates.of(small.load(number), working_px[at], np.full(len(at), _SPACING_PX))
            for number in np.unique(view[own])
            for at in [own[view[own] == number]]
        ]
    )
    patch = np.full(len(points_m), -1)
    patch[point[own]] = np.arange(len(own))
    usable = patches.is_usable[patch[point]]
    found = usable & (reference == np.arange(len(point)))
    focal_px = small.share * np.array([images.camera.fx, images.camera.fy])
    farthest_px = MAX_ERROR_PX * small.share * images.magnification
    others = np.flatnonzero(usable & ~found)
    for number in np.unique(view[others]):
        at = others[view[others] == number]
        warp = facing_warp(
            T_camera_world[number], T_camera_world, view[reference[at]], points_m[point[at]], focal_px
        )
        there, good = align_near(
            small.load(number), patches.taken(patch[point[at]]), warp, working_px[at], farthest_px
        )
        working_px[at[good]], found[at] = there[good], good
    return (working_px + 0.5) / small.share - 0.5, found


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
