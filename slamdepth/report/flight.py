# SPDX-License-Identifier: Apache-2.0
"""A flight through a reconstruction: from above down to the camera, along its path, and back up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import invert, look_at, project, transform
from slamdepth.mapping.raycast import render_mesh
from slamdepth.report.gaps import gap_ends
from slamdepth.report.scene.page_data import first_view
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats, Ints

if TYPE_CHECKING:
    from slamdepth.report.scene.model import SceneMap

BACKGROUND = (20, 23, 29)
_AHEAD, _BEHIND, _CASING, _NOW = (96, 128, 176), (74, 158, 255), (12, 14, 18), (247, 158, 40)
_DOWN, _BACK_UP = 0.22, 0.14  # shares of the time
_SWING_RAD = 0.6  # about the scene, while the flight is above it
_SMOOTH = 0.02  # standard deviation of the smoothing, of the frames
# of the size of the scene: behind and above the camera; what is looked at, ahead of and below it
_BACK, _UP, _FAR, _BELOW = 0.17, 0.09, 0.35, 0.05
_LEVEL = 0.6  # of a camera's tilt that the flight leaves out
_SUBPIXELS = 4  # bits
_NEAR = 0.01  # of the size of the scene
_INSET = 0.24  # of the width


@dataclass(frozen=True)
class Flight:
    """A camera's way.

    Attributes:
        T_world_camera: ``(F, 4, 4)`` of each image.
        at: ``(F,)`` which pose of the path it is at.
        size_m: of what there is to see.
    """

    T_world_camera: Floats
    at: Ints
    size_m: float


def plan_flight(one: SceneMap, frames: int) -> Flight:
    """The flight through a map with at least one pose, in so many images."""
    eye, target, up, size = first_view(one)
    poses = one.path.T_world_camera
    share = np.linspace(0.0, 1.0, frames)
    along = np.clip((share - 0.6 * _DOWN) / (1 - 0.6 * _DOWN - _BACK_UP), 0.0, 1.0)
    at = np.round(along * (len(poses) - 1)).astype(np.int64)
    places, ahead = _smooth(poses[:, :3, 3]), _smooth(poses[:, :3, 2])
    ahead -= _LEVEL * (ahead @ up)[:, None] * up
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    near_eyes = places[at] + size * (_UP * up - _BACK * ahead[at])
    near_targets = places[at] + size * (_FAR * ahead[at] - _BELOW * up)
    closeness = _ease(share / _DOWN) * _ease((1 - share) / _BACK_UP)
    swing = _SWING_RAD * (share - 0.5)
    T = np.empty((frames, 4, 4))
    for n in range(frames):
        above = target + _turned(eye - target, up, float(swing[n]))
        c = float(closeness[n])
        T[n] = look_at((1 - c) * above + c * near_eyes[n], (1 - c) * target + c * near_targets[n], -up)
    return Flight(T, at, size)


def draw_flight(one: SceneMap, flight: Flight, n: int, camera: Camera, aspect: tuple[float, float]) -> Bytes:
    """Image ``n`` of the flight, ``(H, W, 3)`` RGB: the mesh, the path so far and to come, the camera.

    Args:
        camera: of the flight.
        aspect: see :attr:`slamdepth.report.scene.Scene.aspect`.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    assert one.mesh is not None
    import cv2

    T = flight.T_world_camera[n]
    image = render_mesh(one.mesh, camera, T, BACKGROUND, samples=1)
    size = flight.size_m
    at = int(flight.at[n])
    places = one.path.T_world_camera[:, :3, 3]
    ends = [*gap_ends(one.path.timestamps_s).tolist()]
    parts = np.split(np.arange(len(places)), ends)
    for part in parts:
        _line(image, camera, T, places[part[part >= at]], _AHEAD, 1, size)
        _line(image, camera, T, places[part[part <= at]], _BEHIND, 3, size)
    pose = one.path.T_world_camera[at]
    depth = 0.05 * size
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * np.array(aspect) * depth
    rim = transform(pose, np.column_stack([corners, np.full(5, depth)]))
    _line(image, camera, T, rim, _NOW, 2, size)
    for corner in rim[:4]:
        _line(image, camera, T, np.stack([pose[:3, 3], corner]), _NOW, 2, size)
    shown = _thumbnail(one, at)
    if shown is not None:
        width = round(_INSET * camera.width)
        small = cv2.resize(
            shown, (width, round(width * shown.shape[0] / shown.shape[1])), interpolation=cv2.INTER_AREA
        )
        margin = round(0.02 * camera.width)
        top, left = camera.height - margin - small.shape[0], margin
        if top > 0:
            image[top - 2 : top + small.shape[0] + 2, left - 2 : left + width + 2] = _NOW
            image[top : top + small.shape[0], left : left + width] = small
    return image


def _smooth(values: Floats) -> Floats:
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, max(1.0, _SMOOTH * len(values)), axis=0, mode="nearest"))


def _ease(values: Floats) -> Floats:
    """From 0 to 1 without a jerk."""
    x = np.clip(values, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))


def _turned(vector: Floats, axis: Floats, angle_rad: float) -> Floats:
    from slamdepth.geometry import so3_exp

    return np.asarray(so3_exp(axis * angle_rad) @ vector)


def _line(
    image: Bytes,
    camera: Camera,
    T_world_camera: Floats,
    points_w: Floats,
    colour: tuple[int, int, int],
    width: int,
    size: float,
) -> None:
    """Draw a line through the points, without those behind the camera."""
    import cv2

    if len(points_w) < 2:
        return
    points = transform(invert(T_world_camera), points_w)
    is_ahead = points[:, 2] > _NEAR * size
    px, _ = project(camera, np.where(is_ahead[:, None], points, [0.0, 0.0, 1.0]))
    px = np.round(np.clip(px, -1e4, 1e4) * 2**_SUBPIXELS).astype(np.int32)
    cuts = np.flatnonzero(np.diff(is_ahead)) + 1
    pieces = [
        part[:, None] for part, ok in zip(np.split(px, cuts), np.split(is_ahead, cuts), strict=True) if ok[0]
    ]
    for shade, thickness in ((_CASING, width + 2), (colour, width)):
        cv2.polylines(
            image, [p for p in pieces if len(p) > 1], False, shade, thickness, cv2.LINE_AA, _SUBPIXELS
        )


def _thumbnail(one: SceneMap, at: int) -> Bytes | None:
    """The image of the keyframe that is nearest in time to a pose of the path; None where there is none."""
    import cv2

    if not one.thumbnails:
        return None
    times = one.keyframes.timestamps_s[[thumbnail.row for thumbnail in one.thumbnails]]
    nearest = one.thumbnails[int(np.argmin(np.abs(times - one.path.timestamps_s[at])))]
    image = cv2.imdecode(np.frombuffer(nearest.image, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image[..., ::-1], np.uint8)
