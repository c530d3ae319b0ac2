# SPDX-License-Identifier: Apache-2.0
"""Scenes of Hypersim (Roberts et al., ICCV 2021), as its archives unpack.

A folder ``ai_VVV_NNN`` with ``images/scene_cam_XX_final_preview/frame.NNNN.tonemap.jpg``
(or ``.color.jpg``) and ``images/scene_cam_XX_geometry_hdf5/frame.NNNN.depth_meters.hdf5``.
Despite its name the latter holds the distance from the camera's centre along each ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_image_rgb
from slamdepth.training.data import fingerprint, register_reader
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats, Floats32

FOCAL_PX, WIDTH_PX = 886.81, 1024
"""Focal length of an image ``WIDTH_PX`` wide: 60 degrees across."""

_KEY = "dataset"


@dataclass(frozen=True)
class HypersimPlace:
    """All frames of one scene, from all of its cameras, that have both image and distances.

    Attributes:
        images, distances: file paths, in the same order.
    """

    name: str
    camera: Camera
    images: tuple[Path, ...]
    distances: tuple[Path, ...]
    notes: tuple[str, ...]
    benchmark: str | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def fingerprint(self) -> str:
        return fingerprint((*self.images, *self.distances), self.camera)

    def read(self, index: int) -> Frame:
        """Frame ``index`` with depth; see :meth:`slamdepth.training.data.Place.read`."""
        try:
            image_rgb = read_image_rgb(self.images[index])
        except ImageDecodeError as error:
            raise DatasetError(str(error)) from error
        distance_m = read_distance_m(self.distances[index])
        expected = (self.camera.height, self.camera.width)
        for path, shape in ((self.images[index], image_rgb.shape), (self.distances[index], distance_m.shape)):
            if shape[:2] != expected:
                raise DatasetError(f"{path}: {shape[:2]} pixels, the scene's first image has {expected}")
        return Frame(index, float(index), image_rgb, self.camera, planar_depth_m(distance_m, self.camera))

    def gravity(self, index: int) -> Floats | None:
        """None: this layout does not record gravity."""
        del index
        return None


@register_reader
class HypersimReader:
    """Opens Hypersim scenes."""

    name = "hypersim"
    needs = (
        "images/scene_cam_XX_final_preview/frame.NNNN.tonemap.jpg or .color.jpg, "
        "images/scene_cam_XX_geometry_hdf5/frame.NNNN.depth_meters.hdf5"
    )

    def matches(self, folder: Path) -> bool:
        return next(folder.glob("images/scene_cam_*"), None) is not None

    def open(self, folder: Path) -> HypersimPlace:
        _h5py()  # fails now rather than after hours of training
        pairs = []
        distances = sorted(folder.glob("images/scene_cam_*_geometry_hdf5/frame.*.depth_meters.hdf5"))
        for distance in distances:
            frame = distance.name.removesuffix(".depth_meters.hdf5")
            previews = distance.parent.with_name(
                distance.parent.name.replace("_geometry_hdf5", "_final_preview")
            )
            candidates = (previews / f"{frame}.{kind}.jpg" for kind in ("tonemap", "color"))
            if (image := next(filter(Path.is_file, candidates), None)) is not None:
                pairs.append((image, distance))
        if not pairs:
            raise DatasetError(f"{folder}: no frame with image and distances here; needed are {self.needs}")
        try:
            height, width = read_image_rgb(pairs[0][0]).shape[:2]
        except ImageDecodeError as error:
            raise DatasetError(str(error)) from error
        focal = FOCAL_PX * width / WIDTH_PX
        notes = [
            f"focal length {focal:.2f} px assumed, that of Hypersim's usual camera; some scenes are rendered "
            "with a shifted one"
        ]
        if len(pairs) < len(distances):
            notes.append(f"{len(distances) - len(pairs)} of {len(distances)} frames have no image")
        return HypersimPlace(
            folder.resolve().name,
            Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2),
            tuple(image for image, _ in pairs),
            tuple(distance for _, distance in pairs),
            tuple(notes),
        )


def read_distance_m(path: Path) -> Floats32:
    """The unmodified ``(H, W)`` distances of a ``depth_meters.hdf5`` file, in metres.

    Raises:
        DatasetError: h5py is not installed, the file is damaged, or holds no such array.
    """
    h5py = _h5py()
    try:
        with h5py.File(path, "r") as file:
            found = file[_KEY][()]
    except KeyError as error:
        raise DatasetError(f"{path}: has no data set named '{_KEY}'") from error
    except (OSError, RuntimeError) as error:  # h5py raises either on damaged files
        raise DatasetError(f"{path}: not readable as HDF5: {str(error).splitlines()[0]}") from error
    values = np.asarray(found)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
        raise DatasetError(
            f"{path}: expected rows and columns of metres, found {values.shape} {values.dtype}"
        )
    return values.astype(np.float32)


def planar_depth_m(distance_m: Floats32, camera: Camera) -> Floats32:
    """Depth along z of distances along rays, both ``(H, W)`` metres.

    ``z = d / sqrt(x^2 + y^2 + 1)`` for the ray ``(x, y, 1)`` of a pixel of ``camera``, which
    has no distortion. Distances that are not finite or not positive become 0, unknown.
    """
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    z = distance_m / np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + 1.0)
    return np.where(np.isfinite(z) & (z > 0), z, 0.0).astype(np.float32)


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise DatasetError(
            "reading Hypersim needs h5py: install it with pip install 'slamdepth[hypersim]'"
        ) from error
    return h5py
