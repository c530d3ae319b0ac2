# SPDX-License-Identifier: Apache-2.0
"""Images of a wide lens as a pinhole camera at the same place would see them.

A pinhole cannot hold a hemisphere: the view is the middle of what the lens sees, with the optical axis and
with the resolution of its centre. Poses of the camera are those of the view.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from slamdepth.datasets.base import Dataset
from slamdepth.datasets.resizing import LONGEST_SIDE_PX
from slamdepth.errors import CameraError
from slamdepth.types import Camera, Frame
from slamdepth.typing import Bools, Bytes, Floats, Floats32

if TYPE_CHECKING:
    from slamdepth.calibration import WideLens

WIDEST_VIEW_DEG = 100.0
"""Largest angle between opposite edges of a view: there a pinhole stretches its centre 2.4 times."""

_SMALLEST_SHARE = 0.5
_STEP = 0.98


class VirtualView:
    """The pinhole view of a camera with a wide lens.

    Attributes:
        taken_by: the camera of the images as they are taken.
        camera: the pinhole camera of the view, without distortion.
        has_source: ``(H, W)`` of the view, True where the image shows the pixel. False only where a lens
            sees less than a rectangle.

    Args:
        taken_by: see above.
        widest_deg: largest angle between opposite edges of the view.
        longest_side_px: largest width and height of the view.

    Raises:
        CameraError: the camera has no wide lens.
    """

    def __init__(
        self,
        taken_by: Camera,
        *,
        widest_deg: float = WIDEST_VIEW_DEG,
        longest_side_px: int = LONGEST_SIDE_PX,
    ) -> None:
        if taken_by.lens is None:
            raise CameraError("camera: a pinhole camera needs no virtual view")
        self.taken_by = taken_by
        self.camera = _pinhole(taken_by, taken_by.lens, math.radians(widest_deg) / 2.0, longest_side_px)
        # A reduced view is made from a reduced image, whose pixels are means: single ones would alias.
        share = min(1.0, self.camera.fx / (taken_by.fx * taken_by.lens.slope))
        size = max(8, round(share * taken_by.width)), max(8, round(share * taken_by.height))
        self._small = taken_by.scaled(*size) if share < 1.0 else taken_by
        px = _seen_at(self._small, taken_by.lens, _rays(self.camera))
        self.has_source: Bools = _is_inside(px, self._small).reshape(self.camera.height, self.camera.width)
        maps = np.where(np.isfinite(px), px, -2.0).astype(np.float32)
        self._map_u, self._map_v = (
            np.ascontiguousarray(values.reshape(self.has_source.shape)) for values in maps.T
        )

    @property
    def note(self) -> str:
        """What is made of the images, in one line."""
        lens = self.taken_by.lens
        degrees = (_degrees(self.camera.width, self.camera.fx), _degrees(self.camera.height, self.camera.fy))
        return (
            f"images of {self.taken_by.width}x{self.taken_by.height} through a lens of the model "
            f"'{lens.model if lens else ''}' are undistorted to a pinhole view of {degrees[0]:.0f}x"
            f"{degrees[1]:.0f} degrees, {self.camera.width}x{self.camera.height} pixels; what lies outside "
            "is not used"
        )

    def render(self, image_rgb: Bytes) -> Bytes:
        """The view ``(H, W, 3)`` uint8 of an image ``(h, w, 3)`` uint8; black where it has no source.

        Raises:
            CameraError: the image is not of the camera's size.
        """
        import cv2

        self._check_size(image_rgb.shape)
        size = (self._small.width, self._small.height)
        if image_rgb.shape[1::-1] != size:
            image_rgb = np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        view = cv2.remap(
            image_rgb, self._map_u, self._map_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        view[~self.has_source] = 0
        return np.asarray(view, np.uint8)

    def render_depth(self, depth_m: Floats32) -> Floats32:
        """Depth along z ``(H, W)`` float32 of that of the image ``(h, w)``, by nearest neighbour; 0 unknown.

        Raises:
            CameraError: the depth is not of the camera's size.
        """
        import cv2

        self._check_size(depth_m.shape)
        sx, sy = self.taken_by.width / self._small.width, self.taken_by.height / self._small.height
        u = (self._map_u + np.float32(0.5)) * np.float32(sx) - np.float32(0.5)
        v = (self._map_v + np.float32(0.5)) * np.float32(sy) - np.float32(0.5)
        view = cv2.remap(depth_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        view[~self.has_source] = 0
        return np.asarray(view, np.float32)

    def _check_size(self, shape: tuple[int, ...]) -> None:
        if shape[:2] != (self.taken_by.height, self.taken_by.width):
            raise CameraError(
                f"the image is {shape[1]}x{shape[0]}, the camera says "
                f"{self.taken_by.width}x{self.taken_by.height}"
            )


class ViewedSequence:
    """A sequence of a camera with a wide lens, whose frames are pinhole views.

    Everything but camera, notes and frames is the sequence's own.

    Args:
        raw: the sequence as its camera took it.
    """

    def __init__(self, raw: Dataset) -> None:
        self.raw = raw
        self.view = _view_of(raw.camera)
        self.camera = self.view.camera
        self.notes = [*raw.notes, self.view.note]

    def __getattr__(self, name: str) -> Any:
        if name == "raw":  # not there yet, as while it is copied
            raise AttributeError(name)
        return getattr(self.raw, name)

    def __len__(self) -> int:
        return len(self.raw)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`."""
        return as_pinhole(self.raw.read(index, with_depth=with_depth))

    __iter__ = Dataset.__iter__
    frames = Dataset.frames
    read_original = Dataset.read_original  # a view has one size


