# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM (Handa et al., ICRA 2014), rendered: its TUM-compatible layout, and its own.

The first has ``rgb/N.png``, ``depth/N.png`` (1/5000 m), ``associations.txt`` and ``*.gt.freiburg`` with a
frame number instead of a time. The second has ``scene_SS_NNNN.png``, ``.depth`` (metres along the ray, as
text) and ``.txt`` (the camera, as POV-Ray has it).

The data set's negative fy means a camera with y up in a left-handed world. Both are mirrored here:
T becomes S T S with S = diag(1, -1, 1, 1), and fy positive.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from slamdepth.datasets.image_files import has_images
from slamdepth.datasets.poses import pose_of, read_matrix, trajectory_of
from slamdepth.datasets.recording import FileRecording, Recording, camera_for
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image, is_file
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import metres_of_raw, parse_float, read_image_rgb, read_lines
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Floats, Floats32

CAMERA = Camera(640, 480, 481.20, 480.00, 319.50, 239.50, depth_factor=5000.0, fps=30.0)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_TRUTH = "*.gt.freiburg"
_OWN_NAME = re.compile(r"scene_(\d+)_(\d{1,9})\.png")
_VECTOR = re.compile(r"(cam_pos|cam_dir|cam_up)\s*=\s*\[([^\]]*)\]")
_SOURCE = "exact, by the renderer"
_HOW = "known by the ICL-NUIM layout"


@register_reader
class IclNuimReader:
    """Opens ICL-NUIM folders."""

    name = "icl-nuim"
    needs = "rgb, depth, associations.txt and *.gt.freiburg, or scene_SS_NNNN.png with .depth and .txt"

    def matches(self, path: Path) -> bool:
        if (path / "rgb.txt").exists():
            return False
        if next(path.glob(_TRUTH), None) is not None:
            return True
        return next(path.glob("scene_*_*.png"), None) is not None and (
            next(path.glob("scene_*_*.depth"), None) is not None
            or next(path.glob("scene_*_*.txt"), None) is not None
        )

    def open(self, path: Path, camera: Camera | None) -> Recording:
        if has_images(path / "rgb"):
            return _open_tum(path, camera)
        return _open_own(path, camera)


def _open_tum(path: Path, camera: Camera | None) -> FileRecording:
    notes: list[str] = []
    frames = _associations(path)
    numbers = list(frames)
    images = [image for image, _ in frames.values()]
    depths = [depth for _, depth in frames.values()]
    _, shape = first_image(tuple(images))
    taken_by, source = camera_for(path, shape, camera, lambda: CAMERA, _HOW)
    times_s = np.array(numbers, dtype=np.float64) / CAMERA.fps
    files = sorted(path.glob(_TRUTH))
    if len(files) > 1:
        raise DatasetError(f"{path}: several ground truths: {', '.join(file.name for file in files)}")
    truth = None
    if files:
        rows = {int(row[0]): row for row in read_matrix(files[0], 8) if np.isfinite(row).all()}
        found = [pose_of(rows[n][1:4], rows[n][4:]) if n in rows else None for n in numbers]
        truth = _mirrored(times_s, found, notes)
    recording = FileRecording(
        path.resolve().name, path, taken_by, times_s, images, depth_paths=depths, truth=truth, notes=notes,
        source=source,
    )  # fmt: skip
    recording.truth_source = _SOURCE
    return recording


