# SPDX-License-Identifier: Apache-2.0
"""Training views: a real RGB-D image seen by a virtual camera that is rotated and zoomed in place.

A purely rotated camera sees the same scene through a homography, so roll, pan, tilt and zoom are
exact, depth included. The views add variety that the recordings lack: rolled cameras, other focal
lengths, other distances, other light.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.depth.upright import roll_rad
from slamdepth.geometry import so3_exp
from slamdepth.training.config import AugmentConfig
from slamdepth.training.lens import raw_pixels
from slamdepth.types import Frame
from slamdepth.typing import Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class View:
    """One training sample before the backbone.

    Attributes:
        image_rgb: ``(rows, columns, 3)`` uint8.
        depth_m: ``(rows, columns)`` float32, 0 where unknown.
        focal_px: focal length in pixels of ``image_rgb``.
        gravity: ``(3,)`` unit direction of gravity in the view's camera frame; zeros if unknown.
    """

    image_rgb: NDArray[np.uint8]
    depth_m: Floats32
    focal_px: float
    gravity: Floats = field(default_factory=lambda: np.zeros(3))


def augmented_view(
    frame: Frame,
    rows: int,
    columns: int,
    config: AugmentConfig,
    rng: np.random.Generator,
    gravity: Floats | None = None,
) -> View:
    """A random view of ``frame`` (which has depth) at ``rows`` x ``columns`` pixels.

    Args:
        gravity: ``(3,)`` unit direction of gravity in the frame's camera. If given, the random roll is
            about upright and not about the camera's own orientation.
    """
    flip = rng.random() < config.flip
    rolled = rng.random() < config.rolled
    roll = (
        rng.uniform(-config.max_roll_deg, config.max_roll_deg)
        if rolled
        else rng.normal(0.0, config.upright_roll_deg)
    )
    if gravity is not None:
        roll -= float(np.degrees(roll_rad(gravity)))
    tilt = rng.uniform(-config.max_tilt_deg, config.max_tilt_deg, 2)
    zoom = _zoom(config, roll, rng)
    R_camera_view = _rotation(roll, tilt[0], tilt[1])
    image, depth, focal = seen_from(frame, rows, columns, R_camera_view, zoom, flip)
    return View(photometric(image, config, rng), depth, focal, _gravity_in_view(gravity, R_camera_view, flip))


def unaugmented_view(frame: Frame, rows: int, columns: int, gravity: Floats | None = None) -> View:
    """``frame`` at ``rows`` x ``columns`` with square pixels and a centred principal point.

    Args:
        gravity: ``(3,)`` unit direction of gravity in the frame's camera. If given, the view is rolled
            upright.
    """
    R_camera_view = _rotation(0.0 if gravity is None else -float(np.degrees(roll_rad(gravity))), 0.0, 0.0)
    seen = seen_from(frame, rows, columns, R_camera_view, 1.0, False)
    return View(*seen, _gravity_in_view(gravity, R_camera_view, False))


def matching_view(
    frame: Frame,
    rows: int,
    columns: int,
    config: AugmentConfig,
    rng: np.random.Generator,
    gravity: Floats,
    wanted: Floats,
) -> View:
    """A random view of ``frame`` in which gravity points along ``wanted``, to be mixed into another.

    Args:
        gravity: ``(3,)`` unit direction of gravity in the frame's camera.
        wanted: ``(3,)`` unit direction of gravity in the view. The angles of both to the horizon
            should differ little.
    """
    flip = rng.random() < config.flip
    unflipped = wanted * [-1.0, 1.0, 1.0] if flip else wanted
    about_gravity = so3_exp(unflipped * np.radians(rng.uniform(-config.max_tilt_deg, config.max_tilt_deg)))
    R_camera_view = _rotation_between(unflipped, gravity) @ about_gravity
    roll = float(np.degrees(np.arctan2(R_camera_view[1, 0], R_camera_view[0, 0])))
    zoom = _zoom(config, roll, rng)
    image, depth, focal = seen_from(frame, rows, columns, R_camera_view, zoom, flip)
    return View(photometric(image, config, rng), depth, focal, wanted)


def _zoom(config: AugmentConfig, roll_deg: float, rng: np.random.Generator) -> float:
    # Without zoom a rolled view would show more of the mirrored border than of the scene.
    least = 1.0 + 0.25 * abs(np.sin(np.radians(roll_deg)))
    return float(np.exp(rng.uniform(np.log(least), np.log(max(config.max_zoom, least)))))


def _rotation(roll_deg: float, pan_deg: float, tilt_deg: float) -> Floats:
    """``R_camera_view (3, 3)``."""
    return so3_exp(np.radians([0.0, 0.0, roll_deg])) @ so3_exp(np.radians([tilt_deg, pan_deg, 0.0]))


def _rotation_between(source: Floats, target: Floats) -> Floats:
    """The rotation ``(3, 3)`` that takes the unit vector ``source`` to ``target``.

    It is a roll about the optical axis followed by the remaining pitch, so the axis moves as little
    as possible.
    """
    roll = np.arctan2(target[1], target[0]) - np.arctan2(source[1], source[0])
    R_roll = so3_exp(np.array([0.0, 0.0, roll]))
    rolled = R_roll @ source
    axis = np.cross(rolled, target)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return R_roll
    R_pitch = so3_exp(axis / sine * np.arctan2(sine, rolled @ target))
    return np.asarray(R_pitch @ R_roll)


def _gravity_in_view(gravity: Floats | None, R_camera_view: Floats, flip: bool) -> Floats:
    if gravity is None:
        return np.zeros(3)
    seen = np.asarray(R_camera_view.T @ gravity)
    return seen * [-1.0, 1.0, 1.0] if flip else seen


def mixed_view(first: View, second: View) -> View:
    """Both scenes composed into one: at each pixel the nearer surface, at the focal length of ``first``.

    Both views are brought into one canonical camera, so sizes and depths stay true and the scenes
    occlude one another as solid ones would. This breaks up the layout of a place, which a network
    would memorise, and keeps the local cues of a surface. Where one depth is unknown, that of its
    nearest known pixel decides, and the result is unknown.
    """
    factor = np.float32(first.focal_px / second.focal_px)
    second_m = second.depth_m * factor
    in_front = _completed(first.depth_m) <= _completed(second_m)
    return View(
        np.where(in_front[..., None], first.image_rgb, second.image_rgb),
        np.where(in_front, first.depth_m, second_m),
        first.focal_px,
        first.gravity,
    )


def _completed(depth_m: Floats32) -> Floats32:
    """``(H, W)`` with each unknown pixel set to the depth of the nearest known one."""
    import cv2

    unknown = depth_m <= 0
    if unknown.all():
        return np.full_like(depth_m, np.inf)
    if not unknown.any():
        return depth_m
    _, label = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[~unknown]] = depth_m[~unknown]
    return np.asarray(of_label[label])


def turned_view(
    frame: Frame,
    rows: int,
    columns: int,
    roll_deg: float,
    pan_deg: float,
    tilt_deg: float,
    zoom: float,
    flip: bool,
) -> tuple[NDArray[np.uint8], Floats32, float]:
    """Image, depth and focal length (px) of ``frame`` rotated by angles; see :func:`seen_from`."""
    return seen_from(frame, rows, columns, _rotation(roll_deg, pan_deg, tilt_deg), zoom, flip)


def seen_from(
    frame: Frame, rows: int, columns: int, R_camera_view: Floats, zoom: float, flip: bool
) -> tuple[NDArray[np.uint8], Floats32, float]:
    """Image, depth and focal length (px) of ``frame`` after an exact camera rotation.

    The view is that of a pinhole camera: the lens distortion of ``frame.camera`` is removed. Pixels
    outside the frame mirror its border and have depth 0.

    Args:
        R_camera_view: ``(3, 3)``, takes directions of the view, before it is flipped, to the frame's.
        zoom: focal length over that at which the view spans the frame.
        flip: mirror the view from left to right.
    """
    import cv2

    assert frame.depth_m is not None
    camera = frame.camera
    focal = zoom * camera.fx * max(rows / camera.height, columns / camera.width)
    K_view = np.array([[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1.0]])
    if flip:
        K_view = np.diag([-1.0, 1.0, 1.0]) @ K_view
        K_view[0, 2] += columns - 1
    u, v = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    rays_view = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K_view).T
    rays = rays_view @ R_camera_view.T
    pixels = raw_pixels(rays, camera)
    map_x, map_y = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    image: NDArray[Any] = cv2.remap(
        frame.image_rgb, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    raw: NDArray[Any] = cv2.remap(
        frame.depth_m, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
    )
    # Depth changes from along the old optical axis to along the new one.
    depth = raw / rays[..., 2].astype(np.float32)
    return image, depth.astype(np.float32), float(focal)


def photometric(
    image_rgb: NDArray[np.uint8], config: AugmentConfig, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """``image_rgb (H, W, 3)`` uint8 with random light, tint, saturation, blur, noise and compression."""
    import cv2

    x: NDArray[Any] = image_rgb.astype(np.float32) / 255.0
    s = config.colour
    if s > 0:
        x = x ** np.float32(np.exp(rng.normal(0, 0.5 * s)))
        x *= np.exp(rng.normal(0, 0.25 * s, 3)).astype(np.float32) * np.float32(
            np.exp(rng.normal(0, 0.5 * s))
        )
        grey = x.mean(axis=2, keepdims=True)
        x = grey + (x - grey) * np.float32(np.exp(rng.normal(0, s)))
        x = x.mean() + (x - x.mean()) * np.float32(np.exp(rng.normal(0, 0.4 * s)))
    if rng.random() < config.blur:
        if rng.random() < 0.5:
            x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.6))
        else:
            x = cv2.filter2D(x, -1, _motion_kernel(int(rng.integers(3, 10)), rng.uniform(0, np.pi)))
    if rng.random() < config.noise:
        x = x + rng.normal(0, rng.uniform(0.005, 0.03), x.shape).astype(np.float32)
    out = np.clip(x * 255.0 + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < config.jpeg:
        quality = int(rng.integers(40, 96))
        _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])
        out = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return out


def _motion_kernel(length: int, angle_rad: float) -> Floats32:
    import cv2

    kernel = np.zeros((length, length), np.float32)
    centre = (length - 1) / 2
    step = centre * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    a, b = np.round(centre - step).astype(int), np.round(centre + step).astype(int)
    cv2.line(kernel, tuple(map(int, a)), tuple(map(int, b)), 1.0)
    return np.asarray(kernel / kernel.sum())
