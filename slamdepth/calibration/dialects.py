# SPDX-License-Identifier: Apache-2.0
"""Calibrations as OpenCV's and ROS's tools write them, translated to the keys of ``camera.yaml``.

OpenCV's ``FileStorage`` writes ``camera_matrix: !!opencv-matrix {rows, cols, dt, data}`` below a line
``%YAML:1.0``, ROS ``camera_matrix: {rows, cols, data}`` and a ``distortion_model``; names differ a little
from tool to tool, and a printed ``camera_info`` has ``K`` and ``D`` or ``k`` and ``d``. Pixels have integer
centres in all, as here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from slamdepth.calibration.wide_lens import WIDE_MODELS
from slamdepth.errors import CameraError

_NAMES = {
    "matrix": ("cameramatrix", "k"),
    "distortion": ("distortioncoefficients", "distcoeffs", "distcoeff", "d"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
    "model": ("distortionmodel",),
    "fisheye": ("fisheyemodel",),
    "fps": ("fps",),
    "depth_factor": ("depthfactor",),
}
"""What is read, and its names in lower case without underscores."""

_BROWN_CONRADY = ("plumb_bob", "rational_polynomial", "radtan", "radial_tangential", "brown_conrady")
_UNNAMED = ("", "none", "pinhole", "inverse_brown_conrady", "modified_brown_conrady")
"""Models that drivers name for images without distortion; taken where all coefficients are zero."""
_WIDE = {
    "equidistant": "fisheye",
    "equi": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
    "kannala_brandt8": "fisheye",
    "kannalabrandt8": "fisheye",
    "kb4": "fisheye",
    "ds": "double_sphere",
    "eucm": "extended_unified",
    "mei": "unified",
    "omni": "unified",
    "omnidirectional": "unified",
    **{name: name for name in WIDE_MODELS},
}
"""Models of wide lenses by the names that tools give them."""
_SKEW_SHARE = 1e-6


class CalibrationLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which also takes OpenCV's matrices, as mappings."""


def _opencv_matrix(loader: yaml.SafeLoader, node: Any) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


CalibrationLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def as_yaml(text: str) -> str:
    """``text`` with OpenCV's first line, which is no YAML, as a comment; lines keep their numbers."""
    return re.sub(r"\A(\s*)%YAML:", r"\1# YAML:", text)


def is_calibration(values: dict[Any, Any]) -> bool:
    """True where the keys of a file are those of OpenCV or ROS rather than of ``camera.yaml``."""
    return "fx" not in values and any(_normalised(key) in _NAMES["matrix"] for key in values)


def translated(path: Path, values: dict[Any, Any]) -> dict[str, Any]:
    """The values of a calibration under the keys of ``camera.yaml``.

    Raises:
        CameraError: what is needed is missing, malformed or said twice, or the lens is of an unknown model;
            names file and key.
    """
    keys = _find_keys(path, values)
    fx, skew, cx, _, fy, cy, *last = _matrix(path, keys["matrix"], values[keys["matrix"]])
    if abs(skew) > _SKEW_SHARE * abs(fx):
        raise CameraError(f"{path}: key {keys['matrix']!r} has a skew of {skew:g}: calibrate without")
    if not any((fx, fy, cx, cy)):
        raise CameraError(f"{path}: key {keys['matrix']!r} is all zero: this camera was never calibrated")
    if last != [0.0, 0.0, 1.0]:
        raise CameraError(f"{path}: key {keys['matrix']!r} must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    found: dict[str, Any] = {key: values[keys[key]] for key in ("width", "height")}
    found |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **_lens(path, keys, values)}
    return found | {key: values[keys[key]] for key in ("fps", "depth_factor") if key in keys}


def _find_keys(path: Path, values: dict[Any, Any]) -> dict[str, Any]:
    keys: dict[str, Any] = {}
    for what, names in _NAMES.items():
        given = [key for key in values if _normalised(key) in names]
        if len(given) > 1:
            raise CameraError(f"{path}: keys {given[0]!r} and {given[1]!r} say the same; leave one")
        if given:
            keys[what] = given[0]
    missing = [f"image_{what}" for what in ("width", "height") if what not in keys]
    if missing:
        raise CameraError(
            f"{path}: a calibration without {' and '.join(missing)}: add the size of its images, such as "
            "'image_width: 640' and 'image_height: 480'"
        )
    return keys


