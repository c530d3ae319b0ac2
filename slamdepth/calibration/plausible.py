# SPDX-License-Identifier: Apache-2.0
"""Whether the intrinsics in a camera file can be those of a camera.

Cameras that the library makes itself, of cropped or turned views, need not pass: only what people write does.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from slamdepth.errors import CameraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDE_VIEW_DEG = 120.0
"""Wider than a pinhole camera with Brown-Conrady distortion usually sees."""

_UNDONE_SHARE = 0.05
"""Largest error of undistorting and distorting a pixel, as a share of the longer side: 0.2 % for real
lenses, 10 % and more where the inverse diverges."""

_LEAST_REACH = 0.9
"""Least share of the way to the farthest corner before distortion folds back: fits of real lenses may fold
where the calibration board never was."""

_STRONGEST, _NEGLIGIBLE = 1e4, 1e-12
"""Coefficients of a larger magnitude are refused, smaller ones count as zero."""


class Pinhole(Protocol):
    """What is checked and written of a :class:`slamdepth.types.Camera`; see there."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def distortion(self) -> tuple[float, float, float, float, float]: ...
    @property
    def depth_factor(self) -> float: ...
    @property
    def fps(self) -> float: ...
    @property
    def is_distorted(self) -> bool: ...
    def undistort_points(self, points_px: NDArray[np.floating]) -> NDArray[np.float64]: ...


def check_plausible(camera: Pinhole) -> list[str]:
    """Refuse intrinsics that no camera has.

    Returns:
        What is unusual about them, one line each.

    Raises:
        CameraError: the principal point lies outside the image, or the distortion folds it or cannot be
            undone; the message does not name the file.
    """
    _check_principal_point(camera)
    notes = _check_distortion(camera)
    view_deg = horizontal_view_deg(camera)
    if view_deg > WIDE_VIEW_DEG:
        notes.append(
            f"fx {camera.fx:g} is a horizontal view of {view_deg:.0f} degrees in an image {camera.width} "
            "pixels wide: if the camera sees less, fx, fy, cx and cy are of images of another size"
        )
    return notes


def horizontal_view_deg(camera: Pinhole) -> float:
    """Angle between the image's left and right edge in degrees, distortion left out."""
    left, right = (camera.cx + 0.5) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    return math.degrees(math.atan(left) + math.atan(right))


def fold_radius(camera: Pinhole) -> float:
    """Distance from the optical axis where radial distortion turns back, as tan of the angle in the distorted
    image; infinity where it never does."""
    k1, k2, _, _, k3 = camera.distortion
    slope = np.array([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of r (1 + k1 r² + k2 r⁴ + k3 r⁶), in r²
    turns = np.roots(np.where(np.abs(slope) < _NEGLIGIBLE, 0.0, slope))
    real = turns.real[np.abs(turns.imag) <= 1e-9 * np.abs(turns)]
    squares = real[real > 0]
    if not len(squares):
        return math.inf
    r2 = float(squares.min())
    return math.sqrt(r2) * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))


def _check_principal_point(camera: Pinhole) -> None:
    for name, value, size, side in (
        ("cx", camera.cx, camera.width, "width"),
        ("cy", camera.cy, camera.height, "height"),
    ):
        if not -0.5 <= value <= size - 0.5:
            raise CameraError(
                f"{name} {value:g} lies outside the image, whose {side} is {size}: the principal point is a "
                "pixel near its middle; are the intrinsics of images of another size?"
            )


def _check_distortion(camera: Pinhole) -> list[str]:
    """Refuse impossible distortion; return what is unusual about it, one line each."""
    if not camera.is_distorted:
        return []
    if max(map(abs, camera.distortion)) > _STRONGEST:
        raise CameraError(f"{_named(camera)} is too strong for any lens: check the order of its numbers")
    u = np.linspace(-0.5, camera.width - 0.5, 17)
    v = np.linspace(-0.5, camera.height - 0.5, 13)
    grid_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    offsets = (grid_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    reach = fold_radius(camera) / float(np.hypot(*offsets.T).max())
    notes = []
    if reach < 1.0:
        folds = (
            f"{_named(camera)} turns back {math.floor(100 * reach)} % of the way from the principal point to "
            "the farthest corner, so what lies beyond is seen twice or never"
        )
        advice = "calibrate with the board in the corners and fewer coefficients"
        if reach < _LEAST_REACH:
            raise CameraError(f"{folds}: check the order of its numbers, or {advice}")
        notes.append(f"{folds}: better {advice}")
    with np.errstate(all="ignore"):
        lost_px = float(np.abs(_distorted(camera, camera.undistort_points(grid_px)) - grid_px).max())
    if not lost_px <= _UNDONE_SHARE * max(camera.width, camera.height):
        raise CameraError(
            f"{_named(camera)} cannot be undone, so strong is it (a pixel comes back {lost_px:.1f} pixels "
            "from where it was): check the order of its numbers"
        )
    return notes


def _named(camera: Pinhole) -> str:
    return "distortion [" + ", ".join(f"{value:g}" for value in camera.distortion) + "] (k1 k2 p1 p2 k3)"


def _distorted(camera: Pinhole, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Raw pixels ``(N, 2)`` of undistorted ones: Brown's model, written out."""
    x, y = ((points_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([camera.fx * distorted_x + camera.cx, camera.fy * distorted_y + camera.cy], axis=1)
