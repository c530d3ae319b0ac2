# SPDX-License-Identifier: Apache-2.0
"""slamdepth: one camera in, a metric trajectory and a mesh out.

Names are imported when they are first used, so that ``import slamdepth`` costs next to
nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from slamdepth._version import __version__

if TYPE_CHECKING:
    from slamdepth.config import Config
    from slamdepth.datasets import Dataset, ReadOptions, open_dataset
    from slamdepth.dense import DenseEffort, densify
    from slamdepth.depth.base import DepthModel
    from slamdepth.depth.registry import create_depth_model
    from slamdepth.errors import (
        CameraError,
        ConfigError,
        DatasetError,
        ImageDecodeError,
        InputError,
        OutputError,
        SlamdepthError,
        SourceEnded,
        TrackingError,
        WeightsError,
    )
    from slamdepth.evaluation import AbsoluteError, RelativeError, TrajectoryScore, score_trajectory
    from slamdepth.frontend.features import Features, ImageMatcher
    from slamdepth.frontend.metric import DescriptorMetric
    from slamdepth.frontend.preparation import Prepared
    from slamdepth.io import read_tum_trajectory, write_tum_trajectory
    from slamdepth.mapping.cloud import PointCloud
    from slamdepth.mapping.dense_depth import DenseDepth, StoredDenseDepth
    from slamdepth.mapping.keyframe import Keyframe
    from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
    from slamdepth.mapping.mesh import Mesh
    from slamdepth.mapping.reconstruction import Reconstruction
    from slamdepth.mapstore import Map, Session
    from slamdepth.pipeline import RunInterrupted, RunProgress, RunResult, RunStage, Watcher
    from slamdepth.pipeline.export import export_run
    from slamdepth.pipeline.localize import Localisation, localize
    from slamdepth.pipeline.merge import MergeResult, merge
    from slamdepth.pipeline.resume import resume
    from slamdepth.pipeline.run import run
    from slamdepth.tracking import CloudTracker, MapLocaliser, MapSnapshot, Tracker, Watched, create_tracker
    from slamdepth.types import (
        Camera,
        DepthKind,
        DepthPrediction,
        Frame,
        RunStatistics,
        StepResult,
        TrackingStatus,
        Trajectory,
        WeightsInfo,
    )

_HOME = {
    "AbsoluteError": "slamdepth.evaluation",
    "Camera": "slamdepth.types",
    "CameraError": "slamdepth.errors",
    "CloudTracker": "slamdepth.tracking",
    "Config": "slamdepth.config",
    "ConfigError": "slamdepth.errors",
    "Dataset": "slamdepth.datasets",
    "DatasetError": "slamdepth.errors",
    "DenseDepth": "slamdepth.mapping.dense_depth",
    "DenseEffort": "slamdepth.dense",
    "DepthKind": "slamdepth.types",
    "DescriptorMetric": "slamdepth.frontend.metric",
    "DepthModel": "slamdepth.depth.base",
    "DepthPrediction": "slamdepth.types",
    "Features": "slamdepth.frontend.features",
    "Frame": "slamdepth.types",
    "ImageDecodeError": "slamdepth.errors",
    "ImageMatcher": "slamdepth.frontend.features",
    "InputError": "slamdepth.errors",
    "Keyframe": "slamdepth.mapping.keyframe",
    "Localisation": "slamdepth.pipeline.localize",
    "Map": "slamdepth.mapstore",
    "MapLocaliser": "slamdepth.tracking",
    "MergeResult": "slamdepth.pipeline.merge",
    "MapSnapshot": "slamdepth.tracking",
    "Mesh": "slamdepth.mapping.mesh",
    "OutputError": "slamdepth.errors",
    "PointCloud": "slamdepth.mapping.cloud",
    "Prepared": "slamdepth.frontend.preparation",
    "ReadOptions": "slamdepth.datasets",
    "Reconstruction": "slamdepth.mapping.reconstruction",
    "RelativeError": "slamdepth.evaluation",
    "RunInterrupted": "slamdepth.pipeline",
    "RunProgress": "slamdepth.pipeline",
    "RunResult": "slamdepth.pipeline",
    "RunStage": "slamdepth.pipeline",
    "RunStatistics": "slamdepth.types",
    "Session": "slamdepth.mapstore",
    "SlamdepthError": "slamdepth.errors",
    "SourceEnded": "slamdepth.errors",
    "StepResult": "slamdepth.types",
    "StoredDenseDepth": "slamdepth.mapping.dense_depth",
    "StoredFrame": "slamdepth.mapping.keyframe_store",
    "StoredPrediction": "slamdepth.mapping.keyframe_store",
    "Tracker": "slamdepth.tracking",
    "TrackingError": "slamdepth.errors",
    "TrackingStatus": "slamdepth.types",
    "Trajectory": "slamdepth.types",
    "TrajectoryScore": "slamdepth.evaluation",
    "Watched": "slamdepth.tracking",
    "Watcher": "slamdepth.pipeline",
    "WeightsError": "slamdepth.errors",
    "WeightsInfo": "slamdepth.types",
    "create_depth_model": "slamdepth.depth.registry",
    "create_tracker": "slamdepth.tracking",
    "densify": "slamdepth.dense",
    "export_run": "slamdepth.pipeline.export",
    "localize": "slamdepth.pipeline.localize",
    "merge": "slamdepth.pipeline.merge",
    "open_dataset": "slamdepth.datasets",
    "read_tum_trajectory": "slamdepth.io",
    "resume": "slamdepth.pipeline.resume",
    "run": "slamdepth.pipeline.run",
    "score_trajectory": "slamdepth.evaluation",
    "write_tum_trajectory": "slamdepth.io",
}

__all__ = [
    "AbsoluteError",
    "Camera",
    "CameraError",
    "CloudTracker",
    "Config",
    "ConfigError",
    "Dataset",
    "DatasetError",
    "DenseDepth",
    "DenseEffort",
    "DepthKind",
    "DepthModel",
    "DepthPrediction",
    "DescriptorMetric",
    "Features",
    "Frame",
    "ImageDecodeError",
    "ImageMatcher",
    "InputError",
    "Keyframe",
    "Localisation",
    "Map",
    "MapLocaliser",
    "MapSnapshot",
    "MergeResult",
    "Mesh",
    "OutputError",
    "PointCloud",
    "Prepared",
    "ReadOptions",
    "Reconstruction",
    "RelativeError",
    "RunInterrupted",
    "RunProgress",
    "RunResult",
    "RunStage",
    "RunStatistics",
    "Session",
    "SlamdepthError",
    "SourceEnded",
    "StepResult",
    "StoredDenseDepth",
    "StoredFrame",
    "StoredPrediction",
    "Tracker",
    "TrackingError",
    "TrackingStatus",
    "Trajectory",
    "TrajectoryScore",
    "Watched",
    "Watcher",
    "WeightsError",
    "WeightsInfo",
    "__version__",
    "create_depth_model",
    "create_tracker",
    "densify",
    "export_run",
    "localize",
    "merge",
    "open_dataset",
    "read_tum_trajectory",
    "resume",
    "run",
    "score_trajectory",
    "write_tum_trajectory",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _be_silent_unless_asked() -> None:
    import logging

    logging.getLogger(__name__).addHandler(logging.NullHandler())


_be_silent_unless_asked()
