# SPDX-License-Identifier: Apache-2.0
"""A run before its first frame: everything opened and checked."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.sensor_depth import check_sensor_depth, lack_of_depth
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.metric import configured_model, with_chosen_model
from slamdepth.errors import DatasetError
from slamdepth.mapstore import Map
from slamdepth.mapstore.map import map_folder
from slamdepth.pipeline.camera import OpeningCamera, settle_camera, use_view
from slamdepth.pipeline.checkpoint import Latest, SequenceKeyframes
from slamdepth.pipeline.export import check_exports
from slamdepth.pipeline.folder import (
    RunFolder,
)
from slamdepth.pipeline.options import (
    ProgressCallback,
    RunOptions,
    RunProgress,
    RunStage,
)
from slamdepth.pipeline.prediction_scale import (
    PredictionScale,
    check_scale_options,
    choose_prediction_scale,
)
from slamdepth.pipeline.saved_maps import use_camera_of_map
from slamdepth.pipeline.seeds import seed_everything, seed_torch
from slamdepth.pipeline.tracking import AnyTracker
from slamdepth.tracking import Tracker


@dataclass(frozen=True)
class Begun:
    """A run that was killed.

    Attributes:
        sequence: what is known of its sequence.
        latest: its latest checkpoint; None where there is none.
    """

    sequence: dict[str, Any]
    latest: Latest | None


@dataclass(frozen=True)
class Job:
    """A run whose input is checked; nothing is written yet.

    Attributes:
        indices: which frames of the dataset are tracked.
        about: what tells the sequence from others, see :func:`describe`; None of a live source.
        latest: the checkpoint that the run goes on from.
        camera: how the camera was found.
        model: the depth model as the tracker gets it, scaled where that was asked for.
    """

    options: RunOptions
    config: Config
    dataset: Dataset
    about: dict[str, Any] | None
    indices: range
    folder: RunFolder
    camera: OpeningCamera
    model: DepthModel
    scale: PredictionScale
    tracker: AnyTracker
    start_map: Map | None = None
    latest: Latest | None = None

    @property
    def depth_is_measured(self) -> bool:
        return is_sensor(self.model)


def prepare(
    options: RunOptions,
    config: Config,
    tell: ProgressCallback,
    stop: threading.Event,
    begun: Begun | None,
) -> Job:
    """Open and check everything that a run needs, what costs least first."""
    from slamdepth.tracking import create_tracker

    check_exports(options.exports)
    config = with_chosen_model(config)
    start_map = None if options.start_map is None else Map.load(options.start_map)
    dataset = open_dataset(options.sequence, options.camera_file, options.reading)
    if options.view_deg is not None:
        use_view(dataset, options.view_deg)
    elif start_map is not None:
        use_camera_of_map(dataset, start_map)
    indices = options.indices_of(dataset)
    if dataset.imu_path is not None and config.scale.imu is None:
        dataset.notes.append(f"inertial data is there, for scale and gravity: --imu {dataset.imu_path}")
    about = None if dataset.is_live else describe(dataset)
    check_scale_options(dataset, config, indices)
    if begun is not None and about != begun.sequence:
        raise DatasetError(
            f"{dataset.path}: is not the sequence that the run was tracking; name that one, or start the run "
            "again with --overwrite"
        )
    is_new = begun is None
    folder = RunFolder.plan(options.output, dataset.name, overwrite=options.overwrite or not is_new)
    if is_new:
        needed = [] if options.start_map is None else [map_folder(options.start_map)]
        folder.check_keeps([options.sequence, *needed])
    seed_everything(config.seed)
    given = configured_model(config)
    if is_sensor(given):
        if not dataset.has_depth:
            raise DatasetError(
                f"{dataset.path}: {lack_of_depth(dataset)}; run it with predicted depth: --depth dinov2"
            )
        dataset.notes += check_sensor_depth(dataset, indices)
    camera = settle_camera(dataset, indices, given, config, tell, stop)
    if camera.prior is not None:
        seed_everything(config.seed)
    scale = choose_prediction_scale(
        dataset,
        given,
        config,
        indices,
        progress=lambda done, total: tell(RunProgress(RunStage.SCALING, done, total)),
        stop=stop,
    )
    model = scale.applied_to(given)
    seed_torch(config.seed)
    tracker = create_tracker(dataset.camera, depth_model=model, config=config, start_map=start_map)
    latest = None if begun is None else begun.latest
    if latest is not None and isinstance(tracker, Tracker):
        stored = SequenceKeyframes(dataset, folder.path, latest, with_depth=is_sensor(model))
        tracker.restore(latest.tracker, stored.read_frame, stored.read_prediction)
    return Job(
        options, config, dataset, about, indices, folder, camera, model, scale, tracker, start_map, latest
    )


def describe(dataset: Dataset) -> dict[str, Any]:
    """What tells two sequences apart, as far as it is known without reading their images."""
    times_s = dataset.timestamps_s
    return {
        "frames": len(dataset),
        "first_s": float(times_s[0]),
        "last_s": float(times_s[-1]),
        "size": [dataset.camera.width, dataset.camera.height],
        "K": dataset.camera.K.ravel().tolist(),
    }
