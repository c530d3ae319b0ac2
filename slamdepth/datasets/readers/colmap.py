# SPDX-License-Identifier: Apache-2.0
"""COLMAP workspaces: ``sparse/0`` (or ``sparse``) with cameras and images, and the folder ``images``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from slamdepth.datasets.colmap_model import ColmapImage, is_model, read_model
from slamdepth.datasets.image_files import natural_key
from slamdepth.datasets.poses import trajectory_of
from slamdepth.datasets.recording import FileRecording, camera_for, counted_times, name_truth, recorded_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image, is_file
from slamdepth.errors import DatasetError
from slamdepth.types import Camera

_FPS = 30.0
_TRUTH = "poses of COLMAP, of an unknown unit"
_SPARSE = ("sparse", "colmap/sparse")


@register_reader
class ColmapReader:
    """Opens workspaces of COLMAP."""

    name = "colmap"
    needs = "sparse/0 or sparse with cameras and images (.bin or .txt), and images/"

    def matches(self, path: Path) -> bool:
        if (path / "transforms.json").is_file() or (path / "rgb.txt").exists():
            return False
        return bool(_models(path))

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        notes: list[str] = []
        read = [(folder, *read_model(folder)) for folder in _models(path)]
        folder, cameras, images = max(read, key=lambda one: len(one[2]))
        if len(read) > 1:
            notes.append(f"{len(read)} models; the one in {folder.relative_to(path)} has the most images")
        if not images:
            raise DatasetError(f"{folder}: no registered images")
        camera_id, _ = Counter(image.camera_id for image in images).most_common(1)[0]
        kept = [image for image in images if image.camera_id == camera_id]
        if len(kept) < len(images):
            notes.append(
                f"{len(images) - len(kept)} images of other cameras than number {camera_id} are left out"
            )
        if camera_id not in cameras:
            raise DatasetError(f"{folder}: its images are of camera {camera_id}, which it does not have")
        places = _places(path, kept)
        names = sorted(places, key=lambda name: (natural_key(name), name))
        if len(names) < len(kept):
            notes.append(f"{len(kept) - len(names)} of {len(kept)} registered images do not exist")
        paths = [places[name] for name in names]
        _, shape = first_image(tuple(paths))
        taken_by, source = camera_for(
            path,
            shape,
            camera,
            lambda: recorded_camera(folder, cameras[camera_id].calibration(folder), shape, notes),
            f"COLMAP's model in {folder.relative_to(path)}",
        )
        times_s = counted_times(len(paths), _FPS, notes)
        poses = {image.name: image.T_world_camera for image in kept}
        truth = trajectory_of(times_s, [poses[name] for name in names], notes, is_metric=False)
        recording = FileRecording(
            path.resolve().name, path, taken_by, times_s, paths, truth=truth, notes=notes, source=source
        )
        name_truth(recording, _TRUTH)
        return recording


def _models(path: Path) -> list[Path]:
    for name in _SPARSE:
        sparse = path / name
        if is_model(sparse):
            return [sparse]
        if sparse.is_dir():
            found = sorted(folder for folder in sparse.iterdir() if folder.is_dir() and is_model(folder))
            if found:
                return found
    return []


def _places(path: Path, images: list[ColmapImage]) -> dict[str, Path]:
    """The files of the images by their names, in ``images`` or in the workspace itself."""
    names = [image.name for image in images if image.name and "\0" not in image.name]
    for folder in (path / "images", path):
        found = {name: folder / name for name in names if is_file(folder / name)}
        if found:
            return found
    first = names[0] if names else "none is named"
    raise DatasetError(
        f"{path}: none of the {len(images)} registered images is in images/; the first: {first}"
    )
