# SPDX-License-Identifier: Apache-2.0
"""Training views: a real RGB + depth pair seen by a virtual camera turned and zoomed in place.

A camera that only turns sees the same scene through a homography, so roll, pan, tilt and
zoom of a pair are exact, depth included. What is wanted is variety the recordings lack:
held-rolled cameras, other focal lengths, other distances, other light.
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

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class View:
    """One training sample before the backbone.

    Attributes:
        image_rgb: ``(rows, columns, 3)`` uint8.
        depth_m: ``(rows, columns)`` float32, 0 where unknown.
        focal_px: focal length in pixels of ``image_rgb``.
        down: ``(3,)`` unit direction of gravity in the view's camera frame; zeros where unknown.
    """

    image_rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    focal_px: float
    down: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


def augmented_view(
    frame: Frame,
    rows: int,
    columns: int,
    config: AugmentConfig,
    rng: np.random.Generator,
    down: NDArray[np.float64] | None = None,
) -> View:
    """A random view of ``frame`` (which has depth) at ``rows`` x ``columns`` pixels.

    Args:
        down: ``(3,)`` unit direction of gravity in the frame's camera. The view is then turned about
            upright, not about how the camera was held.
    """
    flip = rng.random() < config.flip
    rolled = rng.random() < config.rolled
    roll = (
        rng.uniform(-config.max_roll_deg, config.max_roll_deg)
        if rolled
        else rng.normal(0.0, config.upright_roll_deg)
    )
    if down is not None:
        roll -= float(np.degrees(roll_rad(down)))
    tilt = rng.uniform(-config.max_tilt_deg, config.max_tilt_deg, 2)
    zoom = _zoom(config, roll, rng)
    R_camera_view = _turn(roll, tilt[0], tilt[1])
    image, depth, focal = seen_from(frame, rows, columns, R_camera_view, zoom, flip)
    return View(photometric(image, config, rng), depth, focal, _down_in_view(down, R_camera_view, flip))


def plain_view(frame: Frame, rows: int, columns: int, down: NDArray[np.float64] | None = None) -> View:
    """``frame`` seen by its own camera with square pixels, centred, at ``rows`` x ``columns``; rolled
    upright where ``down (3,)``, the direction of gravity in its frame, is known."""
    R_camera_view = _turn(0.0 if down is None else -float(np.degrees(roll_rad(down))), 0.0, 0.0)
    seen = seen_from(frame, rows, columns, R_camera_view, 1.0, False)
    return View(*seen, _down_in_view(down, R_camera_view, False))


def matching_view(
    frame: Frame,
    rows: int,
    columns: int,
    config: AugmentConfig,
    rng: np.random.Generator,
    down: NDArray[np.float64],
    wanted: NDArray[np.float64],
) -> View:
    """A random view of ``frame`` in which gravity points as ``wanted``, so that both can be one scene.

    Args:
        down: ``(3,)`` unit direction of gravity in the frame's camera.
        wanted: ``(3,)`` that in the view. Their angles below the horizon should differ little.
    """
    flip = rng.random() < config.flip
    unflipped = wanted * [-1.0, 1.0, 1.0] if flip else wanted
    about_down = so3_exp(unflipped * np.radians(rng.uniform(-config.max_tilt_deg, config.max_tilt_deg)))
    R_camera_view = _taking(unflipped, down) @ about_down
    roll = float(np.degrees(np.arctan2(R_camera_view[1, 0], R_camera_view[0, 0])))
    zoom = _zoom(config, roll, rng)
    image, depth, focal = seen_from(frame, rows, columns, R_camera_view, zoom, flip)
    return View(photometric(image, config, rng), depth, focal, wanted)


def _zoom(config: AugmentConfig, roll_deg: float, rng: np.random.Generator) -> float:
    # A rolled view without zoom would show more of the mirrored border than of the scene.
    least = 1.0 + 0.25 * abs(np.sin(np.radians(roll_deg)))
    return float(np.exp(rng.uniform(np.log(least), np.log(max(config.max_zoom, least)))))


def _turn(roll_deg: float, pan_deg: float, tilt_deg: float) -> NDArray[np.float64]:
    """``R_camera_view (3, 3)``."""
    return so3_exp(np.radians([0.0, 0.0, roll_deg])) @ so3_exp(np.radians([tilt_deg, pan_deg, 0.0]))


def _taking(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation ``(3, 3)`` that takes one unit vector to the other: a roll about the optical axis, then
    the pitch that is left, so that the axis moves no more than it has to."""
    roll = np.arctan2(target[1], target[0]) - np.arctan2(source[1], source[0])
    R_roll = so3_exp(np.array([0.0, 0.0, roll]))
    rolled = R_roll @ source
    axis = np.cross(rolled, target)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return R_roll
    return so3_exp(axis / sine * np.arctan2(sine, rolled @ target)) @ R_roll


