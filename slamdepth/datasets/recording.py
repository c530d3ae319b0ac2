# SPDX-License-Identifier: Apache-2.0
"""A sequence whose images come from anywhere: files, an archive, a bag.

A reader says how an image and a depth image are read; :class:`Recording` makes frames of them, as every
layout has them: of a pinhole camera, not larger than tracking needs, with depth at the place of its colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.calibration import make_camera
from slamdepth.datasets.base import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of
from slamdepth.datasets.orientation import check_size
from slamdepth.datasets.resizing import reduced_camera, reduced_image
from slamdepth.datasets.sequence import is_file
from slamdepth.errors import CameraError, DatasetError
from slamdepth.io import read_depth_m, read_image_rgb
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Bytes, Floats, Floats32

_SCALED_TOLERANCE = 0.01
_ASPECT_TOLERANCE = 0.02
"""Rounding of the sides of a small depth image."""
_FOCAL_SPREAD = 0.02
"""Focal lengths of frames that differ by more are told of."""


class Recording(Dataset):
    """Frames of a recording; images larger than 640 pixels are reduced, and depth with them.

    Args:
        name, path: of the recording.
        camera: of the upright images in their own size.
        timestamps_s: ``(N,)`` strictly increasing.
        image: gives the upright image ``(H, W, 3)`` of a frame; it raises ImageDecodeError.
        depth: gives its depth in metres, of any size with the same view, None where it has none.
        truth: poses of the camera.
        notes: takes a line for each assumption.
        source: where ``camera`` comes from; None: the files of the recording.
        files: what ``image`` and ``depth`` read, where they are files of their own.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        camera: Camera,
        timestamps_s: Floats,
        image: Callable[[int], Bytes],
        *,
        depth: Callable[[int], Floats32 | None] | None = None,
        truth: Trajectory | None = None,
        notes: Sequence[str] = (),
        source: CameraSource | None = None,
        files: Sequence[Path] = (),
    ) -> None:
        self.name, self.path, self._files = name, path, files
        self.notes = [*notes]
        self.timestamps_s = timestamps_s
        self.ground_truth = truth
        self.camera_source = source or CameraSource(Certainty.GIVEN, "the files of the sequence")
        steps_s = np.diff(timestamps_s)
        rate_hz = 1.0 / float(np.median(steps_s)) if len(steps_s) else camera.fps
        self.camera = replace(reduced_camera(camera, self.notes), fps=rate_hz)
        self.has_depth = depth is not None
        self._image, self._depth = image, depth
        self._size = (camera.width, camera.height)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def files(self) -> Iterable[Path]:
        """See :meth:`slamdepth.datasets.base.Dataset.files`."""
        return self._files

    def read_original(self, index: int) -> Frame:
        """Read the colour image of a frame in its own size, with the camera of that size.

        Raises:
            IndexError, ImageDecodeError, CameraError: as :meth:`read`.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        image_rgb = self._image(index)
        width, height = self._size
        if image_rgb.shape[:2] != (height, width):
            raise CameraError(
                f"{self.path}: frame {index} is {image_rgb.shape[1]}x{image_rgb.shape[0]}, others are "
                f"{width}x{height}"
            )
        camera = self.camera.scaled(width, height)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, camera)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: the image, or the depth image asked for, does not decode.
            CameraError: the size of either is not the camera's.
        """
        image_rgb = self.read_original(index).image_rgb
        depth_m = None
        if with_depth and self._depth is not None:
            depth_m = self._depth(index)
        if depth_m is not None:
            depth_m = resized_depth(depth_m, self.camera, f"{self.path}: depth of frame {index}")
        return Frame(
            index,
            float(self.timestamps_s[index]),
            reduced_image(image_rgb, self.camera),
            self.camera,
            depth_m,
        )


