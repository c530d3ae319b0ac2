# SPDX-License-Identifier: Apache-2.0
"""Calibrations as Basalt and camodocal write them, as the keys of an OpenCV or ROS calibration.

Basalt's ``calibration.json`` has ``value0: {intrinsics: [{camera_type, intrinsics: {fx, ...}}], resolution:
[[width, height]]}``. Camodocal's files, which VINS-Mono reads, have a ``model_type`` and
``projection_parameters``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamdepth.errors import CameraError

_BASALT = {
    "pinhole": ("plumb_bob", ()),
    "pinhole-radtan8": ("rational_polynomial", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("fisheye", ("k1", "k2", "k3", "k4")),
    "ds": ("double_sphere", ("xi", "alpha")),
    "eucm": ("extended_unified", ("alpha", "beta")),
    "ucm": ("extended_unified", ("alpha",)),  # beta is 1
    "fov": ("fov", ("w",)),
}
"""Basalt's camera types: our name of the model, and the keys of its coefficients."""

_CAMODOCAL = {
    "PINHOLE": ("plumb_bob", ("fx", "fy", "cx", "cy"), ()),
    "MEI": ("mei", ("gamma1", "gamma2", "u0", "v0"), ()),
    "KANNALA_BRANDT": ("fisheye", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
}
"""Camodocal's models: our name, its pinhole, and coefficients among the projection parameters."""
_TANGENTIAL = ("k1", "k2", "p1", "p2")


def opencv_keys(width: Any, height: Any, pinhole: tuple[Any, ...]) -> dict[Any, Any]:
    """Size and ``(fx, fy, cx, cy)`` under OpenCV's keys."""
    fx, fy, cx, cy = pinhole
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {"image_width": width, "image_height": height, "camera_matrix": matrix}


def is_basalt(values: dict[Any, Any]) -> bool:
    """True of Basalt's ``calibration.json``."""
    inner = values.get("value0")
    return isinstance(inner, dict) and "intrinsics" in inner and "resolution" in inner


def from_basalt(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    """Raises CameraError: as :func:`slamdepth.calibration.slam_dialects.as_opencv`."""
    inner = values["value0"]
    cameras, sizes = inner["intrinsics"], inner["resolution"]
    if not isinstance(cameras, list) or not isinstance(sizes, list) or len(cameras) != len(sizes):
        raise CameraError(f"{path}: 'intrinsics' and 'resolution' must be lists of one length")
    if len(cameras) != 1:
        raise CameraError(
            f"{path}: holds {len(cameras)} cameras; leave the intrinsics and resolution of the one that took "
            "the images in it"
        )
    camera, size = cameras[0], sizes[0]
    kind = str(camera.get("camera_type")) if isinstance(camera, dict) else ""
    if kind not in _BASALT:
        raise CameraError(f"{path}: camera_type {kind[:40]!r} is not supported, only {', '.join(_BASALT)}")
    if not isinstance(size, list) or len(size) != 2:
        raise CameraError(f"{path}: key 'resolution' must be [[width, height]], found {str(sizes)[:60]}")
    model, names = _BASALT[kind]
    of_camera = camera.get("intrinsics")
    fx, fy, cx, cy, *coefficients = _named(
        path, f"intrinsics of {kind!r}", of_camera, ("fx", "fy", "cx", "cy", *names)
    )
    width, height = size
    found = opencv_keys(width, height, (fx, fy, cx, cy))
    found["distortion_model"] = model
    found["distortion_coefficients"] = [*coefficients, *([1.0] if kind == "ucm" else [])]
    return found


def is_camodocal(values: dict[Any, Any]) -> bool:
    """True of a camera file of camodocal or VINS-Mono."""
    return "model_type" in values and "projection_parameters" in values


def from_camodocal(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    """Raises CameraError: as :func:`slamdepth.calibration.slam_dialects.as_opencv`."""
    kind = str(values["model_type"])
    if kind.upper() not in _CAMODOCAL:
        raise CameraError(f"{path}: model_type {kind[:40]!r} is not supported, only {', '.join(_CAMODOCAL)}")
    model, pinhole, names = _CAMODOCAL[kind.upper()]
    width, height = _named(path, "camera file", values, ("image_width", "image_height"))
    fx, fy, cx, cy, *coefficients = _named(
        path, "projection_parameters", values["projection_parameters"], (*pinhole, *names)
    )
    if not names:
        distortion = values.get("distortion_parameters")
        coefficients = _named(path, "distortion_parameters", distortion, _TANGENTIAL) if distortion else []
    if model == "mei":
        xi = _named(path, "mirror_parameters", values.get("mirror_parameters"), ("xi",))
        coefficients = [*xi, *coefficients]
    found = opencv_keys(width, height, (fx, fy, cx, cy))
    found["distortion_model"], found["distortion_coefficients"] = model, coefficients
    return found | ({"fps": values["fps"]} if "fps" in values else {})


def _named(path: Path, where: str, values: Any, names: tuple[str, ...]) -> list[Any]:
    if not isinstance(values, dict):
        raise CameraError(f"{path}: {where} must hold {', '.join(names)}")
    missing = [name for name in names if name not in values]
    if missing:
        raise CameraError(f"{path}: {where} without {missing[0]!r}: add it")
    return [values[name] for name in names]
