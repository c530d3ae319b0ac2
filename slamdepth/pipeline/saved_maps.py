# SPDX-License-Identifier: Apache-2.0
"""Maps that runs leave for others to go on from: ``map/`` in the run folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map, Session
from slamdepth.pipeline.folder import MAP, RunFolder
from slamdepth.pipeline.tracking import AnyTracker
from slamdepth.report import ScaleFacts, ScaleSource
from slamdepth.tracking import Tracker
from slamdepth.tracking.saved_maps import same_lens

logger = logging.getLogger(__name__)


def use_camera_of_map(dataset: Dataset, saved: Map) -> None:
    """Give a dataset the camera of a map, where it knows none of its own, and note that.

    Intrinsics that are not given by a file and belong to images of the map's size are likely the map's.
    """
    own, theirs, source = dataset.camera, saved.camera, dataset.camera_source
    if source.certainty is Certainty.GIVEN or (own.width, own.height) != (theirs.width, theirs.height):
        return
    if not same_lens(own, theirs):
        dataset.camera = replace(theirs, fps=own.fps, depth_factor=own.depth_factor)
        note = (
            f"intrinsics are those of the map, since those of the sequence are {source.certainty.value} "
            f"({source.how})"
        )
        dataset.notes.append(note)
        logger.info("%s", note)
    dataset.camera_source = CameraSource(Certainty.GIVEN, "the map's camera")


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
