# SPDX-License-Identifier: Apache-2.0
"""``camera.yaml``: the intrinsics of a sequence, in pixels.

::

    width: 640
    height: 480
    fx: 535.4
    fy: 539.2
    cx: 320.1
    cy: 247.6
    distortion: [0.0, 0.0, 0.0, 0.0, 0.0]   # k1 k2 p1 p2 k3, or with k4 k5 k6; may be absent
    depth_factor: 5000.0                    # raw units per metre; may be absent
    fps: 30.0                               # may be absent

A wide lens has ``model: fisheye`` (or another of :data:`slamdepth.calibration.wide_lens.WIDE_MODELS`) and its
coefficients as ``distortion``.

Numbers may be quoted or have an exponent without a dot, and a ``---`` or ``...`` may end the file. Files of
OpenCV's, ROS's (:mod:`slamdepth.calibration.dialects`), Kalibr's, EuRoC's, ORB-SLAM's
(:mod:`slamdepth.calibration.slam_dialects`), Basalt's and camodocal's
(:mod:`slamdepth.calibration.wide_dialects`) are read too.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import yaml

from slamdepth.calibration.dialects import (
    CalibrationLoader,
    as_yaml,
    is_calibration,
    number_of,
    translated,
)
from slamdepth.calibration.plausible import Pinhole, check_plausible
from slamdepth.calibration.slam_dialects import as_opencv
from slamdepth.calibration.wide_lens import WIDE_MODELS, WideLens
from slamdepth.errors import CameraError

_log = logging.getLogger(__name__)

_Camera = TypeVar("_Camera", bound=Pinhole)

CAMERA_FILE = "camera.yaml"
REQUIRED_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
OPTIONAL_KEYS = ("model", "distortion", "depth_factor", "fps")
_PINHOLE_MODEL = "brown_conrady"


def read_camera(path: str | Path, make: Callable[..., _Camera], notes: list[str] | None = None) -> _Camera:
    """Read a ``camera.yaml``, or a calibration of another tool.

    Args:
        make: the class of the camera, which takes the keys of the file by name.
        notes: takes a line for whatever is unusual in it, or was read from another format; None: it is
            logged as a warning.

    Raises:
        CameraError: the file is missing or no YAML, a key is missing, unknown, given twice or of a wrong
            type, or no camera has such intrinsics; names the file, the key and the allowed ones.
    """
    path = Path(path)
    return make_camera(path, _load(path), make, notes)


def read_values(path: Path) -> dict[Any, Any]:
    """The keys of a calibration file, for those that hold several cameras; see :func:`make_camera`.

    Raises:
        CameraError: the file cannot be read, or is no YAML with keys.
    """
    return _load(path)


def make_camera(
    path: Path, values: dict[Any, Any], make: Callable[..., _Camera], notes: list[str] | None = None
) -> _Camera:
    """The camera of what :func:`read_camera` reads of a file, or of a recording that holds the same.

    Args:
        path: names it in messages.
        values: the keys of a ``camera.yaml``, or of another tool's calibration.

    Raises:
        CameraError: as :func:`read_camera`.
    """
    values = as_opencv(path, values)
    foreign = is_calibration(values)
    camera = _made(path, translated(path, values) if foreign else values, make)
    try:
        unusual = [f"{path.name}: {note}" for note in check_plausible(camera)]
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
    if foreign:
        unusual.insert(0, f"{path.name}: another tool's calibration, read as {_described(camera)}")
    if notes is None:
        for note in unusual:
            _log.warning("%s", note)
    else:
        notes += unusual
    return camera


def _described(camera: Pinhole) -> str:
    values = " ".join(f"{key} {getattr(camera, key):g}" for key in ("fx", "fy", "cx", "cy"))
    numbers, what = camera.distortion, "distortion"
    if camera.lens is not None:
        numbers, what = camera.lens.coefficients, camera.lens.model
    distortion = ", ".join(f"{value:g}" for value in numbers)
    return f"{camera.width}x{camera.height}, {values}, {what} [{distortion}], {camera.fps:g} Hz"


def _made(path: Path, values: dict[Any, Any], make: Callable[..., _Camera]) -> _Camera:
    allowed = REQUIRED_KEYS + OPTIONAL_KEYS
    unknown = [key for key in values if key not in allowed]
    if unknown:
        raise CameraError(f"{path}: unknown key {unknown[0]!r}; allowed are {', '.join(allowed)}")
    missing = [key for key in REQUIRED_KEYS if key not in values]
    if missing:
        raise CameraError(
            f"{path}: {_plural(missing)} {', '.join(missing)} missing; "
            f"needed are {', '.join(REQUIRED_KEYS)}, allowed also {', '.join(OPTIONAL_KEYS)}"
        )
    settings: dict[str, Any] = {}
    model = str(values.get("model", _PINHOLE_MODEL))
    if model not in (_PINHOLE_MODEL, *WIDE_MODELS):
        known = ", ".join((_PINHOLE_MODEL, *WIDE_MODELS))
        raise CameraError(f"{path}: key 'model' must be one of {known}, found {model[:40]!r}")
    for key, value in values.items():
        if key in ("width", "height"):
            settings[key] = _whole(path, key, value)
        elif key not in ("model", "distortion"):
            settings[key] = _number(path, key, value)
    if model == _PINHOLE_MODEL:
        settings["distortion"] = _distortion(path, values.get("distortion"))
    coefficients = () if model == _PINHOLE_MODEL else _coefficients(path, model, values.get("distortion"))
    try:
        if coefficients:
            settings["lens"] = WideLens(model, coefficients)
        return make(**settings)
    except CameraError as error:
        raise CameraError(f"{path}: {str(error).removeprefix('camera: ')}") from error


def camera_yaml(camera: Pinhole) -> str:
    """The text of a ``camera.yaml`` that reads back as an equal camera, should it be a plausible one."""
    values: dict[str, Any] = {key: int(getattr(camera, key)) for key in ("width", "height")}
    values |= {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy")}
    numbers = camera.distortion
    if camera.lens is not None:
        values["model"], numbers = camera.lens.model, camera.lens.coefficients
    values["distortion"] = [float(value) for value in numbers]
    values |= {key: float(getattr(camera, key)) for key in ("depth_factor", "fps")}
    return yaml.safe_dump(values, sort_keys=False, default_flow_style=None)


def _load(path: Path) -> dict[Any, Any]:
    try:
        text = as_yaml(path.read_bytes().decode("utf-8-sig"))
        # Loading would let the last of two equal keys win without a word.
        trees = [tree for tree in yaml.compose_all(text, Loader=CalibrationLoader) if not _is_empty(tree)]
        documents = [value for value in yaml.load_all(text, Loader=CalibrationLoader) if value is not None]
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: bad UTF-8, a 13th month
        raise CameraError(f"{path}: not valid YAML: {_where_and_why(error)}") from error
    tree, values = (trees[0], documents[0]) if trees and documents else (None, None)
    if not isinstance(values, dict) or not isinstance(tree, yaml.MappingNode):
        raise CameraError(f"{path}: expected lines 'key: value' with the keys {', '.join(REQUIRED_KEYS)}")
    for mapping in (tree, *(value for _, value in tree.value if isinstance(value, yaml.MappingNode))):
        names = [key.value for key, _ in mapping.value if isinstance(key, yaml.ScalarNode)]
        for name in names:
            if names.count(name) > 1:
                raise CameraError(f"{path}: key {name!r} is given twice")
    for other in documents[1:]:
        if not isinstance(other, dict) or not _of_camera(other).items() <= _of_camera(values).items():
            raise CameraError(f"{path}: holds {len(documents)} documents that differ; leave one camera in it")
    return values


def _is_empty(tree: yaml.Node | None) -> bool:
    return tree is None or (isinstance(tree, yaml.ScalarNode) and tree.tag.endswith(":null"))


def _of_camera(values: dict[Any, Any]) -> dict[Any, Any]:
    """``values`` without the header of a message, which has its time and number."""
    return {key: value for key, value in values.items() if key != "header"}


def _where_and_why(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    reason = getattr(error, "problem", None) or (str(error).splitlines() or ["damaged"])[0]
    return f"line {mark.line + 1}: {reason}" if mark is not None else reason


def _plural(names: list[str]) -> str:
    return "key" if len(names) == 1 else "keys"


def _number(path: Path, key: str, value: Any) -> float:
    try:
        return number_of(value)
    except OverflowError as error:
        raise CameraError(f"{path}: key {key!r} is out of range") from error
    except ValueError as error:
        raise CameraError(f"{path}: key {key!r} must be a number such as 500.0, found {value!r}") from error


def _whole(path: Path, key: str, value: Any) -> int:
    try:
        number = number_of(value)
        if number != int(number):
            raise ValueError(value)
        return int(number)
    except (ValueError, OverflowError) as error:
        raise CameraError(f"{path}: key {key!r} must be a whole number of pixels, found {value!r}") from error


def _distortion(path: Path, value: Any) -> tuple[float, ...]:
    if value is None or value == []:
        return (0.0,) * 5
    if not isinstance(value, list) or len(value) not in (5, 8):
        raise CameraError(
            f"{path}: key 'distortion' must be five numbers [k1, k2, p1, p2, k3], or eight with k4, k5, k6, "
            f"found {value!r}"
        )
    return tuple(_number(path, "distortion", item) for item in value)


def _coefficients(path: Path, model: str, value: Any) -> tuple[float, ...]:
    names = WIDE_MODELS[model]
    if not isinstance(value, list) or len(value) != len(names):
        raise CameraError(
            f"{path}: key 'distortion' of the model {model!r} must be {len(names)} numbers "
            f"[{', '.join(names)}], found {value!r}"
        )
    return tuple(_number(path, "distortion", item) for item in value)
