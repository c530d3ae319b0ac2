# SPDX-License-Identifier: Apache-2.0
"""The job of ``slamdepth calibrate``: images of a board to a camera file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slamdepth.boards.adjust import Fit, fit_board
from slamdepth.boards.board import Board
from slamdepth.boards.choose import View, chosen_views, edge_width_px
from slamdepth.boards.lens import BROWN_CONRADY, FISHEYE
from slamdepth.boards.verdict import advice, check_fit, check_views, coverage, projection_sigma_px
from slamdepth.calibration import camera_yaml, check_plausible
from slamdepth.datasets.image_files import list_images
from slamdepth.datasets.video import VIDEO_ENDINGS, VideoFile
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError, OutputError
from slamdepth.io import read_image_rgb, write_json, write_text
from slamdepth.report.board import write_coverage
from slamdepth.types import Camera
from slamdepth.typing import Bytes

MOST_IMAGES = 400
"""Images that are searched; a long video is sampled evenly."""

_BAD_VIEW = 3.0
"""A view this many times as far off as the median is left out: the board moved, or was not flat."""
_BETTER_SHARE = 0.8
_OWN_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated camera, and how sure it is.

    Attributes:
        camera: the camera.
        fit: intrinsics with deviations, and the residuals of each view.
        views: the views that were used.
        board: the board.
        searched, found: number of images that were searched, and that show the board.
        notes: what would make it better, one line each.
    """

    camera: Camera
    fit: Fit
    views: tuple[View, ...]
    board: Board
    searched: int
    found: int
    notes: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height


def calibrate(
    source: Path, board: Board, *, fisheye: bool = False, progress: Progress = lambda *_: None
) -> CalibrationResult:
    """Calibrate the camera that took the images of ``source``.

    Args:
        source: a video, or a folder of images.
        board: what they show.
        fisheye: fit a Kannala-Brandt lens instead of a pinhole with Brown-Conrady distortion.
        progress: takes what is done, and how much of how much.

    Raises:
        DatasetError: the images cannot be read or are of several sizes, or do not determine the camera.
    """
    views, size, searched = _views_of(source, board, progress)
    check_views(len(views), searched, board.name)
    chosen = chosen_views(views, board, size)
    check_views(len(chosen), searched, board.name)
    progress("fitting", 0, 0)
    model, other = (FISHEYE, BROWN_CONRADY) if fisheye else (BROWN_CONRADY, FISHEYE)
    fit = fit_board(model, board, [view.sighting for view in chosen], size)
    rms = fit.view_rms_px
    kept = [view for view, its in zip(chosen, rms, strict=True) if its <= _BAD_VIEW * np.median(rms)]
    notes = []
    if len(kept) < len(chosen):
        notes.append(f"{len(chosen) - len(kept)} views were left out: they fit much worse than the others")
        check_views(len(kept), searched, board.name)
        fit = fit_board(model, board, [view.sighting for view in kept], size)
    rival = fit_board(other, board, [view.sighting for view in kept], size)
    better = ""
    if rival.rms_px < _BETTER_SHARE * fit.rms_px:
        better = (
            f"a lens of the model '{other.name}' fits better ({rival.rms_px:.2f} pixels instead of "
            f"{fit.rms_px:.2f}): calibrate {'without' if fisheye else 'with'} --fisheye"
        )
        notes.append(better)
    check_fit(fit, better)
    try:
        camera = model.camera(fit.values, *size)
        notes += check_plausible(camera)
    except CameraError as error:
        raise DatasetError(
            f"the images determine no possible camera ({error}): "
            f"{better or 'film the board in every corner of the image'}"
        ) from error
    notes += advice(fit, kept, size)
    return CalibrationResult(camera, fit, tuple(kept), board, searched, len(views), tuple(notes))


def write_calibration(path: Path, result: CalibrationResult) -> dict[str, Path]:
    """Write the camera file, and next to it a folder with the details and the picture.

    Other keys of a camera file that is there already, such as ``fps``, are kept.

    Returns:
        What was written, by name.

    Raises:
        OutputError: a file cannot be written, or ``path`` holds something else than a camera.
    """
    folder = path.with_name(f"{path.stem}-calibration")
    text = _camera_text(path, result)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    write_json(folder / "calibration.json", details(result))
    write_coverage(folder / "coverage.png", result.fit, result.views, result.size)
    write_text(path, text)
    return {"camera": path, "details": folder / "calibration.json", "coverage": folder / "coverage.png"}


