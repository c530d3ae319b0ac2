# SPDX-License-Identifier: Apache-2.0
"""Depth maps of images, folders and videos: predict, write, draw; resumable at any frame.

There are two passes. The first predicts and writes numbers and clouds, a shot at a time. The second draws
the colour maps of a video or sequence: they share one range of values, so that they do not flicker, and it
is known only then.
"""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.datasets.intrinsics import Certainty
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import (
    CameraError,
    ConfigError,
    DatasetError,
    ImageDecodeError,
    OutputError,
    SlamdepthError,
)
from slamdepth.io import write_depth_mm, write_npy, write_png
from slamdepth.pipeline.depth_maps.about import (
    about_folder,
    images,
    intrinsics_entry,
    public_name,
    readme_text,
)
from slamdepth.pipeline.depth_maps.drawing import common_range, frame_scale, write_cloud
from slamdepth.pipeline.depth_maps.folder import CLOUD, COLOUR, MILLIMETRES, VALUES, VIDEO, DepthFolder
from slamdepth.pipeline.depth_maps.options import (
    DepthMapOptions,
    DepthMapResult,
    DepthMapsInterrupted,
    Progress,
)
from slamdepth.pipeline.depth_maps.sources import Shot, Source, SourceKind, open_source
from slamdepth.pipeline.depth_maps.video import video_writer
from slamdepth.report.depth_map import Scale, depth_map_image, known_pixels, side_by_side, value_range
from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)

_MUCH_BYTES = 1e9  # from here on the user is warned


def make_depth_maps(
    options: DepthMapOptions,
    *,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
) -> DepthMapResult:
    """Predict the depth of every image of a source and write it in every form.

    Args:
        options: which source, where to, which model.
        progress: called after each shot.
        stop: set it, from any thread or a signal handler, to stop after the current shot.

    Raises:
        InputError: the source, the camera, a setting or the output place is wrong, or the
            folder holds depth maps made with other settings.
        WeightsError: weights are missing or damaged.
        DepthMapsInterrupted: ``stop`` was set.
    """
    source = open_source(
        options.source,
        camera_file=options.camera_file,
        stride=options.stride,
        max_frames=options.max_frames,
        reading=options.reading,
    )
    folder = DepthFolder.plan(options.output, source.name, is_flat=source.kind is SourceKind.IMAGE)
    model = create_depth_model(options.depth, device=options.device, weights=options.weights)
    if is_sensor(model) and not source.has_depth:
        raise DatasetError(
            f"{options.source}: has no sensor depth; choose a predicted depth (--depth dinov2)"
        )
    if options.colour_range is not None and model.kind is not DepthKind.METRIC:
        raise ConfigError(f"'{model.name}' predicts {model.kind.value}: its colours have no range in metres")
    settings = _settings(options, source, model)
    if options.overwrite:
        if folder.about or folder.frames:
            folder.clear()
    else:
        folder.check_same(settings)
    job = _Job(
        options, source, model, folder, settings, progress or (lambda *_: None), stop or threading.Event()
    )
    return job.run()


def _settings(options: DepthMapOptions, source: Source, model: DepthModel) -> dict[str, Any]:
    """What must be the same for one folder; ``max_frames`` may grow from call to call."""
    return {
        "depth model": public_name(model),
        "weights": [info.sha256 for info in model.weights],
        "source": f"{source.kind.value} {source.name} ({source.stamp})",
        "camera": None if source.camera is None else asdict(source.camera),
        "stride": options.stride,
        "colour range": None if options.colour_range is None else list(options.colour_range),
        "point clouds": options.cloud and model.kind is DepthKind.METRIC,
    }


