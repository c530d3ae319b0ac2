# SPDX-License-Identifier: Apache-2.0
"""The surface that earlier keyframes know, as a new keyframe sees it.

When a keyframe is made, most of what it shows was predicted for keyframes before. Their depth, aligned with
the map, gives its features a depth at once: each feature's ray is followed into an earlier view until the
point there lies on the ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slamdepth.depth.alignment import DepthField, coarse_correction, prior_log_depth_at
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.map_view import NEAREST_M
from slamdepth.types import Camera, DepthPrediction
from slamdepth.typing import Floats, Floats32

_WIDTH = 160  # cells of a view; a network's depth has no finer detail
_VIEWS_KEPT = 32
_VIEWS_ASKED = 4
_STEPS = 5  # along a ray
_MAX_MARGIN = 40  # cells around a view


@dataclass(frozen=True)
class _View:
    """Depth of an earlier keyframe on a grid of undistorted pixels.

    Attributes:
        log_depth: ``(h * w,)`` in metres of the map when it was made, NaN where unknown or at a jump.
        sigma_log: ``(h * w,)`` the prediction's own deviation.
        unit: of the keyframe at that time.
    """

    log_depth: Floats32
    sigma_log: Floats32
    unit: float


class KnownSurface:
    """Keeps the latest views, and says how far features of another keyframe are by them.

    Args:
        camera: as it took the images, with its distortion.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._pinhole = camera.without_distortion()
        height = max(round(_WIDTH * camera.height / camera.width), 1)
        self._grid = _with_margin(camera, camera.scaled(_WIDTH, height))
        self._raw_px: Floats | None = None
        self._views: dict[MapKeyframe, _View] = {}  # the oldest first

    def add(self, keyframe: MapKeyframe, prediction: DepthPrediction, field: DepthField) -> None:
        """Remember the depth of a keyframe.

        Args:
            field: fitted to ``prediction``.
        """
        import cv2

        px = self._grid_raw_px()
        log, sigma = prior_log_depth_at(prediction, px)
        coarse = coarse_correction(field, prediction)
        height, width = prediction.values.shape
        at = px / (width - 1, height - 1) * (coarse.shape[1] - 1, coarse.shape[0] - 1)
        shape = (self._grid.height, self._grid.width)
        u, v = (axis.reshape(shape).astype(np.float32) for axis in at.T)
        correction = cv2.remap(coarse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (px >= -0.5).all(axis=1) & (px[:, 0] < width - 0.5) & (px[:, 1] < height - 0.5)
        log_depth = np.where(inside, log + correction.ravel(), np.nan)
        smooth = _range_3x3(log_depth.reshape(shape)).ravel() < sigma
        self._views[keyframe] = _View(
            np.where(smooth, log_depth, np.nan).astype(np.float32), sigma.astype(np.float32), keyframe.unit
        )
        self._forget_oldest()

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        views = self._views.values()
        return {
            "keyframes": [keyframe.id for keyframe in self._views],
            "log_depth": [one.log_depth for one in views],
            "sigma_log": [one.sigma_log for one in views],
            "unit": [one.unit for one in views],
        }

    def restore(self, state: Tree, keyframes: Sequence[MapKeyframe]) -> None:
        """Remember what :meth:`state` gave.

        Args:
            keyframes: of the map, by their ids.
        """
        views = map(_View, state["log_depth"], state["sigma_log"], state["unit"])
        self._views = {keyframes[k]: view for k, view in zip(state["keyframes"], views, strict=True)}

    def absorb(self, other: KnownSurface) -> None:
        """Take over the views of keyframes that were in another map."""
        self._views.update(other._views)
        self._forget_oldest()

    def _forget_oldest(self) -> None:
        while len(self._views) > _VIEWS_KEPT:
            del self._views[next(iter(self._views))]

    def log_depth(self, keyframe: MapKeyframe, others: Sequence[MapKeyframe]) -> tuple[Floats, Floats]:
        """Log depth ``(N,)`` of a keyframe's features and its deviation ``(N,)``, NaN where none is known.

        Args:
            others: keyframes to ask, those first that see most of the same; of the first few that are
                remembered, the nearest one that knows the surface is believed.
        """
        px = keyframe.features.px
        camera = self._pinhole
        rays = np.column_stack(
            [(px[:, 0] - camera.cx) / camera.fx, (px[:, 1] - camera.cy) / camera.fy, np.ones(len(px))]
        )
        log_depth, sigma = np.full(len(px), np.nan), np.full(len(px), np.nan)
        asked = [other for other in others if other in self._views][:_VIEWS_ASKED]
        asked.sort(key=lambda other: float(np.linalg.norm(other.center_w - keyframe.center_w)))
        for other in asked:
            missing = np.flatnonzero(~np.isfinite(log_depth))
            log_depth[missing], sigma[missing] = self._follow(keyframe, other, rays[missing])
        return log_depth, sigma

    def _follow(self, keyframe: MapKeyframe, other: MapKeyframe, rays: Floats) -> tuple[Floats, Floats]:
        """Log depth and deviation along ``rays (N, 3)`` of ``keyframe``, by one other keyframe."""
        view, grid = self._views[other], self._grid
        log_view = view.log_depth.astype(np.float64) + np.log(other.unit / view.unit)
        T = other.T_camera_world @ keyframe.T_world_camera
        R, t = T[:3, :3], T[:3, 3]
        turned = rays @ R.T
        middle = np.nanmedian(log_view) if np.isfinite(log_view).any() else np.nan
        z = np.full(len(rays), np.exp(middle))
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(_STEPS):
                p = turned * z[:, None] + t
                x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
                u, v = np.rint(x * grid.fx + grid.cx), np.rint(y * grid.fy + grid.cy)
                inside = (p[:, 2] > NEAREST_M) & (u >= 0) & (u < grid.width) & (v >= 0) & (v < grid.height)
                cell = np.where(inside, v * grid.width + u, 0).astype(np.int64)
                there = np.where(inside, np.exp(log_view[cell]), np.nan)
                q = (np.column_stack([x, y, np.ones(len(x))]) * there[:, None] - t) @ R  # in keyframe
                z = np.where(np.isfinite(q[:, 2]) & (q[:, 2] > NEAREST_M), q[:, 2], z)
            off_px = np.hypot(q[:, 0] / q[:, 2] - rays[:, 0], q[:, 1] / q[:, 2] - rays[:, 1]) * grid.fx
        found = inside & (off_px < 0.5) & (q[:, 2] > NEAREST_M)
        return np.where(found, np.log(z), np.nan), np.where(found, view.sigma_log[cell], np.nan)

    def _grid_raw_px(self) -> Floats:
        """Raw pixels ``(h * w, 2)`` of the grid's cells."""
        if self._raw_px is None:
            import cv2

            grid = self._grid
            u, v = cv2.initUndistortRectifyMap(
                self._camera.K,
                self._camera.distortion_array,
                np.eye(3),
                grid.without_distortion().K,
                (grid.width, grid.height),
                cv2.CV_32FC1,
            )
            self._raw_px = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        return self._raw_px


def _with_margin(camera: Camera, grid: Camera) -> Camera:
    """``grid`` with a margin for what lies outside the image once its pixels are undistorted."""
    along = np.linspace(0.0, 1.0, 33)
    zero, one = np.zeros(33), np.ones(33)
    border = np.concatenate(
        [np.stack(side, 1) for side in ((along, zero), (along, one), (zero, along), (one, along))]
    )
    px = camera.undistort_points(border * (camera.width - 1, camera.height - 1))
    over = np.maximum(-px.min(axis=0), px.max(axis=0) - (camera.width - 1, camera.height - 1))
    cells = np.ceil(over * grid.width / camera.width)
    margin_u, margin_v = (int(np.clip(n, 0, _MAX_MARGIN)) for n in cells)
    return replace(
        grid,
        width=grid.width + 2 * margin_u,
        height=grid.height + 2 * margin_v,
        cx=grid.cx + margin_u,
        cy=grid.cy + margin_v,
    )


def _range_3x3(image: Floats) -> NDArray[np.float32]:
    """Largest less smallest value ``(h, w)`` among each cell and its neighbours that are known."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    high = cv2.dilate(np.nan_to_num(image, nan=-np.inf).astype(np.float32), kernel)
    low = cv2.erode(np.nan_to_num(image, nan=np.inf).astype(np.float32), kernel)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(high - low, np.float32)
