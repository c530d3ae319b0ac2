# SPDX-License-Identifier: Apache-2.0
"""Where a recording, or one image, is in a saved map."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth._version import __version__
from slamdepth.config import Config
from slamdepth.datasets import ReadOptions, open_dataset
from slamdepth.datasets.addresses import without_secret
from slamdepth.datasets.image_files import IMAGE_ENDINGS
from slamdepth.datasets.intrinsics import intrinsics_of_images, tell_guess
from slamdepth.datasets.readers.live import LiveReader
from slamdepth.datasets.virtual_view import as_pinhole
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError
from slamdepth.io import results_folder, writable, write_json, write_text, write_tum_trajectory
from slamdepth.io.images import read_image_rgb
from slamdepth.io.trajectory import format_timestamp
from slamdepth.mapstore import Map
from slamdepth.pipeline.folder import make_folder
from slamdepth.pipeline.options import RunInterrupted, check_frames_asked
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.pipeline.saved_maps import camera_at_size, other_lens, use_camera_of_map
from slamdepth.tracking import MapLocaliser
from slamdepth.types import Camera, Frame, StepResult, TrackingStatus, Trajectory

logger = logging.getLogger(__name__)

FIGURES = "localized.json"
_TABLE, _TRAJECTORY = "frames.csv", "trajectory.txt"
_HEADER = "frame,timestamp_s,status,quality,landmarks,sigma_m,sigma_deg,tx,ty,tz,qx,qy,qz,qw"

Progress = Callable[[int, int, StepResult], None]


@dataclass(frozen=True)
class Localisation:
    """Where frames are in a map.

    Attributes:
        steps: one result for each frame, in order.
        trajectory: the placed frames in the map's world.
        skipped: images that did not decode.
        fps: frames a second, reading included.
        notes: what a reader of the result should know, one line each.
    """

    steps: tuple[StepResult, ...]
    trajectory: Trajectory
    skipped: int
    fps: float
    notes: tuple[str, ...]

    @property
    def placed(self) -> int:
        """Number of frames with a pose."""
        return len(self.trajectory)

    def save(self, folder: str | Path) -> None:
        """Write ``trajectory.txt`` (TUM), ``frames.csv`` with how sure each pose is, and ``localized.json``.

        Raises:
            OutputError: they cannot be written.
        """
        path = Path(folder)
        make_folder(path)
        write_tum_trajectory(path / _TRAJECTORY, self.trajectory)
        write_text(path / _TABLE, "\n".join([_HEADER, *(_row(step) for step in self.steps)]) + "\n")
        write_json(path / FIGURES, {**self.figures(), "version": __version__})

    def figures(self) -> dict[str, Any]:
        """Counts for reports."""
        by_status = {status.value: 0 for status in TrackingStatus}
        for step in self.steps:
            by_status[step.status.value] += 1
        quality = [step.quality for step in self.steps if step.T_world_camera is not None]
        return {
            "frames": len(self.steps),
            "placed": self.placed,
            "by_status": {name: count for name, count in by_status.items() if count},
            "median_quality": float(np.median(quality)) if quality else None,
            "skipped_images": self.skipped,
            "frames_per_second": self.fps,
            "notes": list(self.notes),
        }


def localize(
    map: Map | str | Path,
    source: str | Path,
    *,
    camera: str | Path | None = None,
    config: Config | None = None,
    max_frames: int | None = None,
    stride: int = 1,
    reading: ReadOptions | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Localisation:
    """Find where a recording is in a saved map; the map does not change.

    Args:
        map: or the run folder that has it.
        source: a video, a folder of images, the folder of a sequence, or one image.
        camera: a ``camera.yaml``. Default: as the source says; of an image, the map's camera.
        config: settings; features are those of the map.
        max_frames: stop after this many frames. Default: all.
        stride: take every Nth frame.
        reading: how the source is opened, such as the topic of a bag.
        progress: called with frames done, frames in all, and the last result.
        stop: asked before each frame; True ends with the frames placed so far.

    Raises:
        InputError: the map, the source or its camera is wrong.
        RunInterrupted: ``stop`` was true before the first frame.
    """
    check_frames_asked(stride, max_frames)
    saved = map if isinstance(map, Map) else Map.load(map)
    path = Path(source).expanduser()
    tell = progress or (lambda done, total, result: None)
    if path.is_file() and path.suffix.lower() in IMAGE_ENDINGS:
        return _localize_image(saved, path, camera, config)
    if LiveReader().matches(path):
        raise DatasetError(
            f"{without_secret(str(path))}: is a live source; only recordings are placed in a map: record it "
            "first, or track it with 'slamdepth run --map'"
        )
    dataset = open_dataset(path, camera, reading)
    indices = range(0, len(dataset), stride)[:max_frames]
    use_camera_of_map(dataset, saved)
    tell_guess(dataset.name, dataset.camera_source)
    notes = list(dataset.notes)
    start = time.perf_counter()
    steps: list[StepResult] = []
    skipped = 0
    with MapLocaliser(saved, dataset.camera, config) as localiser:
        reader = FramePrefetcher(dataset, indices, with_depth=False, prepare=localiser.prepare)
        with reader:
            for item in _until(reader, stop):
                if isinstance(item, ImageDecodeError):
                    skipped += 1
                    logger.warning("image skipped: %s", item)
                    continue
                steps.append(localiser.step(item.frame, item.prepared))
                tell(len(steps) + skipped, len(indices), steps[-1])
        trajectory, quality = localiser.finish(), localiser.quality()
        notes += _notes_on_images(saved, localiser)
    if not steps and stop is not None and stop():
        raise RunInterrupted("interrupted before the first frame; nothing was saved")
    if not steps:
        raise DatasetError(f"{path}: none of the {len(indices)} images decodes")
    if len(steps) + skipped < len(indices):
        notes.append(f"interrupted after {len(steps) + skipped} of {len(indices)} frames")
    fps = len(steps) / max(1e-9, time.perf_counter() - start)
    return Localisation(_settled(steps, trajectory, quality), trajectory, skipped, fps, tuple(notes))


def _until(reader: FramePrefetcher, stop: Callable[[], bool] | None) -> Iterator[Any]:
    for item in reader:
        if stop is not None and stop():
            return
        yield item


def _settled(
    steps: list[StepResult], trajectory: Trajectory, quality: NDArray[np.float64]
) -> tuple[StepResult, ...]:
    """The results with the poses of ``trajectory``, those that later frames confirmed among them.

    Frames that it does not have are lost: later frames contradicted their poses.
    """
    poses = zip(trajectory.T_world_camera, quality.tolist(), strict=True)
    found = dict(zip(trajectory.timestamps_s.tolist(), poses, strict=True))
    settled = []
    for step in steps:
        if step.timestamp_s not in found:
            step = replace(
                step, status=TrackingStatus.LOST, T_world_camera=None, inliers=0, quality=0.0, covariance=None
            )
        else:
            T_world_camera, sure = found[step.timestamp_s]
            if step.T_world_camera is None:
                step = replace(step, status=TrackingStatus.RELOCALISED, quality=sure)
            step = replace(step, T_world_camera=T_world_camera)
        settled.append(step)
    return tuple(settled)


def _localize_image(
    saved: Map, path: Path, camera_file: str | Path | None, config: Config | None
) -> Localisation:
    """One image, by itself."""
    image_rgb = read_image_rgb(path)
    height, width = image_rgb.shape[:2]
    notes: tuple[str, ...] = ()
    if camera_file is not None:
        camera = Camera.from_file(Path(camera_file).expanduser())
    else:
        theirs = camera_at_size(saved.camera, width, height)
        if theirs is None:
            raise CameraError(
                f"{path}: is {width}x{height}, and the map's camera {saved.camera.width}x"
                f"{saved.camera.height}: another camera; give its intrinsics with --camera FILE"
            )
        own, source = intrinsics_of_images(path, width, height)
        note = other_lens(own, source, theirs)
        camera = theirs if note is None else own
        notes = (note or "intrinsics are those of the map's camera; --camera FILE gives others",)
    if (camera.width, camera.height) != (width, height):
        raise CameraError(
            f"{path}: is {width}x{height}, and the camera file is for {camera.width}x{camera.height}"
        )
    view = as_pinhole(Frame(0, 0.0, image_rgb, camera))
    image_rgb, camera = view.image_rgb, view.camera
    height, width = image_rgb.shape[:2]
    if width > saved.camera.width:
        import cv2

        camera = camera.scaled(saved.camera.width, round(height * saved.camera.width / width))
        size = (camera.width, camera.height)
        image_rgb = np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    start = time.perf_counter()
    with MapLocaliser(saved, camera, config) as localiser:
        step = localiser.place(Frame(0, 0.0, image_rgb, camera))
        notes += _notes_on_images(saved, localiser)
    found = step.T_world_camera
    poses = np.zeros((0, 4, 4)) if found is None else found[None]
    trajectory = Trajectory(np.zeros(len(poses)), poses)
    return Localisation((step,), trajectory, 0, 1.0 / (time.perf_counter() - start), notes)


def _notes_on_images(saved: Map, localiser: MapLocaliser) -> tuple[str, ...]:
    """What is said where the map has images, and keypoints cannot be aligned in them, or in some."""
    if damaged := localiser.damaged_images:
        return (f"{damaged} images of the map are damaged: keypoints are not aligned in them",)
    if not saved.has_images or localiser.has_images:
        return ()
    return ("keypoints are not aligned in the map's images: another camera, or size, has taken them",)


def _row(step: StepResult) -> str:
    """A line of ``frames.csv``."""
    head = f"{step.index},{format_timestamp(step.timestamp_s)},{step.status.value},{step.quality:.3f}"
    if step.T_world_camera is None:
        return f"{head},0,,,,,,,,,"
    from scipy.spatial.transform import Rotation

    sigmas = ["", ""]
    if step.covariance is not None:
        variance = step.covariance.diagonal()
        sigma_deg = np.degrees(np.sqrt(variance[3:].sum()))
        sigmas = [f"{np.sqrt(variance[:3].sum()):.5f}", f"{sigma_deg:.4f}"]
    quat_xyzw = Rotation.from_matrix(step.T_world_camera[:3, :3]).as_quat(canonical=True)
    numbers = [f"{value:.10g}" for value in (*step.T_world_camera[:3, 3].tolist(), *quat_xyzw.tolist())]
    return ",".join([head, str(step.inliers), *sigmas, *numbers])


def plan_folder(output: Path | None, name: str, *, overwrite: bool) -> Path:
    """Choose and check the folder of the results; nothing is written.

    Raises:
        OutputError: it is a file, cannot be written, or holds something else than earlier results.
    """
    if output is None:
        safe = re.sub(r"[^\w.-]+", "-", name)  # a pattern has stars
        return writable(Path("runs") / f"{safe}-localized-{time.strftime('%Y%m%d-%H%M%S')}")
    return results_folder(
        output, lambda path: (path / FIGURES).is_file(), "localisation", overwrite=overwrite
    )
