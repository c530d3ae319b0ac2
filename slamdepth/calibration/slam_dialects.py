# SPDX-License-Identifier: Apache-2.0
"""Calibrations as Kalibr, EuRoC and ORB-SLAM write them, as the keys of an OpenCV or ROS calibration.

Kalibr's ``camchain.yaml`` and EuRoC's ``sensor.yaml`` have ``intrinsics: [fx, fy, cx, cy]`` and
``resolution``, the former below ``cam0``; ORB-SLAM's settings have ``Camera.fx`` or ``Camera1.fx``. Those of
Basalt and camodocal are in :mod:`slamdepth.calibration.wide_dialects`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamdepth.calibration.wide_dialects import (
    from_basalt,
    from_camodocal,
    is_basalt,
    is_camodocal,
    opencv_keys,
)
from slamdepth.errors import CameraError

_ORB_SLAM = ("Camera1", "Camera")
_ORB_SLAM_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_ORB_SLAM_OTHERS = {
    "Camera.fps": "fps",
    "DepthMapFactor": "depth_factor",
    "RGBD.DepthMapFactor": "depth_factor",
}
_ORB_SLAM_PINHOLES = ("pinhole", "rectified")
_ORB_SLAM_FISHEYE = "kannalabrandt8"
_KALIBR: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "omni": ("xi",),
    "ds": ("xi", "alpha"),
    "eucm": ("alpha", "beta"),
}
"""Kalibr's camera models, and what comes before ``fx fy cx cy`` in their intrinsics."""


def as_opencv(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    """``values`` of a Kalibr, EuRoC or ORB-SLAM file under OpenCV's keys, of any other file unchanged.

    Raises:
        CameraError: what is needed is missing or malformed, the file holds several cameras, or the camera is
            of an unknown model; names file and key.
    """
    cameras = [key for key in values if str(key).startswith("cam") and _is_kalibr(values[key])]
    if len(cameras) > 1:
        named = ", ".join(map(str, cameras))
        raise CameraError(f"{path}: holds the cameras {named}; leave the one that took the images in it")
    if cameras:
        return _from_kalibr(path, values[cameras[0]])
    if _is_kalibr(values):
        return _from_kalibr(path, values)
    for prefix in _ORB_SLAM:
        if f"{prefix}.fx" in values:
            return _from_orb_slam(path, values, prefix)
    for is_of, translate in ((is_basalt, from_basalt), (is_camodocal, from_camodocal)):
        if is_of(values):
            return translate(path, values)
    return values


def _is_kalibr(values: Any) -> bool:
    return isinstance(values, dict) and "intrinsics" in values and "resolution" in values


def _from_kalibr(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    model = str(values.get("camera_model", "pinhole"))
    names = _KALIBR.get(model.lower())
    if names is None:
        raise CameraError(
            f"{path}: camera_model {model[:40]!r} is not supported, only {', '.join(_KALIBR)}: calibrate "
            "with one of them"
        )
    order = [*names, "fx", "fy", "cx", "cy"]
    *own, fx, fy, cx, cy = _list(path, values, "intrinsics", f"[{', '.join(order)}]", len(order))
    width, height = _list(path, values, "resolution", "[width, height]", 2)
    distortion = values.get("distortion_model", "radtan" if model == "pinhole" else "none")
    coefficients = values.get("distortion_coefficients", values.get("distortion_coeffs"))
    found = opencv_keys(width, height, (fx, fy, cx, cy))
    found["distortion_coefficients"], found["distortion_model"] = coefficients, distortion
    if names:
        more = coefficients if model.lower() == "omni" and isinstance(coefficients, list) else []
        if str(distortion).lower() not in (("none", "radtan") if model.lower() == "omni" else ("none",)):
            raise CameraError(
                f"{path}: camera_model {model!r} with distortion_model {str(distortion)[:40]!r} is not "
                "supported"
            )
        found["distortion_coefficients"], found["distortion_model"] = [*own, *more], model
    return found | ({"fps": values["rate_hz"]} if "rate_hz" in values else {})


def _from_orb_slam(path: Path, values: dict[Any, Any], prefix: str) -> dict[Any, Any]:
    kind = str(values.get("Camera.type", "PinHole"))
    is_fisheye = kind.lower() == _ORB_SLAM_FISHEYE
    if kind.lower() not in _ORB_SLAM_PINHOLES and not is_fisheye:
        raise CameraError(
            f"{path}: Camera.type {kind[:40]!r} is not supported, only PinHole, Rectified and KannalaBrandt8"
        )
    lens = [f"{prefix}.{name}" for name in ("k1", "k2", "k3", "k4")] if is_fisheye else []
    names = [f"{prefix}.{name}" for name in ("fx", "fy", "cx", "cy")]
    sides = ["Camera.width", "Camera.height"]
    missing = [name for name in (*names, *lens, *sides) if name not in values]
    if missing:
        raise CameraError(f"{path}: an ORB-SLAM file without {missing[0]}: add it")
    width, height = (values[side] for side in sides)
    found = opencv_keys(width, height, tuple(values[name] for name in names))
    if is_fisheye:
        found |= {"distortion_model": "fisheye", "distortion_coefficients": [values[name] for name in lens]}
    else:
        given = [values.get(f"{prefix}.{name}", 0.0) for name in _ORB_SLAM_DISTORTION]
        found["distortion_coefficients"] = given
    return found | {key: values[name] for name, key in _ORB_SLAM_OTHERS.items() if name in values}


def _list(path: Path, values: dict[Any, Any], key: str, meaning: str, length: int) -> list[Any]:
    found = values[key]
    if not isinstance(found, list) or len(found) != length:
        raise CameraError(f"{path}: key {key!r} must be {meaning}, found {str(found)[:60]}")
    return found
