# SPDX-License-Identifier: Apache-2.0
"""The layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

``rgb.txt`` and, optionally, ``depth.txt`` list ``timestamp filename``; ``groundtruth.txt``
lists camera-to-world poses. Depth images are registered to the colour image: 16 bits, or floats in metres.
Times are in seconds; other units are recognised and converted.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets.association import associate
from slamdepth.datasets.image_files import has_images
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of_images
from slamdepth.datasets.orientation import exif_orientation, fitted_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import (
    MAX_TIME_DIFFERENCE_S,
    ImageSequence,
    check_overlap,
    first_image,
    is_file,
)
from slamdepth.datasets.video import videos_in
from slamdepth.errors import DatasetError
from slamdepth.io import parse_float, read_tum_trajectory
from slamdepth.io.columns import stated_unit
from slamdepth.io.text import read_commented_lines
from slamdepth.io.times import TimeColumn, conversion_notes, judge_unit, settle_unit
from slamdepth.io.trajectory_reader import unit_of
from slamdepth.types import Camera
from slamdepth.typing import Floats

# As ORB-SLAM2's settings files give them, but for the depth factor of freiburg2 (see the note).
_KNOWN_CAMERAS = {
    "1": Camera(
        640, 480, 517.306408, 516.469215, 318.643040, 255.313989,
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": Camera(
        640, 480, 520.908620, 521.007327, 325.141442, 249.701764,
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}  # fmt: skip
_LISTS = ("rgb.txt", "depth.txt")
_KNOWN_NAME = re.compile(r"(?:^|[^a-z0-9])(?:freiburg|fr)([123])(?![a-z0-9])", re.IGNORECASE)


@register_reader
class TumReader:
    """Opens TUM folders."""

    name = "tum"
    needs = "rgb.txt and the images it lists; optional depth.txt, groundtruth.txt, camera.yaml"

    def matches(self, path: Path) -> bool:
        if any((path / name).exists() for name in _LISTS):
            return True
        if (path / "groundtruth.txt").exists() and not videos_in(path):  # else the poses are the video's
            return True
        return has_images(path / "rgb") and not has_images(path)

    def open(self, path: Path, camera: Camera | None) -> ImageSequence:
        notes: list[str] = []
        if not (path / "rgb.txt").exists() and has_images(path / "rgb"):
            raise DatasetError(
                f"{path / 'rgb.txt'}: missing; write a line 'seconds rgb/NAME' for each image in "
                f"{path / 'rgb'}, as a command in the README does; or name that folder itself, if they were "
                "taken at equal intervals"
            )
        times, image_paths = read_image_list(path / "rgb.txt")
        _check_images(path / "rgb.txt", image_paths, notes)
        sample_path, sample_shape = first_image(image_paths)
        source = CameraSource(Certainty.GIVEN, "--camera")
        if camera is None:
            camera, source = _find_camera(path, notes)
        orientation = exif_orientation(sample_path, notes)
        if camera is None:
            camera, source = intrinsics_of_images(sample_path, sample_shape[1], sample_shape[0])
        else:
            camera = fitted_camera(sample_path, sample_shape, camera, orientation, notes)
        timestamps_s = _seconds(path / "rgb.txt", times, camera.fps, None, notes)

        depth_paths, why_no_depth = _match_depth(path / "depth.txt", timestamps_s, camera.fps, notes)
        ground_truth = None
        if (path / "groundtruth.txt").exists():
            ground_truth, repairs = read_tum_trajectory(path / "groundtruth.txt", timestamps_s)
            notes += repairs
            check_overlap(timestamps_s, ground_truth, path / "groundtruth.txt")
        return ImageSequence(
            path.resolve().name,
            path,
            camera,
            timestamps_s,
            image_paths,
            depth_paths,
            ground_truth,
            notes,
            why_no_depth=why_no_depth,
            orientation=orientation,
            camera_source=source,
        )


def read_image_list(path: Path) -> tuple[TimeColumn, tuple[Path, ...]]:
    """Read ``timestamp filename`` lines; file names are relative to the list.

    Returns:
        ``N`` times, strictly increasing, in the unit of the file, and ``N`` paths.

    Raises:
        DatasetError: the file is missing, a line is malformed, or its time does not
            increase; names file and line. An empty list is no error here.
    """
    if not path.exists():
        raise DatasetError(f"{path}: missing; it lists the images, 'timestamp filename' a line")
    times: list[float] = []
    texts: list[str] = []
    images: list[Path] = []
    comments: list[str] = []
    for number, line in read_commented_lines(path):
        fields = re.split(r"[\s,]+", line, maxsplit=1)
        is_header = not times and re.match(r"%?time", fields[0], re.IGNORECASE) is not None
        if line.startswith("#") or is_header:
            comments += [line] if not times else []
            continue
        try:
            time_s = parse_float(fields[0])
        except ValueError:
            time_s = np.nan
        if len(fields) != 2 or not fields[1] or not np.isfinite(time_s):
            raise DatasetError(f"{path}:{number}: expected 'timestamp filename', found {line[:80]!r}")
        if times and time_s <= times[-1]:
            raise DatasetError(
                f"{path}:{number}: time {fields[0]} does not come after {times[-1]:.6f}: times must increase"
            )
        times.append(time_s)
        texts.append(fields[0])
        images.append(path.parent / fields[1])
    return TimeColumn(tuple(texts), stated_unit(comments)), tuple(images)


def known_camera(name: str) -> Camera | None:
    """The camera of a TUM sequence by its folder's name, such as ``rgbd_dataset_freiburg1_desk``."""
    found = _KNOWN_NAME.search(name)
    return _KNOWN_CAMERAS[found[1]] if found else None


