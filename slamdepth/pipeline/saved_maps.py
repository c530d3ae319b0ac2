# SPDX-License-Identifier: Apache-2.0
"""Maps that runs leave for others to go on from: ``map/`` in the run folder."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty
from slamdepth.datasets.orientation import OF_ROTATION_DEG, turned_camera
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map, Session
from slamdepth.pipeline.folder import MAP, RunFolder
from slamdepth.pipeline.tracking import AnyTracker
from slamdepth.report import ScaleFacts, ScaleSource
from slamdepth.tracking import Tracker
from slamdepth.tracking.saved_maps import same_lens
from slamdepth.types import Camera

logger = logging.getLogger(__name__)

_OTHER_LENS = 3.0
"""Deviations of a focal length that a recording names, from which on it is not the map's."""
_SAME_SHAPE_PX = 1.5


def use_camera_of_map(dataset: Dataset, saved: Map) -> None:
    """Give a dataset the camera of a map, where it knows none of its own, and note that.

    Intrinsics that are not given by a file and belong to images of the map's size are likely the map's; so
    are guessed ones of images of its shape, upright or on their side. A recording that names a focal length
    far from the map's has another lens.
    """
    own, source = dataset.camera, dataset.camera_source
    theirs = camera_at_size(saved.camera, own.width, own.height)
    if source.certainty is Certainty.GIVEN or theirs is None:
        return
    is_same_size = (own.width, own.height) == (saved.camera.width, saved.camera.height)
    if source.certainty is Certainty.NOMINAL:
        if note := other_lens(own, source, theirs):
            _note(dataset, note)
            return
        if not is_same_size:
            return
    if not same_lens(own, theirs):
        dataset.camera = replace(theirs, fps=own.fps, depth_factor=own.depth_factor)
        where = "" if is_same_size else f", at {own.width}x{own.height} pixels"
        _note(
            dataset,
            f"intrinsics are those of the map{where}, since those of the sequence are "
            f"{source.certainty.value} ({source.how})",
        )
    if is_same_size:
        dataset.camera_source = CameraSource(Certainty.GIVEN, "the map's camera")
    else:  # another size may be another part of the sensor
        dataset.camera_source = CameraSource(Certainty.NOMINAL, "the map's camera, at another size")


def other_lens(own: Camera, source: CameraSource, theirs: Camera) -> str | None:
    """What is said where a recording names a focal length far from that of a map's camera; else None.

    Args:
        own: as the recording tells by ``source``.
        theirs: the map's, for images of this size.
    """
    if source.certainty is not Certainty.NOMINAL:
        return None
    if abs(math.log(own.fx / theirs.fx)) <= _OTHER_LENS * source.sigma_log_f:
        return None
    return (
        f"intrinsics are not those of the map, whose focal length would be {theirs.fx:.1f} px: another lens "
        f"took this ({source.how})"
    )


def _note(dataset: Dataset, note: str) -> None:
    dataset.notes.append(note)
    logger.info("%s", note)


def camera_at_size(camera: Camera, width: int, height: int) -> Camera | None:
    """A camera for images of another size, upright or on their side; None where their shape is another.

    On which side is not known, so the principal point is the middle then.
    """
    if _has_shape(camera, width, height):
        same = (camera.width, camera.height) == (width, height)
        return camera if same else camera.scaled(width, height)
    if camera.lens is not None or not _has_shape(camera, height, width):
        return None
    turned = turned_camera(camera.scaled(height, width), OF_ROTATION_DEG[90])
    k1, k2, _, _, *others = turned.distortion
    cx, cy = (width - 1) / 2, (height - 1) / 2
    return replace(turned, cx=cx, cy=cy, distortion=(k1, k2, 0.0, 0.0, *others))


def _has_shape(camera: Camera, width: int, height: int) -> bool:
    """Whether images of a camera resized to a width have a height, but for rounding."""
    return abs(camera.height * width / camera.width - height) <= _SAME_SHAPE_PX


def inherited_scale(facts: ScaleFacts, tracker: AnyTracker, number: int, saved: Map | None) -> ScaleFacts:
    """What is known of the scale of a map: where the run went on from a saved one, what was known of that.

    Args:
        facts: of this run alone.
        number: of the map, 0 for the largest.
    """
    if saved is None or not isinstance(tracker, Tracker) or not tracker.is_of_start_map(number):
        return facts
    if facts.source not in (ScaleSource.NETWORK, ScaleSource.SENSOR):
        return facts  # the run was told a size
    before = saved.scale
    sure = before.get("uncertainty_log")
    return replace(
        facts,
        sentence=f"that of the map it goes on from: {before.get('sentence', 'unknown')}",
        uncertainty_log=sure if isinstance(sure, float) else None,
        is_unknown=bool(before.get("is_unknown", facts.is_unknown)),
        from_ground_truth=bool(before.get("from_ground_truth", facts.from_ground_truth)),
    )


def start_map_notes(tracker: AnyTracker, saved: Map | None, *, with_images: bool) -> tuple[str, ...]:
    """Whether the run met the map that it was to go on from, and whether that map's images are lost.

    Args:
        with_images: the images of the map should be kept.
    """
    if saved is None or not isinstance(tracker, Tracker):
        return ()
    if not tracker.is_in_start_map:
        note = (
            "no frame fits the map that the run was to go on from: the result is a new map with a world "
            "frame and a scale of its own"
        )
    elif with_images and saved.has_images and not same_lens(saved.camera, tracker.camera):
        note = (
            "the images of the map that the run went on from are not in its own map, since the two have "
            "different cameras: give both runs one by --camera FILE"
        )
    else:
        return ()
    logger.warning("%s", note)
    return (note,)


def write_maps(
    folder: RunFolder,
    tracker: AnyTracker,
    session: Session,
    tracked: Sequence[Reconstruction],
    settled: Sequence[Reconstruction],
    scales: Sequence[ScaleFacts],
    *,
    with_images: bool,
) -> None:
    """Write ``map/`` of each map of the run; an odometry without landmarks has none.

    Args:
        tracked: the maps as the tracker returned them, the largest first.
        settled: the same at their final scale.
        scales: what is known of it.

    Raises:
        OutputError: one of them cannot be written.
    """
    if not isinstance(tracker, Tracker):
        return
    for number, (before, after, scale) in enumerate(zip(tracked, settled, scales, strict=True)):
        saved = tracker.saved_map(
            number,
            after,
            session,
            asdict(scale),
            factor=_factor(before, after),
            with_images=with_images,
        )
        saved.save(folder.make_map_folder(number + 1) / MAP)


def _factor(before: Reconstruction, after: Reconstruction) -> float:
    """By which the lengths of a map were multiplied."""
    if not before.keyframes or not after.keyframes:
        was, now = (float(np.abs(one.points_m).sum()) for one in (before, after))
        return now / was if was > 0 else 1.0
    return after.keyframes[0].depth_scale / before.keyframes[0].depth_scale
