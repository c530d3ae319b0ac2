# SPDX-License-Identifier: Apache-2.0
"""All settings of a run: frozen, validated, passed on explicitly.

Command line over YAML file over these defaults. A name that does not exist is an
error that lists those that do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from slamdepth.errors import ConfigError
from slamdepth.fiducial import MarkerSpec

Precision = Literal["auto", "float32", "bfloat16", "int8"]
"""What numbers a network computes in."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FeatureConfig(_Section):
    """Keypoints and descriptors; features other than ORB have levels and thresholds of their own."""

    name: str = Field("orb", description="feature by its registered name")
    count: int = Field(1000, ge=100, le=10000, description="keypoints kept per frame")
    levels: int = Field(8, ge=1, le=12, description="pyramid levels of ORB")
    scale_factor: float = Field(1.2, gt=1.0, le=2.0, description="ratio of one level of ORB to the next")
    fast_threshold: int = Field(20, ge=1, le=100, description="contrast of ORB's corners, grey values")
    fast_threshold_low: int = Field(
        7, ge=1, le=100, description="contrast of ORB's corners in images with too few stronger ones"
    )
    weights: str | None = Field(None, min_length=1, description="ONNX file of a feature that is a network")
    matcher: str | None = Field(
        None, min_length=1, description="LightGlue's ONNX file for it, to match whole images with"
    )


class TrackingConfig(_Section):
    """Placing a frame in the map, and choosing keyframes."""

    min_inliers: int = Field(20, ge=6, description="fewer agreeing points and the frame is lost")
    keyframe_overlap: float = Field(
        0.55, gt=0, lt=1, description="a keyframe is made when a smaller share of the last one is in view"
    )
    keyframe_overlap_start: float = Field(
        0.85,
        gt=0,
        lt=1,
        description="keyframe_overlap of the first keyframes, which triangulate the first points",
    )
    keyframe_min_inliers: int = Field(
        100, ge=0, description="a keyframe is also made when fewer points agree"
    )
    local_keyframes: int = Field(12, ge=2, description="keyframes whose points are searched for")
    depth_delay: int = Field(
        8, ge=0, le=30, description="frames after a keyframe until its predicted depth joins the map"
    )
    new_maps: bool = Field(
        True,
        description="start a new map where the camera stays lost; joined with the others where they meet",
    )


class ShutterConfig(_Section):
    """The camera's shutter, which reads most cameras' images row by row."""

    readout_ms: float | None = Field(
        None,
        ge=-50,
        le=50,
        description="milliseconds from an image's first row to its last; 0 for a global shutter, null "
        "estimates it",
    )


class BundleConfig(_Section):
    """Local and global bundle adjustment."""

    window: int = Field(8, ge=2, description="keyframes adjusted together after each new one")
    fixed: int = Field(6, ge=1, description="further keyframes, with fixed poses, that constrain the window")
    local: bool = Field(True, description="adjust a window after each new keyframe")
    final: bool = Field(True, description="adjust the whole map once at the end")
    align: bool = Field(
        True, description="at the end, align keypoints in the images to one view of each landmark"
    )
    prior_inflation: float = Field(
        6.0,
        ge=1,
        description="factor on the deviation of predicted depths: errors of neighbours are correlated",
    )
    scale_sigma: float = Field(0.1, ge=0, description="deviation of a keyframe's common relative depth error")


class LoopConfig(_Section):
    """Loop closure."""

    enabled: bool = Field(True, description="look for places seen before")
    min_inliers: int = Field(30, ge=8, description="agreeing points a loop needs")
    min_gap: int = Field(10, ge=1, description="keyframes between the two ends of a loop, at least")


class DepthConfig(_Section):
    """The depth prior of a keyframe."""

    name: str = Field(
        "auto",
        description="depth model by its registered name; 'auto' takes the best metric one in the cache "
        "folder, else the embedded one, 'dinov2'",
    )
    weights: str | None = Field(
        None, min_length=1, description="its weights file; null takes the shipped or cached one"
    )
    precision: Precision = Field(
        "auto",
        description="numbers that the backbone of 'dinov2' computes in: float32, bfloat16, int8, or 'auto': "
        "bfloat16 where the processor multiplies it natively, else int8 where it has AVX2",
    )
    input_px: int | None = Field(
        None,
        ge=8_000,
        le=250_000,
        description="rows times columns of the network input of 'dinov2', in the image's aspect; fewer "
        "pixels take less time and blur edges; null: as trained",
    )
    min_m: float = Field(0.1, gt=0, description="nearer depth is dropped")
    max_m: float = Field(10.0, gt=0, description="farther depth is dropped")
    uncertainty: bool = Field(
        True, description="weigh predictions by the model's own uncertainty, not all alike"
    )
    max_sigma_log: float = Field(
        1.0, gt=0, description="pixels whose log depth has a larger deviation do not become landmarks"
    )


