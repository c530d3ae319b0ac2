# SPDX-License-Identifier: Apache-2.0
"""Models of lenses too wide for a pinhole: a profile over the angle to the optical axis.

A ray at the angle ``theta`` to the optical axis is seen at the distance ``rho(theta)`` from the principal
point, in units of the focal length, at the same angle around it. The models differ in ``rho`` alone:

* ``fisheye`` (k1 k2 k3 k4), Kannala and Brandt 2006, OpenCV's fisheye, Kalibr's equidistant:
  ``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``;
* ``double_sphere`` (xi alpha), Usenko et al. 2018;
* ``extended_unified`` (alpha beta), Khomutenko et al. 2016;
* ``unified`` (xi k1 k2 p1 p2), Mei and Rives 2007, OpenCV's omnidir, Kalibr's omni: ``sin theta / (xi + cos
  theta)``, then Brown's distortion;
* ``fov`` (w), Devernay and Faugeras 2001: ``atan(2 tan theta tan(w / 2)) / w``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import CameraError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Profile = Callable[[Array, tuple[float, ...]], Array]

WIDE_MODELS = {
    "fisheye": ("k1", "k2", "k3", "k4"),
    "double_sphere": ("xi", "alpha"),
    "extended_unified": ("alpha", "beta"),
    "unified": ("xi", "k1", "k2", "p1", "p2"),
    "fov": ("w",),
}
"""The models, and the names of their coefficients."""

_TABLE = 4097
_STEPS = 12
_STEP_RAD = 1e-6
_STRONGEST = 1e3


@dataclass(frozen=True)
class WideLens:
    """A wide lens: where on the image plane at distance one rays are seen.

    Attributes:
        model: one of :data:`WIDE_MODELS`.
        coefficients: in the order that :data:`WIDE_MODELS` names them.

    Raises:
        CameraError: the model is unknown, or has not these coefficients.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        names = WIDE_MODELS.get(self.model)
        if names is None:
            raise CameraError(f"camera: unknown lens model {self.model!r}; known: {', '.join(WIDE_MODELS)}")
        if len(self.coefficients) != len(names):
            raise CameraError(
                f"camera: a lens of the model {self.model!r} needs {len(names)} numbers [{', '.join(names)}]"
            )
        if not all(math.isfinite(value) and abs(value) <= _STRONGEST for value in self.coefficients):
            raise CameraError(f"camera: coefficients of the model {self.model!r} must be finite and moderate")
        if self.widest_rad < math.radians(5.0):
            said = ", ".join(f"{value:g}" for value in self.coefficients)
            raise CameraError(
                f"camera: a lens of the model {self.model!r} with [{said}] ({' '.join(names)}) sees nothing: "
                "check the order of its numbers"
            )

    @property
    def widest_rad(self) -> float:
        """The largest angle to the optical axis that is seen once: there the profile turns back, or ends."""
        return float(_table(self.model, self.coefficients)[0][-1])

    @property
    def slope(self) -> float:
        """``d rho / d theta`` on the optical axis: focal lengths times this are pixels a radian there."""
        return float(_profile(self.model, self.coefficients, np.array([_STEP_RAD]))[0] / _STEP_RAD)

    def project(self, rays: NDArray[np.floating]) -> Array:
        """Positions ``(N, 2)`` on the image plane of ``rays`` ``(N, 3)`` of any length.

        A pixel is ``(fx x + cx, fy y + cy)``. NaN where the lens does not see the ray.
        """
        x, y, z = np.asarray(rays, np.float64).reshape(-1, 3).T
        side = np.hypot(x, y)
        theta = np.arctan2(side, z)
        is_seen = theta <= self.widest_rad
        rho = _profile(self.model, self.coefficients, np.where(is_seen, theta, 0.0))
        share = np.where(is_seen, rho, np.nan) / np.where(side > 0, side, 1.0)
        plane = np.stack([x * share, y * share], axis=1)
        return _brown(plane, self.coefficients[1:]) if self.model == "unified" else plane

    def unproject(self, plane: NDArray[np.floating]) -> Array:
        """Unit rays ``(N, 3)`` of positions ``(N, 2)`` on the image plane, NaN where no ray is seen."""
        plane = np.asarray(plane, np.float64).reshape(-1, 2)
        if self.model == "unified":
            plane = _without_brown(plane, self.coefficients)
        rho = np.hypot(plane[:, 0], plane[:, 1])
        theta = _angles(self.model, self.coefficients, rho)
        share = np.sin(theta) / np.where(rho > 0, rho, 1.0)
        return np.stack([plane[:, 0] * share, plane[:, 1] * share, np.cos(theta)], axis=1)

    def turned(self, axes: tuple[tuple[int, int], tuple[int, int]]) -> WideLens:
        """The lens of images whose axes are ``axes``, rows of a matrix of -1, 0, 1 from the old x, y."""
        if self.model != "unified":
            return self
        (a, b), (c, d) = axes
        xi, k1, k2, p1, p2 = self.coefficients
        return replace(self, coefficients=(xi, k1, k2, c * p2 + d * p1, a * p2 + b * p1))