def _associations(path: Path) -> dict[int, tuple[Path, Path | None]]:
    """Image and depth by frame number, by ``associations.txt`` or by the names in ``rgb``."""
    file = path / "associations.txt"
    found: dict[int, tuple[Path, Path | None]] = {}
    if not file.is_file():
        for image in sorted((path / "rgb").glob("*.png")):
            if image.stem.isdecimal() and len(image.stem) < 10:
                depth = path / "depth" / image.name
                found[int(image.stem)] = (image, depth if is_file(depth) else None)
    else:
        for number, line in read_lines(file):
            fields = line.split()
            names = {"depth" if "depth" in name else "rgb": name for name in fields[1::2]}
            first = fields[2 if len(fields) == 4 and "depth" in fields[1] else 0]
            if len(fields) != 4 or len(names) != 2 or not first.isdecimal() or len(first) > 9:
                raise DatasetError(
                    f"{file}:{number}: expected 'number depth/N.png number rgb/N.png', found {line[:80]!r}"
                )
            depth = path / names["depth"]
            found[int(first)] = (path / names["rgb"], depth if is_file(depth) else None)
    if not found:
        raise DatasetError(f"{path}: no images in rgb")
    return dict(sorted(found.items()))


def _open_own(path: Path, camera: Camera | None) -> Recording:
    notes: list[str] = []
    matched = {image: _OWN_NAME.fullmatch(image.name) for image in sorted(path.glob("scene_*_*.png"))}
    frames = {int(name[2]): image for image, name in matched.items() if name}
    if not frames:
        raise DatasetError(f"{path}: no images scene_SS_NNNN.png")
    images = [frames[number] for number in sorted(frames)]
    _, shape = first_image(tuple(images))
    taken_by, source = camera_for(path, shape, camera, lambda: CAMERA, _HOW)
    times_s = np.array(sorted(frames), dtype=np.float64) / CAMERA.fps
    poses = [_povray_pose(one) if is_file(one) else None for one in (i.with_suffix(".txt") for i in images)]
    rays = _ray_lengths(taken_by)

    def depth(index: int) -> Floats32 | None:
        file = images[index].with_suffix(".depth")
        return _depth_of(file, rays) if is_file(file) else None

    recording = Recording(
        path.resolve().name,
        path,
        taken_by,
        times_s,
        lambda index: read_image_rgb(images[index]),
        depth=depth if any(is_file(image.with_suffix(".depth")) for image in images) else None,
        truth=_mirrored(times_s, poses, notes),
        notes=notes,
        source=source,
        files=images,
    )
    recording.truth_source = _SOURCE
    return recording


def _mirrored(times_s: Floats, poses: list[Floats | None], notes: list[str]) -> Trajectory | None:
    notes.append("ground truth is mirrored in y: the data set's world is left-handed (its fy is negative)")
    mirrored = [None if T is None else _MIRROR @ T @ _MIRROR for T in poses]
    return trajectory_of(times_s, mirrored, notes)


def _povray_pose(path: Path) -> Floats | None:
    """Camera to world, y up, of a POV-Ray camera; None where it has none."""
    found: dict[str, Floats] = {}
    for _, line in read_lines(path):
        for name, text in _VECTOR.findall(line):
            try:
                numbers = np.array([parse_float(part) for part in text.split(",")])
            except ValueError as error:
                raise DatasetError(f"{path}: {name} must be three numbers, found {text[:60]!r}") from error
            if numbers.shape != (3,):
                raise DatasetError(f"{path}: {name} must be three numbers, found {text[:60]!r}")
            found[name] = numbers
    if len(found) < 3:
        raise DatasetError(f"{path}: needs cam_pos, cam_dir and cam_up, has {', '.join(found) or 'none'}")
    with np.errstate(all="ignore"):
        ahead = found["cam_dir"] / np.linalg.norm(found["cam_dir"])
        right = np.cross(found["cam_up"], ahead)
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        T[:3, 3] = found["cam_pos"]
    return T


def _ray_lengths(camera: Camera) -> Floats:
    """``(H, W)`` length of the ray of each pixel where its z is 1."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.asarray(np.sqrt(x * x + y * y + 1.0))


def _depth_of(path: Path, rays: Floats) -> Floats32:
    try:
        values = np.array(path.read_bytes().split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise ImageDecodeError(f"{path}: cannot be read: {error}") from error
    if values.size != rays.size:
        raise ImageDecodeError(f"{path}: holds {values.size} numbers, expected {rays.size}")
    return metres_of_raw(values.reshape(rays.shape) / rays)
