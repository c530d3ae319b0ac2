# SPDX-License-Identifier: Apache-2.0
"""Whether the intrinsics in a camera file can be those of a camera.

Cameras that the library makes itself, of cropped or turned views, need not pass: only what people write does.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from slamdepth.calibration.wide_lens import WIDE_MODELS, WideLens
from slamdepth.errors import CameraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDE_VIEW_DEG = 120.0
"""Wider than a pinhole camera with Brown-Conrady distortion usually sees."""
WIDEST_VIEW_DEG = 150.0
"""Wider than such a camera can see: a focal length that gives more is not in pixels."""
NARROW_VIEW_DEG = 12.0
"""Narrower than the camera of a phone, a robot or a car sees; a telephoto lens may."""

_USUAL_CENTRE = (0.38, 0.62)
"""Principal points of real lenses, as a share of the image's side; others are noted."""
_USUAL_BOTH = (0.44, 0.56)
"""The same where it is off the middle alike in both directions, as that of another image size is."""
_OF_ANOTHER_SIZE = (0.39, 0.63)
"""Shares beyond which a principal point that is off the middle alike in both directions is refused."""
_FAR_CENTRE = (0.36, 0.64)
"""Shares beyond which one that is off in both directions, but not alike, is refused."""
_FARTHEST_CENTRE = (0.15, 0.85)
"""Shares beyond which one that is off in one direction is refused, also for a cropped image."""
_ALIKE = 0.05

_USUAL_ASPECT = 1.4
"""Largest ratio of the focal lengths of real images: those of 16:9 squeezed to 4:3 have 1.33."""

_UNDONE_SHARE = 0.05
"""Largest error of undistorting and distorting a pixel, as a share of the longer side: 0.2 % for real
lenses, 10 % and more where the inverse diverges."""

_LEAST_REACH = 0.9
"""Least share of the way to the farthest corner before distortion folds back: fits of real lenses may fold
where the calibration board never was."""

_LEAST_HALF_VIEW = 0.5
"""Least share of the way to the edges of an image that a wide lens shows once."""

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
    def distortion(self) -> tuple[float, ...]: ...
    @property
    def depth_factor(self) -> float: ...
    @property
    def fps(self) -> float: ...
    @property
    def lens(self) -> WideLens | None: ...
    @property
    def is_distorted(self) -> bool: ...
    def undistort_points(self, points_px: NDArray[np.floating]) -> NDArray[np.float64]: ...


def check_plausible(camera: Pinhole) -> list[str]:
    """Refuse intrinsics that no camera has.

    Returns:
        What is unusual about them, one line each.

    Raises:
        CameraError: the focal lengths are not in pixels, the principal point is at 0, outside the image or
            that of another image size, or the distortion folds the image or cannot be undone; the message
            does not name the file.
    """
    _check_focal_lengths(camera)
    notes = [*_check_principal_point(camera), *_check_distortion(camera)]
    if camera.lens is not None:
        _check_lens(camera, camera.lens)
    if max(camera.fx / camera.fy, camera.fy / camera.fx) > _USUAL_ASPECT:
        notes.append(
            f"fx {camera.fx:g} and fy {camera.fy:g} are of pixels that are not square: unless the images "
            "were stretched, one of them and the result are wrong"
        )
    view_deg = horizontal_view_deg(camera)
    if view_deg > WIDE_VIEW_DEG and camera.lens is None:
        notes.append(
            f"fx {camera.fx:g} is a horizontal view of {view_deg:.0f} degrees in an image {camera.width} "
            "pixels wide: if the camera sees less, fx, fy, cx and cy are of images of another size"
        )
    widest_deg = max(_view_deg(camera.width, camera.fx), _view_deg(camera.height, camera.fy))
    if widest_deg < NARROW_VIEW_DEG:
        notes.append(
            f"fx {camera.fx:g} and fy {camera.fy:g} are a view of only {widest_deg:.1f} degrees in an image "
            f"of {camera.width}x{camera.height}: if the camera sees more, they are of larger images or in "
            "micrometres"
        )
    return notes


def horizontal_view_deg(camera: Pinhole) -> float:
    """Angle between the image's left and right edge in degrees, distortion left out."""
    left, right = (camera.cx + 0.5) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    return math.degrees(math.atan(left) + math.atan(right))


def _view_deg(size: int, focal: float) -> float:
    """Angle that an image side of ``size`` pixels sees with the principal point in its middle."""
    return 2.0 * math.degrees(math.atan(size / (2.0 * focal)))


def fold_radius(camera: Pinhole) -> float:
    """Distance from the optical axis where radial distortion turns back, as tan of the angle in the distorted
    image; infinity where it never does."""
    k1, k2, _, _, k3, *rational = camera.distortion
    if any(rational):
        return _rational_fold_radius((k1, k2, k3), tuple(rational))
    slope = np.array([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of r (1 + k1 r² + k2 r⁴ + k3 r⁶), in r²
    turns = np.roots(np.where(np.abs(slope) < _NEGLIGIBLE, 0.0, slope))
    real = turns.real[np.abs(turns.imag) <= 1e-9 * np.abs(turns)]
    squares = real[real > 0]
    if not len(squares):
        return math.inf
    r2 = float(squares.min())
    return math.sqrt(r2) * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))