def _down_in_view(
    down: NDArray[np.float64] | None, R_camera_view: NDArray[np.float64], flip: bool
) -> NDArray[np.float64]:
    if down is None:
        return np.zeros(3)
    seen = R_camera_view.T @ down
    return seen * [-1.0, 1.0, 1.0] if flip else seen


def mixed_view(first: View, second: View) -> View:
    """Both scenes in one: of each pixel what is nearer, at the focal length of ``first``.

    Two pairs are put into one canonical camera, so that sizes and depths stay true, and
    occlude one another as solid scenes would. What a network can learn by heart of a place
    (this counter, so that wall) is broken up; what a surface itself tells of its depth stays.
    Where a sensor saw nothing the depth of the nearest pixel decides, and the result is unknown.
    """
    factor = np.float32(first.focal_px / second.focal_px)
    second_m = second.depth_m * factor
    in_front = _completed(first.depth_m) <= _completed(second_m)
    return View(
        np.where(in_front[..., None], first.image_rgb, second.image_rgb),
        np.where(in_front, first.depth_m, second_m),
        first.focal_px,
        first.down,
    )


def _completed(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(H, W)`` with each unknown pixel given the depth of the nearest known one."""
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
    return of_label[label]


def turned_view(
    frame: Frame,
    rows: int,
    columns: int,
    roll_deg: float,
    pan_deg: float,
    tilt_deg: float,
    zoom: float,
    flip: bool,
) -> tuple[NDArray[np.uint8], NDArray[np.float32], float]:
    """Image, depth and focal length (px) of ``frame``, see :func:`seen_from`, turned by angles."""
    return seen_from(frame, rows, columns, _turn(roll_deg, pan_deg, tilt_deg), zoom, flip)


def seen_from(
    frame: Frame, rows: int, columns: int, R_camera_view: NDArray[np.float64], zoom: float, flip: bool
) -> tuple[NDArray[np.uint8], NDArray[np.float32], float]:
    """Image, depth and focal length (px) of ``frame`` after an exact camera rotation.

    ``R_camera_view (3, 3)`` takes directions of the view, before it is mirrored, to the frame's.
    The view is that of a pinhole: lens distortion of ``frame.camera`` is undone.
    Pixels from outside the frame mirror its border and have depth 0.
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
    # A point at z on its old ray lies at z / ray_z on the new optical axis's depth.
    depth = raw / rays[..., 2].astype(np.float32)
    return image, depth.astype(np.float32), float(focal)


def photometric(
    image_rgb: NDArray[np.uint8], config: AugmentConfig, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Random light, tint, saturation, blur, noise and compression of ``(H, W, 3)`` uint8."""
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


def _motion_kernel(length: int, angle_rad: float) -> NDArray[np.float32]:
    import cv2

    kernel = np.zeros((length, length), np.float32)
    centre = (length - 1) / 2
    step = centre * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    a, b = np.round(centre - step).astype(int), np.round(centre + step).astype(int)
    cv2.line(kernel, tuple(map(int, a)), tuple(map(int, b)), 1.0)
    return kernel / kernel.sum()