def _normalised(key: Any) -> str:
    return str(key).lower().replace("_", "")


def _lens(path: Path, keys: dict[str, Any], values: dict[Any, Any]) -> dict[str, Any]:
    """``distortion``, and ``model`` of a wide lens."""
    model = values[keys["model"]] if "model" in keys else "plumb_bob"
    if "fisheye" in keys and values[keys["fisheye"]]:
        model = "fisheye"
    name = str(model or "").lower().replace("-", "_")
    numbers = _coefficients(path, keys, values)
    if name in _WIDE:
        return {"model": _WIDE[name], "distortion": _of_wide(path, keys, numbers, _WIDE[name])}
    if name in _UNNAMED and not any(numbers):
        return {"distortion": [0.0] * 5}
    if name not in _BROWN_CONRADY:
        raise CameraError(
            f"{path}: a lens of the model {str(model)[:40]!r} is not supported, only a pinhole with [k1, k2, "
            f"p1, p2, k3, k4, k5, k6] (plumb_bob, rational_polynomial), and {', '.join(WIDE_MODELS)}: "
            "calibrate with one of them, or undistort the images first"
        )
    if any(numbers[8:]):
        raise CameraError(
            f"{path}: key {keys['distortion']!r} has {len(numbers)} coefficients; supported are [k1, k2, p1, "
            "p2, k3, k4, k5, k6]: calibrate without the thin prism or tilted model"
        )
    return {"distortion": (numbers + [0.0] * 8)[: 8 if any(numbers[5:]) else 5]}


def _of_wide(path: Path, keys: dict[str, Any], numbers: list[float], model: str) -> list[float]:
    names = WIDE_MODELS[model]
    few = {1, len(names)} if model == "unified" else {len(names)}  # xi alone: without distortion
    if len(numbers) not in few and (len(numbers) < len(names) or any(numbers[len(names) :])):
        raise CameraError(
            f"{path}: key {keys.get('distortion', 'distortion_coefficients')!r} of a lens of the model "
            f"{model!r} must be {len(names)} numbers [{', '.join(names)}], found {len(numbers)}"
        )
    return (numbers + [0.0] * len(names))[: len(names)]


def _coefficients(path: Path, keys: dict[str, Any], values: dict[Any, Any]) -> list[float]:
    if "distortion" not in keys:
        like = [key for key in values if "dist" in _normalised(key) and key != keys.get("model")]
        if like:
            raise CameraError(f"{path}: key {like[0]!r} is not known; write 'distortion_coefficients'")
        return []
    key = keys["distortion"]
    return _numbers(path, key, [] if values[key] is None else values[key])


def _matrix(path: Path, key: Any, value: Any) -> list[float]:
    numbers = _numbers(path, key, value)
    if len(numbers) != 9:
        raise CameraError(f"{path}: key {key!r} must be 3 x 3 numbers, found {len(numbers)}")
    return numbers


def _numbers(path: Path, key: Any, value: Any) -> list[float]:
    """The numbers of a matrix: a mapping with rows, cols and data, or lists."""
    rows = value.get("data") if isinstance(value, dict) else value
    if not isinstance(rows, list):
        raise CameraError(f"{path}: key {key!r} must be a matrix with 'rows', 'cols' and 'data: [...]'")
    flat = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if isinstance(value, dict):
        height, width = value.get("rows"), value.get("cols")
        if not isinstance(height, int) or not isinstance(width, int) or height * width != len(flat):
            raise CameraError(
                f"{path}: key {key!r} has {len(flat)} numbers in 'data', "
                f"not rows x cols = {height!r} x {width!r}"
            )
    return [_number(path, key, number) for number in flat]


def number_of(value: Any) -> float:
    """A number of a YAML file, also where it is quoted or, as ``1e-05``, a text to YAML 1.1.

    Raises:
        ValueError: it is none.
        OverflowError: it is beyond any float.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(value)
    if isinstance(value, str) and "_" in value:  # Python's 1_000, which no calibration means
        raise ValueError(value)
    return float(value)


def _number(path: Path, key: Any, value: Any) -> float:
    try:
        return number_of(value)
    except (ValueError, OverflowError) as error:
        raise CameraError(f"{path}: key {key!r} must hold numbers, found {str(value)[:40]!r}") from error