GROUND_TRUTH = "groundtruth"
"""The value of ``scale.depth`` that takes the scale from a sequence's ground truth."""

_FILES = (
    ("depth", "weights"),
    ("scale", "depth"),
    ("scale", "imu"),
    ("features", "weights"),
    ("features", "matcher"),
)
"""Settings that may name a file."""


class ScaleConfig(_Section):
    """Knowledge of the scale other than the depth model's; see ``slamdepth.pipeline.scale``."""

    depth: float | str | None = Field(
        None,
        description="factor on predicted depth: a number, a file of 'slamdepth scale', or 'groundtruth'",
    )
    camera_height_m: float | None = Field(
        None, gt=0, le=100, description="height of the first camera over the floor in metres"
    )
    baseline_m: float | None = Field(
        None, gt=0, le=1e5, description="distance in metres between the camera's positions at two times"
    )
    baseline_between_s: tuple[float, float] | None = Field(
        None, description="those two times, in seconds of the sequence; null: first and last placed frame"
    )

    marker: tuple[str, ...] = Field(
        (), description="AprilTag or ArUco markers of known size, each FAMILY:SIDE or FAMILY:SIDE:NUMBER"
    )
    imu: str | None = Field(
        None, min_length=1, description="file with inertial data, for the scale and gravity at the end"
    )

    @property
    def is_known(self) -> bool:
        """Whether anything was given to scale the map by besides its depth."""
        return bool(self.marker) or any(
            given is not None for given in (self.camera_height_m, self.baseline_m, self.imu)
        )

    @field_validator("marker")
    @classmethod
    def _known_markers(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for text in value:
            try:
                MarkerSpec.parse(text)
            except ConfigError as error:
                raise ValueError(str(error)) from error
        return value

    @field_validator("depth", mode="before")
    @classmethod
    def _number_or_name(cls, value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, int | float | str | None):
            raise ValueError("must be a number, a file or 'groundtruth'")
        try:
            number = value if value is None or isinstance(value, int | float) else float(value)
        except ValueError:
            if not str(value).strip():
                raise ValueError("must be a number, a file or 'groundtruth'") from None
            return value
        if number is not None and not (math.isfinite(number) and number > 0):
            raise ValueError("a factor must be a positive number")
        return number

    @model_validator(mode="after")
    def _one_scale(self) -> ScaleConfig:
        if self.is_known and self.depth == GROUND_TRUTH:
            raise ValueError(
                "a scale from ground truth and a known size (camera height, baseline, marker, inertial data) "
                "exclude each other"
            )
        if self.baseline_between_s is not None:
            if self.baseline_m is None:
                raise ValueError("two times of a baseline need its length, baseline_m")
            if not self.baseline_between_s[0] < self.baseline_between_s[1]:
                raise ValueError("the first time of a baseline must come before the second")
        return self


class MapConfig(_Section):
    """Memory of keyframes, TSDF fusion and the mesh."""

    keyframe_memory_mib: float = Field(
        64.0,
        ge=0,
        description="images and depth maps of keyframes beyond this many MiB are spilled to a temporary file",
    )
    voxel_size_m: float = Field(0.02, gt=0, le=1.0, description="edge of a voxel in metres")
    max_depth_m: float = Field(4.0, gt=0, description="depth beyond this is not fused")
    min_component_triangles: int = Field(
        200, ge=0, description="connected components of the mesh with fewer triangles are removed"
    )


class DenseConfig(_Section):
    """Dense depth of keyframes from many views, at the end of a run."""

    mode: Literal["auto", "off", "fast", "best"] = Field(
        "auto",
        description="'off' keeps the depth that was given; 'best' looks twice, at more views; 'auto' is "
        "'fast' for predicted depth, 'off' for a sensor's",
    )


class Config(_Section):
    """Every setting of a run."""

    seed: int = Field(0, ge=0, description="seed of everything random")
    device: Literal["cpu", "cuda"] = Field("cpu", description="where networks run")
    odometry: Literal["orb", "kiss-icp"] = Field("orb", description="what estimates the motion")
    features: FeatureConfig = FeatureConfig()
    tracking: TrackingConfig = TrackingConfig()
    shutter: ShutterConfig = ShutterConfig()
    bundle: BundleConfig = BundleConfig()
    loops: LoopConfig = LoopConfig()
    depth: DepthConfig = DepthConfig()
    scale: ScaleConfig = ScaleConfig()
    dense: DenseConfig = DenseConfig()
    map: MapConfig = MapConfig()

    @model_validator(mode="after")
    def _features_are_used(self) -> Config:
        chosen = (self.features.name, self.features.weights, self.features.matcher)
        if self.odometry == "kiss-icp" and chosen != (FeatureConfig().name, None, None):
            raise ValueError("odometry 'kiss-icp' uses no features: leave out their name and weights")
        return self

    @classmethod
    def from_yaml(cls, path: str | Path, overrides: dict[str, Any] | None = None) -> Config:
        """Read ``path`` and lay ``overrides`` (nested dicts) over it.

        Raises:
            ConfigError: the file is missing, is no mapping, or has an unknown or
                out-of-range setting; names the setting and the allowed ones.
        """
        path = Path(path)
        try:
            loaded = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        except OSError as error:
            raise ConfigError(f"{path}: cannot read the settings: {error.strerror}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            first_line = str(error).splitlines()[0]
            raise ConfigError(f"{path}: not valid YAML: {first_line}") from error
        if not isinstance(loaded, dict):
            raise ConfigError(f"{path}: expected 'name: value' settings, found a {type(loaded).__name__}")
        return cls.from_dict(merge(loaded, overrides or {}), origin=str(path))

    @classmethod
    def from_dict(cls, values: dict[str, Any], origin: str = "settings") -> Config:
        """Validate nested ``values``; ``origin`` is named in errors.

        Raises:
            ConfigError: a setting is unknown or out of range.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(f"{origin}: {_first_problem(error)}") from error

    def to_dict(self) -> dict[str, Any]:
        """The settings as nested dicts for :meth:`from_dict`, whatever folder they are read back in."""
        return self._with_files(lambda name: str(Path(name).expanduser().absolute()))

    def to_yaml(self) -> str:
        """The settings as YAML that :meth:`from_yaml` reads back, whatever folder it is read from."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False)

    def for_report(self) -> dict[str, Any]:
        """The settings as nested dicts; files by their names only, as reports are passed on."""
        return self._with_files(lambda name: Path(name).name)

    def _with_files(self, named: Callable[[str], str]) -> dict[str, Any]:
        values = self.model_dump(mode="json")
        for section, key in _FILES:
            if isinstance(value := values[section][key], str) and value != GROUND_TRUTH:
                values[section][key] = named(value)
        values["depth"]["name"] = _named_depth(values["depth"]["name"], named)
        return values


def _named_depth(name: str, named: Callable[[str], str]) -> str:
    """The name of a depth model, with the file or folder in it, if any, as ``named`` gives it."""
    prefix = "".join(re.findall(r"\A(?:mirrored:)*(?:onnx:|hf:)?", name))
    path = name.removeprefix(prefix)
    is_folder = ("/" in path or prefix.endswith("hf:")) and Path(path).expanduser().is_dir()
    return prefix + named(path) if prefix.endswith("onnx:") or is_folder else name


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Nested ``base`` with the values of ``over`` laid on top; neither is changed."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    name = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        section: type[BaseModel] = Config
        for part in problem["loc"][:-1]:
            annotation = section.model_fields[str(part)].annotation
            assert isinstance(annotation, type)
            assert issubclass(annotation, BaseModel)
            section = annotation
        return f"unknown setting '{name}'; allowed here: {', '.join(sorted(section.model_fields))}"
    message = str(problem["msg"]).removeprefix("Value error, ")
    return f"setting '{name}': {message} (got {problem['input']!r})" if name else message