def details(result: CalibrationResult) -> dict[str, Any]:
    """Figures of a calibration, as ``calibration.json`` has them; pixels, degrees and millimetres."""
    fit = result.fit
    views = [
        {
            "image": view.name, "corners": len(view.sighting.ids), "rms_px": round(rms, 4),
            "tilt_deg": round(tilt, 1), "distance_mm": round(float(np.linalg.norm(T[:3, 3])), 1),
            "edge_px": round(view.edge_px, 2),
        }
        for view, rms, tilt, T in zip(
            result.views, fit.view_rms_px.tolist(), fit.tilts_deg.tolist(), fit.T_camera_board, strict=True
        )
    ]  # fmt: skip
    names = fit.model.names
    return {
        "board": result.board.name,
        "square_mm": result.board.square_mm,
        "model": fit.model.name,
        "width": result.size[0],
        "height": result.size[1],
        "values": dict(zip(names, fit.values.tolist(), strict=True)),
        "sigma": dict(zip(names, fit.sigma.tolist(), strict=True)),
        "rms_px": fit.rms_px,
        "edge_sigma_px": projection_sigma_px(fit, result.size),
        "images": result.searched,
        "images_with_board": result.found,
        "corners_by_place": coverage(result.views, result.size),
        "views": views,
        "notes": list(result.notes),
    }


def _camera_text(path: Path, result: CalibrationResult) -> str:
    kept = {}
    if path.exists():
        try:
            there = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise OutputError(f"{path}: is there already and no camera file: name another file") from error
        if not isinstance(there, dict) or "fx" not in there:
            raise OutputError(f"{path}: is there already and no camera file: name another file")
        kept = {key: value for key, value in there.items() if key not in _OWN_KEYS}
    values = yaml.safe_load(camera_yaml(result.camera))
    values = {key: values[key] for key in _OWN_KEYS if key in values}
    fit = result.fit
    sure = ", ".join(f"{name} {s:.2g}" for name, s in zip(fit.model.names, fit.sigma, strict=True))
    return (
        f"# slamdepth calibrate: {len(result.views)} views of the board {result.board.name}, RMS "
        f"{fit.rms_px:.3f} pixels\n# standard deviations: {sure}\n"
        + yaml.safe_dump(values | kept, sort_keys=False, default_flow_style=None)
    )


def _views_of(source: Path, board: Board, progress: Progress) -> tuple[list[View], tuple[int, int], int]:
    import cv2

    views: list[View] = []
    size: tuple[int, int] | None = None
    searched = 0
    for name, read, done, total in _images_of(source):
        progress("searching", done, total)
        try:
            image_rgb = read()
        except ImageDecodeError:
            continue
        searched += 1
        if size is None:
            size = image_rgb.shape[1], image_rgb.shape[0]
        if image_rgb.shape[1::-1] != size:
            raise DatasetError(
                f"{source}: {name} is {image_rgb.shape[1]}x{image_rgb.shape[0]}, others are "
                f"{size[0]}x{size[1]}: images of one camera have one size"
            )
        grey = np.asarray(cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        sighting = board.find(grey)
        if sighting is not None:
            views.append(View(name, sighting, edge_width_px(board, sighting, grey)))
    if size is None:
        raise DatasetError(f"{source}: no image of it decodes")
    return views, size, searched


def _images_of(source: Path) -> Iterator[tuple[str, Callable[[], Bytes], int, int]]:
    """Name and reader of each image to be searched, and its number of how many."""
    source = source.expanduser()
    if source.is_dir():
        images = list_images(source)
        images = images[:: math.ceil(len(images) / MOST_IMAGES)]
        for number, path in enumerate(images):
            yield path.name, partial(read_image_rgb, path), number, len(images)
        return
    if not source.exists():
        raise DatasetError(f"{source}: no such file or folder")
    if source.suffix.lower() not in VIDEO_ENDINGS:
        known = ", ".join(ending.removeprefix(".") for ending in VIDEO_ENDINGS)
        raise DatasetError(f"{source}: neither a folder of images nor a video by its ending ({known})")
    video = VideoFile(source)
    total = video.frames_named or 0
    stride = max(1, math.ceil(total / MOST_IMAGES))
    for index, decode in video.frames(stride):
        yield f"frame {index}", decode, index, total