def _rational_fold_radius(above: tuple[float, ...], below: tuple[float, ...]) -> float:
    """The same of r (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³) with s = r²."""
    top, bottom = np.array([*above[::-1], 1.0]), np.array([*below[::-1], 1.0])
    turning = 2.0 * np.polysub(np.polymul(np.polyder(top), bottom), np.polymul(top, np.polyder(bottom)))
    growth = np.polyadd(np.polymul(top, bottom), np.append(turning, 0.0))
    ends = np.concatenate([np.roots(np.where(np.abs(p) < _NEGLIGIBLE, 0.0, p)) for p in (growth, bottom)])
    real = ends.real[np.abs(ends.imag) <= 1e-9 * np.abs(ends)]
    squares = real[real > 0]
    if not len(squares):
        return math.inf
    square = float(squares.min())
    divisor = float(np.polyval(bottom, square))
    return (
        math.inf
        if abs(divisor) < _NEGLIGIBLE
        else math.sqrt(square) * float(np.polyval(top, square)) / divisor
    )


def _check_lens(camera: Pinhole, lens: WideLens) -> None:
    """Refuse a wide lens that does not see the middle of the image."""
    reach = _LEAST_HALF_VIEW * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    sides = np.array([camera.cx, camera.width - 1 - camera.cx, camera.cy, camera.height - 1 - camera.cy])
    offsets = reach * sides[:, None] / [camera.fx, camera.fy]
    if not np.isfinite(lens.unproject(offsets)).all():
        said = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise CameraError(
            f"a lens of the model {lens.model!r} with [{said}] ({' '.join(WIDE_MODELS[lens.model])}) turns "
            f"back {math.degrees(lens.widest_rad):.0f} degrees off the optical axis, less than half way to "
            "an edge of the image: check the order of its numbers"
        )


def _check_focal_lengths(camera: Pinhole) -> None:
    for name, focal, centre, size, side in (
        ("fx", camera.fx, "cx", camera.width, "width"),
        ("fy", camera.fy, "cy", camera.height, "height"),
    ):
        view_deg = _view_deg(size, focal)
        if view_deg <= WIDEST_VIEW_DEG:
            continue
        if focal < 3.0 and max(camera.cx, camera.cy) <= 1.5:
            reason = f"are they normalised? Multiply {name} and {centre} by the {side} {size}"
        else:
            reason = (
                f"is it in millimetres? In pixels it is {focal:g} * {size} / (the sensor's {side} in "
                "millimetres)"
            )
        raise CameraError(
            f"{name} {focal:g} is a view of {view_deg:.0f} degrees in an image whose {side} is {size}, but "
            f"focal lengths are in pixels: {reason}"
        )


def _check_principal_point(camera: Pinhole) -> list[str]:
    """Refuse a principal point that no image of this size has; return what is unusual about it."""
    if -0.5 <= min(camera.cx, camera.cy) <= 1.5 and min(camera.width, camera.height) > 8:
        reason = "was it never set?" if 0.0 in (camera.cx, camera.cy) else "is it normalised?"
        raise CameraError(
            f"cx {camera.cx:g}, cy {camera.cy:g} is at the edge of the image, but the principal point is a "
            f"pixel near the middle, about {(camera.width - 1) / 2:g} {(camera.height - 1) / 2:g}: {reason}"
        )
    for name, value, size, side in (
        ("cx", camera.cx, camera.width, "width"),
        ("cy", camera.cy, camera.height, "height"),
    ):
        if not -0.5 <= value <= size - 0.5:
            raise CameraError(
                f"{name} {value:g} lies outside the image, whose {side} is {size}: the principal point is a "
                "pixel near its middle; are the intrinsics of images of another size?"
            )
    shares = ((camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height)
    alike = abs(shares[0] - shares[1]) < _ALIKE
    both_off = max(shares) < _USUAL_BOTH[0] or min(shares) > _USUAL_BOTH[1]
    if all(_is_within(share, _USUAL_CENTRE) for share in shares) and not (alike and both_off):
        return []
    found = (
        f"the principal point cx {camera.cx:g}, cy {camera.cy:g} fits an image of about "
        f"{2 * camera.cx + 1:.0f}x{2 * camera.cy + 1:.0f}, not {camera.width}x{camera.height}"
    )
    low, high = _OF_ANOTHER_SIZE if alike else _FAR_CENTRE
    is_near = all(_is_within(share, _FARTHEST_CENTRE) for share in shares)
    if not is_near or max(shares) < low or min(shares) > high:
        raise CameraError(
            f"{found}: the intrinsics are of images of another size; multiply fx, fy, cx and cy by the ratio "
            "of the sizes, or calibrate with these images"
        )
    return [f"{found}: unless the images are cropped, these intrinsics and the result are wrong"]


def _is_within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


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
    names = "k1 k2 p1 p2 k3" + (" k4 k5 k6" if len(camera.distortion) > 5 else "")
    return "distortion [" + ", ".join(f"{value:g}" for value in camera.distortion) + f"] ({names})"


def _distorted(camera: Pinhole, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Raw pixels ``(N, 2)`` of undistorted ones: Brown's model, written out."""
    x, y = ((points_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T
    k1, k2, p1, p2, k3, *rational = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if rational:
        k4, k5, k6 = rational
        radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([camera.fx * distorted_x + camera.cx, camera.fy * distorted_y + camera.cy], axis=1)
