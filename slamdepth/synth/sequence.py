# SPDX-License-Identifier: Apache-2.0
"""The synthetic sequence: a furnished room or an aliased hall in TUM layout, with exact depth and poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from slamdepth.calibration import CAMERA_FILE
from slamdepth.errors import ConfigError, OutputError
from slamdepth.fiducial import MarkerSpec
from slamdepth.io import replacing, write_camera, write_text, write_tum_trajectory
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.synth.render import Renderer

SCENE_VERSION = 1
"""To be raised with every change of a pixel: a folder of another version is not continued."""

SETTINGS_FILE = "synth.yaml"
"""File in every rendered folder with the settings it was rendered with."""

_TEXEL_AT_640_M = 0.0025


class SynthSettings(BaseModel):
    """Settings of a sequence. The same settings give the same bytes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: int = Field(300, ge=2, le=100_000, description="number of frames")
    fps: float = Field(30.0, gt=0, le=1000, description="frame rate in Hz")
    width: int = Field(640, ge=32, le=4096, description="image width in pixels")
    height: int = Field(480, ge=32, le=4096, description="image height in pixels")
    scene: Literal["room", "aliased"] = Field(
        "room", description="a furnished room, or a hall of identical workstations"
    )
    seed: int = Field(0, ge=0, description="seed of layout, colours, path and noise")
    texture: Literal["rich", "low", "bare"] = Field("rich", description="amount of texture on surfaces")
    lighting_variation: float = Field(
        0.05, ge=0, le=1, description="swing of exposure and white balance over the sequence, relative"
    )
    noise: float = Field(1.0, ge=0, le=64, description="deviation of the image noise in grey levels")
    motion_blur: int = Field(
        1, ge=1, le=64, description="exposures averaged over half a frame's time; 1 = none"
    )
    depth_noise: float = Field(
        0.0,
        ge=0,
        le=0.1,
        description="deviation of the depth noise at 1 m, growing with the square (a Kinect: 0.0014)",
    )
    marker: str | None = Field(
        None, description="AprilTag or ArUco marker on a wall of the room: FAMILY:SIDE or FAMILY:SIDE:NUMBER"
    )

    @field_validator("marker")
    @classmethod
    def _marker_of_the_room(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is None:
            return None
        if info.data.get("scene") != "room":
            raise ValueError("it hangs in the scene 'room' only")
        try:
            MarkerSpec.parse(value)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return value

    @classmethod
    def from_dict(cls, values: dict[str, Any], origin: str = "settings") -> SynthSettings:
        """Validate ``values``.

        Raises:
            ConfigError: a setting is unknown or out of range.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            problem = error.errors()[0]
            name = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                allowed = ", ".join(sorted(cls.model_fields))
                raise ConfigError(f"{origin}: unknown setting '{name}'; allowed here: {allowed}") from error
            message = str(problem["msg"]).removeprefix("Value error, ")
            raise ConfigError(f"{origin}: setting '{name}': {message} (got {problem['input']!r})") from error


def synth_camera(settings: SynthSettings) -> Camera:
    """The undistorted camera of the sequence, with a horizontal field of view of 63 degrees as a Kinect."""
    focal = 525.0 * settings.width / 640.0
    return Camera(
        settings.width, settings.height, focal, focal,
        (settings.width - 1) / 2.0, (settings.height - 1) / 2.0, fps=settings.fps,
    )  # fmt: skip


def synth_trajectory(settings: SynthSettings) -> Trajectory:
    """Exact camera poses. The first and last frame have the same viewpoint."""
    index = np.arange(settings.frames, dtype=np.float64)
    return Trajectory(np.round(index / settings.fps, 6), _poses(settings, index))


def render_frames(settings: SynthSettings, indices: Iterable[int]) -> Iterator[tuple[Frame, Floats]]:
    """Render frames in memory: ``(frame with depth, T_world_camera (4, 4))`` for each index.

    Depth is not rounded to the 0.2 mm of a depth file. Building the room takes seconds, so request all
    frames in one call.
    """
    renderer = make_renderer(settings)
    for index in indices:
        yield render_frame(renderer, settings, index)


def make_renderer(settings: SynthSettings) -> Renderer:
    """Build, paint and light the scene of ``settings``."""
    from slamdepth.synth.aliased import build_aliased_scene
    from slamdepth.synth.render import Renderer
    from slamdepth.synth.scene import build_scene

    if settings.scene == "aliased":
        scene = build_aliased_scene(settings.seed, settings.texture)
    else:
        marker = None if settings.marker is None else MarkerSpec.parse(settings.marker)
        scene = build_scene(settings.seed, settings.texture, marker)
    texel_m = _TEXEL_AT_640_M * max(0.4, 640.0 / settings.width)
    return Renderer(scene, synth_camera(settings), texel_m, settings.seed)


def render_frame(renderer: Renderer, settings: SynthSettings, index: int) -> tuple[Frame, Floats]:
    """Render frame ``index``: the frame with depth and its ``T_world_camera (4, 4)``."""
    shutter = (np.arange(settings.motion_blur) + 0.5) / settings.motion_blur - 0.5
    T_world_camera = _poses(settings, np.array([float(index)]))[0]
    colour, depth = renderer.render(T_world_camera)
    if settings.motion_blur > 1:
        exposures = _poses(settings, index + 0.5 * shutter)
        colour = np.mean([renderer.render(T)[0] for T in exposures], axis=0, dtype=np.float32)
    image = _photograph(colour, settings, index)
    if settings.depth_noise > 0:
        rng = np.random.default_rng([settings.seed, 6, index])
        noise = rng.standard_normal(depth.shape, dtype=np.float32)
        depth = np.maximum(depth + np.float32(settings.depth_noise) * depth * depth * noise, np.float32(1e-3))
    frame = Frame(
        index, round(index / settings.fps, 6), image, synth_camera(settings), depth.astype(np.float32)
    )
    return frame, T_world_camera


def render_sequence(
    output: Path, settings: SynthSettings, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write the sequence to the folder ``output`` in TUM layout; returns ``output``.

    An interrupted rendering resumes where it stopped: each file is written whole or not at all, and
    the lists (``rgb.txt`` ...) are written last.

    Args:
        output: a new or empty folder, or one started with the same settings.
        settings: what to render.
        progress: called with (frames done, total frames).

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    try:
        return _render_sequence(Path(output), settings, progress)
    except OSError as error:
        where = error.filename or output
        raise OutputError(f"{where}: cannot write the sequence: {error.strerror or error}") from error


def _render_sequence(
    output: Path, settings: SynthSettings, progress: Callable[[int, int], None] | None
) -> Path:
    _claim(output, settings)
    for folder in (output / "rgb", output / "depth"):
        folder.mkdir(exist_ok=True)
        for leftover in folder.glob(".*.partial.*"):  # from a killed rendering
            leftover.unlink(missing_ok=True)
    trajectory = synth_trajectory(settings)
    camera = synth_camera(settings)
    renderer: Renderer | None = None
    for index, stamp in enumerate(trajectory.timestamps_s):
        rgb, depth = output / "rgb" / f"{stamp:.6f}.png", output / "depth" / f"{stamp:.6f}.png"
        if not (rgb.is_file() and depth.is_file()):
            renderer = renderer or make_renderer(settings)
            frame, _ = render_frame(renderer, settings, index)
            assert frame.depth_m is not None
            raw = np.round(frame.depth_m.astype(np.float64) * camera.depth_factor)
            _write(depth, _png(np.clip(raw, 0, 65535).astype(np.uint16)))
            _write(rgb, _png(frame.image_rgb[..., ::-1]))
        if progress is not None:
            progress(index + 1, settings.frames)
    _write_lists(output, trajectory, camera)
    return output


def _claim(output: Path, settings: SynthSettings) -> None:
    """Prepare ``output`` for these settings, or raise OutputError if it holds something else."""
    record = {"scene_version": SCENE_VERSION, **settings.model_dump(mode="json")}
    if settings.scene == "room":
        del record["scene"]  # folders from before there were others go on
    if settings.marker is None:
        del record["marker"]
    record_file = output / SETTINGS_FILE
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output}: is a file; name a folder for the sequence")
    if record_file.is_file():
        try:
            found = yaml.safe_load(record_file.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError):
            found = None
        if found != record:
            found = found if isinstance(found, dict) else {}
            changed = sorted(k for k in {*record, *found} if record.get(k) != found.get(k))
            raise OutputError(
                f"{output}: holds a sequence of other settings ({', '.join(changed)} differ); "
                "name another folder or delete this one"
            )
        return
    if output.is_dir() and any(output.iterdir()):
        raise OutputError(f"{output}: is not empty and holds no {SETTINGS_FILE}; name a new folder")
    output.mkdir(parents=True, exist_ok=True)
    write_text(record_file, yaml.safe_dump(record, sort_keys=False))


def _write_lists(output: Path, trajectory: Trajectory, camera: Camera) -> None:
    stamps = [f"{stamp:.6f}" for stamp in trajectory.timestamps_s]
    for kind, title in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {title} of a synthetic room", "# timestamp filename"]
        lines += [f"{stamp} {kind}/{stamp}.png" for stamp in stamps]
        write_text(output / f"{kind}.txt", "\n".join(lines) + "\n")
    write_tum_trajectory(output / "groundtruth.txt", trajectory)
    write_camera(output / CAMERA_FILE, camera)


def _poses(settings: SynthSettings, index: Floats) -> Floats:
    from slamdepth.synth.aliased_path import aliased_path_poses
    from slamdepth.synth.path import path_poses

    last = settings.frames - 1
    poses = aliased_path_poses if settings.scene == "aliased" else path_poses
    return poses(index / last, last / settings.fps, settings.seed)


def _photograph(colour: Floats32, settings: SynthSettings, index: int) -> NDArray[np.uint8]:
    """Rendered sRGB values 0 to 255 with drift of exposure and white balance, and sensor noise."""
    if settings.lighting_variation > 0:
        rng = np.random.default_rng([settings.seed, 5])
        phase = rng.uniform(0, 2 * np.pi, 3)
        time_s = index / settings.fps
        swing = 0.6 * np.sin(2 * np.pi * time_s / 4.1 + phase[0]) + 0.4 * np.sin(
            2 * np.pi * time_s / 1.7 + phase[1]
        )
        warmth = 0.2 * np.sin(2 * np.pi * time_s / 6.3 + phase[2])
        gain = np.exp(settings.lighting_variation * (swing + warmth * np.array([1.0, 0.0, -1.0])))
        colour = colour * gain.astype(np.float32)
    if settings.noise > 0:
        rng = np.random.default_rng([settings.seed, 7, index])
        colour = colour + np.float32(settings.noise) * rng.standard_normal(colour.shape, dtype=np.float32)
    return np.clip(np.round(colour), 0, 255).astype(np.uint8)


def _png(image: NDArray[Any]) -> bytes:
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 2])
    assert done
    return data.tobytes()


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)