class FileRecording(Recording):
    """A recording of image files, whose pixels are taken as they are stored.

    Attributes:
        image_paths: ``N`` colour images.
        depth_paths: ``N`` depth images, None for frames without one.

    Args:
        depth_paths: None where there are none; integers are in units of ``camera.depth_factor`` a metre.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        camera: Camera,
        timestamps_s: Floats,
        image_paths: Sequence[Path],
        *,
        depth_paths: Sequence[Path | None] | None = None,
        truth: Trajectory | None = None,
        notes: Sequence[str] = (),
        source: CameraSource | None = None,
    ) -> None:
        self.image_paths = tuple(image_paths)
        self.depth_paths = tuple(depth_paths or (None,) * len(self.image_paths))
        self._depth_factor = camera.depth_factor
        missing = sum(not is_file(one) for one in self.image_paths)
        if missing == len(self.image_paths):
            first = self.image_paths[0] if self.image_paths else "none is named"
            raise DatasetError(f"{path}: none of its images exists; the first: {first}")
        is_there = any(one is not None for one in self.depth_paths)
        super().__init__(
            name,
            path,
            camera,
            timestamps_s,
            lambda index: read_image_rgb(self.image_paths[index], upright=False),
            depth=self._depth_of if is_there else None,
            truth=truth,
            notes=[
                *notes,
                *([f"{missing} of {len(self.image_paths)} images do not exist"] if missing else []),
            ],
            source=source,
        )
        without = self.depth_paths.count(None)
        if is_there and without:
            self.notes.append(f"{without} of {len(self)} frames have no depth image")

    def files(self) -> Iterable[Path]:
        """See :meth:`slamdepth.datasets.base.Dataset.files`."""
        return (*self.image_paths, *(path for path in self.depth_paths if path is not None))

    def _depth_of(self, index: int) -> Floats32 | None:
        path = self.depth_paths[index]
        return None if path is None else read_depth_m(path, self._depth_factor)


def resized_depth(depth_m: Floats32, camera: Camera, what: str) -> Floats32:
    """Depth ``(H, W)`` of another resolution at that of ``camera``, each pixel the nearest one's.

    Raises:
        CameraError: it is not of the same shape, so its view is another.
    """
    import cv2

    height, width = depth_m.shape
    if (height, width) == (camera.height, camera.width):
        return depth_m
    if abs(width * camera.height / (height * camera.width) - 1.0) > _ASPECT_TOLERANCE:
        raise CameraError(
            f"{what} is {width}x{height}, the colour images are {camera.width}x{camera.height}: another "
            "shape, so it does not belong to the same pixels"
        )
    resized = cv2.resize(depth_m, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized, dtype=np.float32)


def camera_for(
    path: Path,
    shape: tuple[int, ...],
    given: Camera | None,
    find: Callable[[], Camera | None] | None,
    how: str,
) -> tuple[Camera, CameraSource]:
    """The camera of images of ``shape`` (H, W, ...), and where it comes from.

    That is the one that was given, else that of the recording, else a guess.

    Args:
        find: gives the recording's camera, None where it names none; asked only where none was given, since
            a user gives one because the recording's cannot be used. None: no recording names one.
        how: where ``find`` has it from, as a user should read it.

    Raises:
        CameraError: it is of another size.
    """
    if given is not None:
        check_size(path, shape, given)
        return given, CameraSource(Certainty.GIVEN, "--camera")
    found = None if find is None else find()
    if found is not None:
        check_size(path, shape, found)
        return found, CameraSource(Certainty.GIVEN, how)
    guess = intrinsics_of(shape[1], shape[0])
    return guess.camera, CameraSource(guess.certainty, guess.how)


def recorded_camera(
    where: Path, calibration: dict[Any, Any], shape: tuple[int, ...], notes: list[str]
) -> Camera:
    """The camera that a recording names, for its images of ``shape`` (H, W, ...).

    Args:
        where: names it in messages.
        calibration: under the keys of a ROS or OpenCV calibration.
        notes: takes a line for what is unusual, and where it is scaled to images of another resolution.

    Raises:
        CameraError: no camera is so, its lens is of an unknown model, or its images have another shape.
    """
    found: list[str] = []
    camera: Camera = make_camera(where, calibration, Camera, found)
    notes += [note for note in found if "another tool's calibration" not in note]
    height, width = shape[:2]
    if (camera.width, camera.height) == (width, height):
        return camera
    if abs(camera.width * height / (camera.height * width) - 1.0) > _SCALED_TOLERANCE:
        raise CameraError(
            f"{where}: is of images of {camera.width}x{camera.height}, they are {width}x{height}, another "
            "shape: pass --camera FILE"
        )
    notes.append(f"intrinsics of {camera.width}x{camera.height} are scaled to images of {width}x{height}")
    return camera.scaled(width, height)


def name_truth(dataset: Dataset, source: str) -> None:
    """Tell what the ground truth of a sequence is, if it has one, where no second system measured it."""
    if dataset.ground_truth is not None:
        dataset.truth_source = source
        dataset.notes.append(f"ground truth: {source}")


def middle_focal(focals_px: Floats, what: str, notes: list[str]) -> int:
    """Which of the focal lengths ``(N,)`` of the frames is the middle one: phones refocus.

    Args:
        what: names them in the line that ``notes`` takes where they differ much.
    """
    if focals_px.max() > (1.0 + _FOCAL_SPREAD) * focals_px.min():
        notes.append(f"{what} is {focals_px.min():.1f} to {focals_px.max():.1f}; that of the middle is taken")
    return int(np.argmin(np.abs(focals_px - np.median(focals_px))))


def counted_times(count: int, fps: float, notes: list[str]) -> Floats:
    """Times of frames that have none, with a note."""
    notes.append(f"times are counted: {count} frames, {fps:g} a second, which the files do not say")
    counted: Floats = np.arange(count) / fps
    return counted