class _Job:
    """One call of :func:`make_depth_maps`, everything checked."""

    def __init__(
        self,
        options: DepthMapOptions,
        source: Source,
        model: DepthModel,
        folder: DepthFolder,
        settings: dict[str, Any],
        progress: Progress,
        stop: threading.Event,
    ) -> None:
        self.options, self.source, self.model, self.folder = options, source, model, folder
        self.settings, self.progress, self.stop = settings, progress, stop
        self.is_metric = model.kind is DepthKind.METRIC
        self.files = [COLOUR, VALUES]
        if self.is_metric:
            self.files += [MILLIMETRES, CLOUD] if options.cloud else [MILLIMETRES]
        # The range of a video's colours is known after the last frame, unless the user gave it.
        self.draws_later = source.fps is not None and options.colour_range is None
        self.warned: set[str] = set()
        self.names: list[str] = []
        self.skipped: list[dict[str, str]] = []

    def run(self) -> DepthMapResult:
        self.folder.open(self.files, self.model.kind)
        try:
            self._write_about(complete=False)
            self._predict_all()
        except SlamdepthError:
            if not self.folder.frames:  # nothing is lost
                self.folder.discard()
            raise
        if self.source.fps is not None:
            self._draw_video()
        self._write_about(complete=True)
        self.folder.write_readme(readme_text(self.folder.about), self.files, self.model.kind)
        return DepthMapResult(self.folder.path, self.folder.about)

    def _predict_all(self) -> None:
        total = len(self.source)
        for done, shot in enumerate(self._shots("predicting", with_depth=is_sensor(self.model))):
            try:
                if not self._is_done(shot):
                    self._predict(shot)
                self.names.append(shot.name)
                if len(self.names) == 1:
                    self._check_space(shot.name, total)
            except ImageDecodeError as error:
                self._skip(shot, str(error))
            except CameraError as error:
                if self.source.kind is not SourceKind.IMAGES:
                    raise  # all of its images have that size
                self._skip(shot, str(error))
            self.progress("predicting", done + 1, max(total, done + 1))
        if not self.names:
            why = self.skipped[0]["reason"] if self.skipped else "it is empty"
            raise DatasetError(f"{self.options.source}: not one image could be used; the first: {why}")

    def _shots(self, doing: str, *, with_depth: bool = False) -> Iterator[Shot]:
        for shot in self.source.shots(with_depth=with_depth):
            if self.stop.is_set():
                raise DepthMapsInterrupted(
                    f"interrupted while {doing}: {images(len(self.names))} done, in {self.folder.path}; "
                    "the same command goes on"
                )
            yield shot

    def _skip(self, shot: Shot, reason: str) -> None:
        reason = reason.replace(f"{self.options.source}/", "")  # what is written here is passed on
        logger.warning("left out: %s", reason)
        self.skipped.append({"origin": shot.origin, "reason": reason})

    def _now_files(self) -> list[str]:
        return [kind for kind in self.files if kind != COLOUR] if self.draws_later else self.files

    def _is_done(self, shot: Shot) -> bool:
        entry = self.folder.frames.get(shot.name)
        return (
            entry is not None
            and entry.get("stamp") == shot.stamp
            and all(self._place(kind, shot.name).is_file() for kind in self._now_files())
        )

    def _place(self, file_kind: str, name: str) -> Path:
        return self.folder.place(file_kind, name, self.model.kind)

    def _predict(self, shot: Shot) -> None:
        frame, intrinsics = shot.read()
        if is_sensor(self.model) and frame.depth_m is None:
            raise ImageDecodeError(f"{shot.origin} has no sensor depth")
        if (
            intrinsics.certainty is not Certainty.GIVEN
            and self.is_metric
            and intrinsics.how not in self.warned
        ):
            self.warned.add(intrinsics.how)
            logger.warning("%s: focal length: %s", shot.origin, intrinsics.how)
        values = self.model.predict(frame).values
        ends = value_range(values, self.model.kind)
        if ends is None:
            raise ImageDecodeError(f"{shot.origin}: not one pixel has a depth")
        entry: dict[str, Any] = {
            "name": shot.name,
            "origin": shot.origin,
            "stamp": shot.stamp,
            "timestamp_s": frame.timestamp_s if self.source.fps is not None else None,
            "known": float(known_pixels(values, self.model.kind).mean()),
            "near": ends[0],
            "median": float(np.median(values[known_pixels(values, self.model.kind)])),
            "far": ends[1],
            **intrinsics_entry(intrinsics),
        }
        write_npy(self._place(VALUES, shot.name), values.astype(np.float32, copy=False))
        if self.is_metric:
            entry["beyond_65535_mm"] = write_depth_mm(self._place(MILLIMETRES, shot.name), values)
            if CLOUD in self.files:
                path = self._place(CLOUD, shot.name)
                entry["points"] = write_cloud(path, frame, values, intrinsics, public_name(self.model))
        if not self.draws_later:
            near, far = self.options.colour_range or ends
            self._draw(shot.name, values, frame_scale(near, far, self.model, entry))
        self.folder.record(entry)

    def _draw(self, name: str, values: NDArray[np.float32], scale: Scale) -> None:
        write_png(self._place(COLOUR, name), depth_map_image(values, scale))

    def _draw_video(self) -> None:
        """Colour maps with one range for all, and the video."""
        entries = [self.folder.frames[name] for name in self.names]
        near, far = self.options.colour_range or common_range(entries, self.model.kind)
        colours: dict[str, Any] = {"near": near, "far": far}
        if self.folder.about.get("colours") != colours and self.draws_later:
            for name in self.folder.frames:
                self._place(COLOUR, name).unlink(missing_ok=True)
        self._write_about(complete=False, drawn={"colours": colours})
        video = {"frames": len(self.names), "last": self.names[-1], **colours}
        if not self._is_drawn(video):
            self._write_video(frame_scale(near, far, self.model, entries[0]))
            self._write_about(complete=False, drawn={"colours": colours, "video": video})

    def _is_drawn(self, video: dict[str, Any]) -> bool:
        return (
            self.folder.about.get("video") == video
            and (self.folder.path / VIDEO).is_file()
            and all(self._place(COLOUR, name).is_file() for name in self.names)
        )

    def _write_video(self, scale: Scale) -> None:
        fps, wanted = self.source.fps, set(self.names)
        assert fps is not None
        with video_writer(self.folder.path / VIDEO, fps) as add:
            done = 0
            for shot in self._shots("drawing"):
                if shot.name not in wanted:
                    continue
                frame, _ = shot.read()
                values = np.load(self._place(VALUES, shot.name))
                if not self._place(COLOUR, shot.name).is_file():
                    self._draw(shot.name, values, scale)
                add(side_by_side(frame.image_rgb, values, scale))
                done += 1
                self.progress("drawing", done, len(wanted))

    def _check_space(self, name: str, total: int) -> None:
        """After the first image: compare what the others will take with the free space.

        Colour maps and the video, which are drawn at the end, are small by comparison and not counted.
        """
        sizes = {kind: self._place(kind, name).stat().st_size for kind in self._now_files()}
        others = total - len([n for n in self.folder.frames if n != name]) - 1
        needed, clouds = others * sum(sizes.values()), sizes.get(CLOUD, 0)
        free = shutil.disk_usage(self.folder.path).free
        if needed > free:
            leave_out = "leave out the point clouds (--no-cloud), " if clouds else ""
            raise OutputError(
                f"{self.folder.path}: {needed / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB free; "
                f"{leave_out}take fewer images (--stride, --max-frames)"
            )
        if needed > _MUCH_BYTES:
            less = (
                f"--no-cloud leaves out {clouds / sum(sizes.values()):.0%} of that"
                if clouds
                else "--stride and --max-frames take fewer"
            )
            logger.warning(
                "%s still to do, about %.1f GB, %.1f GB free; %s",
                images(others),
                needed / 1e9,
                free / 1e9,
                less,
            )

    def _write_about(self, *, complete: bool, drawn: dict[str, Any] | None = None) -> None:
        kept: dict[str, Any] = {
            key: self.folder.about[key] for key in ("colours", "video") if key in self.folder.about
        }
        about = about_folder(
            self.source,
            self.model,
            [self.folder.frames[name] for name in self.names],
            self.skipped,
            self.settings,
        )
        self.folder.write_about({"complete": complete, **about, **kept, **(drawn or {})})