def _profile(model: str, numbers: tuple[float, ...], theta: Array) -> Array:
    """``rho`` ``(N,)`` at the angles ``theta`` ``(N,)`` in radians; infinity where no plane shows them."""
    if model == "fisheye":
        k1, k2, k3, k4 = numbers
        t2 = theta * theta
        return np.asarray(theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))
    sin, cos = np.sin(theta), np.cos(theta)
    if model == "fov":
        (w,) = numbers
        with np.errstate(all="ignore"):
            rho = np.arctan(2.0 * sin / np.maximum(cos, 1e-12) * math.tan(w / 2.0)) / w
        return np.where(cos > 0.0, rho, np.inf)
    if model == "double_sphere":
        xi, alpha = numbers
        shifted = xi + cos
        bottom = alpha * np.hypot(sin, shifted) + (1.0 - alpha) * shifted
    elif model == "extended_unified":
        alpha, beta = numbers
        bottom = alpha * np.sqrt(np.maximum(beta * sin * sin + cos * cos, 0.0)) + (1.0 - alpha) * cos
    else:
        bottom = numbers[0] + cos
    return np.where(bottom > 1e-9, sin / np.maximum(bottom, 1e-9), np.inf)


@lru_cache(maxsize=64)
def _table(model: str, numbers: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Angles from 0 to where the profile stops growing, the profile there, and the same with Brown's radial
    distortion, all ``(N,)``."""
    theta = np.linspace(0.0, math.pi, _TABLE)
    with np.errstate(all="ignore"):
        rho = _profile(model, numbers, theta)
        shown = rho
        if model == "unified":  # Brown's distortion may turn back sooner
            shown = rho * (1.0 + rho * rho * (numbers[1] + rho * rho * numbers[2]))
        grows = (np.diff(shown) > 1e-12) & (np.diff(rho) > 1e-12) & np.isfinite(rho[1:])
    end = 1 + (len(grows) if grows.all() else int(np.argmin(grows)))
    return theta[:end], rho[:end], shown[:end]


def _angles(model: str, numbers: tuple[float, ...], rho: Array) -> Array:
    """Inverse of the profile by Newton's method within a bracket; NaN beyond its end."""
    theta_of, rho_of, _ = _table(model, numbers)
    is_seen = rho <= rho_of[-1]
    wanted = np.where(is_seen, rho, 0.0)
    at = np.clip(np.searchsorted(rho_of, wanted), 1, len(rho_of) - 1)
    low, high = theta_of[at - 1].copy(), theta_of[at].copy()
    theta = np.interp(wanted, rho_of, theta_of)
    for _ in range(_STEPS):
        error = _profile(model, numbers, theta) - wanted
        low, high = np.where(error <= 0, theta, low), np.where(error > 0, theta, high)
        step = _profile(model, numbers, theta + _STEP_RAD) - _profile(model, numbers, theta - _STEP_RAD)
        with np.errstate(all="ignore"):
            better = theta - error * (2.0 * _STEP_RAD) / step
        theta = np.where((better >= low) & (better <= high), better, (low + high) / 2.0)
    return np.where(is_seen, theta, np.nan)


def _brown(plane: Array, numbers: tuple[float, ...]) -> Array:
    k1, k2, p1, p2 = numbers
    x, y = plane.T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def _without_brown(plane: Array, numbers: tuple[float, ...]) -> Array:
    """Inverse of :func:`_brown` for the unified model, by Newton's method from the radial distortion alone;
    NaN where it does not come back."""
    _, k1, k2, p1, p2 = numbers
    if not any(numbers[1:]):
        return plane
    _, rho_of, shown_of = _table("unified", numbers)
    shown = np.hypot(plane[:, 0], plane[:, 1])
    found = plane * (np.interp(shown, shown_of, rho_of) / np.where(shown > 0, shown, 1.0))[:, None]
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            x, y = found.T
            r2 = x * x + y * y
            radial, growth = 1.0 + r2 * (k1 + r2 * k2), 2.0 * k1 + 4.0 * k2 * r2
            xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
            xy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
            yy = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
            dx, dy = (_brown(found, numbers[1:]) - plane).T
            det = xx * yy - xy * xy
            found = found - np.stack([yy * dx - xy * dy, xx * dy - xy * dx], axis=1) / det[:, None]
        lost = np.abs(_brown(found, numbers[1:]) - plane).max(axis=1)
        return np.where((lost < 1e-9 * (1.0 + shown))[:, None], found, np.nan)
