# SPDX-License-Identifier: Apache-2.0
"""Rendered sequences as a camera with a wide lens takes them, and the lenses of the tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from slamdepth.calibration import WideLens
from slamdepth.io import write_camera, write_tum_trajectory
from slamdepth.synth.render import Renderer
from slamdepth.synth.scene import build_scene
from slamdepth.synth.sequence import SynthSettings, synth_trajectory
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats32

LENSES = {
    "fisheye": WideLens("fisheye", (0.0034824, 0.00071503, -0.0020532, 0.00020294)),
    "double_sphere": WideLens("double_sphere", (-0.2, 0.59)),
    "extended_unified": WideLens("extended_unified", (0.6, 1.1)),
    "unified": WideLens("unified", (1.8, -0.2, 0.1, 0.001, -0.002)),
    "fov": WideLens("fov", (0.92,)),
}
"""Coefficients of real lenses: TUM-VI's, a drone's, a phone's clip-on lens."""

SHARPER = 2
"""Pixels of the source, along a side, for each of the image."""


def wide_camera(side: int = 512, lens: WideLens = LENSES["fisheye"], view_rad: float = 2.6) -> Camera:
    """A camera of ``side`` x ``side`` pixels that sees about ``view_rad`` from edge to edge."""
    focal = side / view_rad / lens.slope
    return Camera(side, side, focal, 0.99 * focal, 0.502 * side, 0.495 * side, lens=lens)


def source_camera(camera: Camera, half_view_deg: float = 64.0) -> Camera:
    """A pinhole camera for images from which those of ``camera`` are made."""
    focal = SHARPER * camera.fx * (camera.lens.slope if camera.lens else 1.0)
    side = 2 * int(focal * np.tan(np.radians(half_view_deg)))
    return Camera(side, side, focal, focal, (side - 1) / 2, (side - 1) / 2)


def through_lens(image: Bytes, source: Camera, camera: Camera) -> Bytes:
    """What ``camera`` sees of the scene that ``source`` sees as ``image``; black outside."""
    fine = camera.scaled(SHARPER * camera.width, SHARPER * camera.height)
    u, v = _source_maps(fine, source)
    found = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderValue=0)
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(found, size, interpolation=cv2.INTER_AREA), np.uint8)


def depth_through_lens(depth_m: Floats32, source: Camera, camera: Camera) -> Floats32:
    """The same of depth along z, by nearest neighbour."""
    u, v = _source_maps(camera, source)
    return np.asarray(cv2.remap(depth_m, u, v, cv2.INTER_NEAREST, borderValue=0), np.float32)


def _source_maps(camera: Camera, source: Camera) -> tuple[Floats32, Floats32]:
    assert camera.lens is not None
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plane = np.stack([(u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy], axis=1)
    rays = camera.lens.unproject(plane)
    with np.errstate(all="ignore"):
        px = source.fx * rays[:, :2] / rays[:, 2:] + [source.cx, source.cy]
    px[~(rays[:, 2] > 0.05)] = -1e4
    maps = px.astype(np.float32).reshape(camera.height, camera.width, 2)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def renderer_of(settings: SynthSettings, camera: Camera) -> Renderer:
    """A renderer of the room of ``settings`` for any pinhole camera."""
    return Renderer(build_scene(settings.seed, settings.texture), camera, 0.012, settings.seed)


def render_pair(settings: SynthSettings, camera: Camera, pinhole: Camera, folder: Path) -> tuple[Path, Path]:
    """TUM folders of one walk: through a wide lens, and as a pinhole camera renders it."""
    source = source_camera(camera)
    from_source, from_pinhole = (renderer_of(settings, of) for of in (source, pinhole))
    truth = synth_trajectory(settings)
    places = folder / "wide", folder / "pinhole"
    for place in places:
        for kind in ("rgb", "depth"):
            (place / kind).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for index, T in enumerate(truth.T_world_camera):
        colour, depth_m = from_source.render(T)
        image = through_lens(np.clip(colour, 0, 255).astype(np.uint8), source, camera)
        _write(places[0], index, image, depth_through_lens(depth_m, source, camera), rng)
        colour, depth_m = from_pinhole.render(T)
        _write(places[1], index, np.clip(colour, 0, 255).astype(np.uint8), depth_m, rng)
    for place, its in zip(places, (camera, pinhole), strict=True):
        write_camera(place / "camera.yaml", replace(its, depth_factor=1000.0))
        write_tum_trajectory(place / "groundtruth.txt", truth)
        for kind in ("rgb", "depth"):
            names = [f"{t:.6f} {kind}/{i:04d}.png" for i, t in enumerate(truth.timestamps_s)]
            (place / f"{kind}.txt").write_text("\n".join(names) + "\n")
    return places


def _write(place: Path, index: int, image: Bytes, depth_m: Floats32, rng: np.random.Generator) -> None:
    noisy = np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)
    cv2.imwrite(str(place / "rgb" / f"{index:04d}.png"), cv2.cvtColor(noisy, cv2.COLOR_RGB2BGR))
    raw = np.round(1000.0 * depth_m).astype(np.uint16)
    cv2.imwrite(str(place / "depth" / f"{index:04d}.png"), raw)
