# SPDX-License-Identifier: Apache-2.0
"""Calibrations as Kalibr, EuRoC and ORB-SLAM write them, as the keys of an OpenCV or ROS calibration.

Kalibr's ``camchain.yaml`` and EuRoC's ``sensor.yaml`` have ``intrinsics: [fx, fy, cx, cy]`` and
``resolution``, the former below ``cam0``; ORB-SLAM's settings have ``Camera.fx`` or ``Camera1.fx``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamdepth.errors import CameraError

_ORB_SLAM = ("Camera1", "Camera")
_ORB_SLAM_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_ORB_SLAM_OTHERS = {
    "Camera.fps": "fps",
    "DepthMapFactor": "depth_factor",
    "RGBD.DepthMapFactor": "depth_factor",
}
_ORB_SLAM_PINHOLES = ("pinhole", "rectified")


def as_opencv(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    """``values`` of a Kalibr, EuRoC or ORB-SLAM file under OpenCV's keys, of any other file unchanged.

    Raises:
        CameraError: what is needed is missing or malformed, the file holds several cameras, or the camera is
            no pinhole; names file and key.
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
    return values


def _is_kalibr(values: Any) -> bool:
    return isinstance(values, dict) and "intrinsics" in values and "resolution" in values


def _from_kalibr(path: Path, values: dict[Any, Any]) -> dict[Any, Any]:
    model = str(values.get("camera_model", "pinhole"))
    if model.lower() != "pinhole":
        raise CameraError(f"{path}: camera_model {model[:40]!r} is not supported: calibrate as a pinhole")
    fx, fy, cx, cy = _list(path, values, "intrinsics", "[fx, fy, cx, cy]", 4)
    width, height = _list(path, values, "resolution", "[width, height]", 2)
    coefficients = values.get("distortion_coefficients", values.get("distortion_coeffs"))
    found = _opencv(width, height, (fx, fy, cx, cy))
    found["distortion_coefficients"] = coefficients
    found["distortion_model"] = values.get("distortion_model", "radtan")
    return found | ({"fps": values["rate_hz"]} if "rate_hz" in values else {})


def _from_orb_slam(path: Path, values: dict[Any, Any], prefix: str) -> dict[Any, Any]:
    kind = str(values.get("Camera.type", "PinHole"))
    if kind.lower() not in _ORB_SLAM_PINHOLES:
        raise CameraError(f"{path}: Camera.type {kind[:40]!r} is not supported: calibrate as a pinhole")
    names = [f"{prefix}.{name}" for name in ("fx", "fy", "cx", "cy")]
    sides = ["Camera.width", "Camera.height"]
    missing = [name for name in (*names, *sides) if name not in values]
    if missing:
        raise CameraError(f"{path}: an ORB-SLAM file without {missing[0]}: add it")
    width, height = (values[side] for side in sides)
    found = _opencv(width, height, tuple(values[name] for name in names))
    found["distortion_coefficients"] = [values.get(f"{prefix}.{name}", 0.0) for name in _ORB_SLAM_DISTORTION]
    return found | {key: values[name] for name, key in _ORB_SLAM_OTHERS.items() if name in values}


def _opencv(width: Any, height: Any, pinhole: tuple[Any, ...]) -> dict[Any, Any]:
    fx, fy, cx, cy = pinhole
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {"image_width": width, "image_height": height, "camera_matrix": matrix}


def _list(path: Path, values: dict[Any, Any], key: str, meaning: str, length: int) -> list[Any]:
    found = values[key]
    if not isinstance(found, list) or len(found) != length:
        raise CameraError(f"{path}: key {key!r} must be {meaning}, found {str(found)[:60]}")
    return found