def through_view(dataset: Dataset) -> Dataset:
    """``dataset``, or its pinhole view where its camera has a wide lens."""
    return dataset if dataset.camera.lens is None else cast("Dataset", ViewedSequence(dataset))


def as_pinhole(frame: Frame) -> Frame:
    """``frame``, or its pinhole view where its camera has a wide lens."""
    if frame.camera.lens is None:
        return frame
    view = _view_of(frame.camera)
    depth_m = None if frame.depth_m is None else view.render_depth(frame.depth_m)
    return replace(frame, image_rgb=view.render(frame.image_rgb), camera=view.camera, depth_m=depth_m)


def pinhole_of(camera: Camera) -> Camera:
    """``camera``, or that of its pinhole view where it has a wide lens."""
    return camera if camera.lens is None else _view_of(camera).camera


@lru_cache(maxsize=4)
def _view_of(camera: Camera) -> VirtualView:
    return VirtualView(camera)


def _pinhole(taken_by: Camera, lens: WideLens, half_rad: float, longest_side_px: int) -> Camera:
    """The largest pinhole view about the optical axis whose edges the image shows."""
    limit = math.tan(min(half_rad, 0.95 * lens.widest_rad))
    extents = np.array([limit] * 4)  # left, right, top, bottom, as tan of the angle
    for side, edge_px in enumerate(_edges(taken_by)):
        rays = lens.unproject((edge_px - [taken_by.cx, taken_by.cy]) / [taken_by.fx, taken_by.fy])
        rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 1e-3)]
        slopes = np.abs(rays[:, :2] / rays[:, 2:])
        along, across = slopes[:, side // 2], slopes[:, 1 - side // 2]
        extents[side] = min(limit, along[across <= limit].min(initial=np.inf))
    for share in np.arange(1.0, _SMALLEST_SHARE, _STEP - 1.0):
        if _is_inside(_seen_at(taken_by, lens, _border(share * extents)), taken_by).all():
            extents = share * extents
            break
    left, right, top, bottom = (float(extent) for extent in extents)
    aspect = taken_by.fy / taken_by.fx
    fx = min(taken_by.fx * lens.slope, longest_side_px / max(left + right, (top + bottom) * aspect))
    fy = fx * aspect
    width, height = max(1, math.floor(fx * (left + right))), max(1, math.floor(fy * (top + bottom)))
    return replace(
        taken_by, width=width, height=height, fx=fx, fy=fy, lens=None,
        cx=(fx * (left - right) + width - 1) / 2.0, cy=(fy * (top - bottom) + height - 1) / 2.0,
    )  # fmt: skip


def _edges(camera: Camera) -> Iterator[Floats]:
    """Centres of the pixels along the left, right, top and bottom edge, ``(N, 2)`` each."""
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    yield from (np.column_stack([np.full(len(v), at), v]) for at in (0.0, camera.width - 1.0))
    yield from (np.column_stack([u, np.full(len(u), at)]) for at in (0.0, camera.height - 1.0))


def _border(extents: Floats) -> Floats:
    """Rays ``(N, 3)`` along the border of a view."""
    left, right, top, bottom = extents
    along = np.linspace(0.0, 1.0, 65)
    x, y = along * (left + right) - left, along * (top + bottom) - top
    sides = [(x, np.full(65, at)) for at in (-top, bottom)] + [(np.full(65, at), y) for at in (-left, right)]
    return np.concatenate([np.column_stack([a, b, np.ones(65)]) for a, b in sides])


def _rays(camera: Camera) -> Floats:
    """Rays ``(H W, 3)`` of the pixels of a pinhole camera."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy
    return np.column_stack([x, y, np.ones(len(x))])


def _seen_at(camera: Camera, lens: WideLens, rays: Floats) -> Floats:
    return lens.project(rays) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _is_inside(px: Floats, camera: Camera) -> Bools:
    with np.errstate(invalid="ignore"):
        inside = (px >= -0.5) & (px <= [camera.width - 0.5, camera.height - 0.5])
    return np.asarray(inside.all(axis=1))


def _degrees(size: int, focal: float) -> float:
    return math.degrees(2.0 * math.atan(size / (2.0 * focal)))