def _seconds(
    path: Path, times: TimeColumn, fps: float, reference_s: Floats | None, notes: list[str]
) -> Floats:
    """The times ``(N,)`` of a list in seconds; a conversion is noted."""
    verdict = settle_unit(times, judge_unit(times, of_images=True, fps=fps), reference_s)
    notes += conversion_notes(path.name, times, verdict)
    return times.seconds(unit_of(path, times, verdict))


def _check_images(list_path: Path, image_paths: tuple[Path, ...], notes: list[str]) -> None:
    if not image_paths:
        raise DatasetError(f"{list_path}: lists no images; expected 'timestamp filename' a line")
    missing = [path for path in image_paths if not is_file(path)]
    if len(missing) == len(image_paths):
        raise DatasetError(
            f"{list_path}: none of its {len(missing)} images exists; the first is {missing[0]}"
        )
    if missing:
        notes.append(f"{list_path.name}: {len(missing)} of {len(image_paths)} images do not exist")


def _match_depth(
    list_path: Path, timestamps_s: Floats, fps: float, notes: list[str]
) -> tuple[tuple[Path | None, ...], str]:
    """The depth image of each colour image, and why there is none at all where some are listed."""
    matched: list[Path | None] = [None] * len(timestamps_s)
    if not list_path.exists():
        return tuple(matched), ""
    times, depth_paths = read_image_list(list_path)
    _check_images(list_path, depth_paths, notes)
    depth_times_s = _seconds(list_path, times, fps, timestamps_s, notes)
    for i, j in associate(timestamps_s, depth_times_s, MAX_TIME_DIFFERENCE_S):
        if is_file(depth_paths[j]):
            matched[i] = depth_paths[j]
    without = matched.count(None)
    if without == len(matched):
        why = (
            f"{list_path.name}: {len(depth_paths)} depth images, none within {MAX_TIME_DIFFERENCE_S} s of a "
            f"colour image: colour from {_range(timestamps_s)}, depth from {_range(depth_times_s)}"
        )
        notes.append(why)
        return tuple(matched), why
    if without:
        notes.append(
            f"{list_path.name}: {without} of {len(matched)} colour images have no depth image "
            f"within {MAX_TIME_DIFFERENCE_S} s"
        )
    return tuple(matched), ""


def _range(times_s: Floats) -> str:
    return f"{times_s[0]:.3f} to {times_s[-1]:.3f} s"


def _find_camera(path: Path, notes: list[str]) -> tuple[Camera | None, CameraSource]:
    """The camera by a file in the folder, or by the folder's name; None where there is neither."""
    camera_path = path / CAMERA_FILE
    if camera_path.exists():
        return Camera.from_file(camera_path, notes), CameraSource(Certainty.GIVEN, CAMERA_FILE)
    for name in (path.name, path.resolve().name):  # the second for '.' and links
        camera = known_camera(name)
        if camera is not None:
            note = f"intrinsics known by the folder's name {name!r}"
            if camera is _KNOWN_CAMERAS["2"]:
                note += "; depth factor 5000 as the benchmark says, ORB-SLAM2 uses 5208 for freiburg2"
            notes.append(note)
            return camera, CameraSource(Certainty.GIVEN, "the TUM benchmark, by the folder's name")
    return None, CameraSource(Certainty.GUESSED, "")
