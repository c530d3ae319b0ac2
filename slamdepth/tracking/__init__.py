# SPDX-License-Identifier: Apache-2.0
"""Composition of front end, back end and map into one tracker."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.tracking.cloud_tracker import CloudTracker
from slamdepth.tracking.snapshot import MapSnapshot, Watched
from slamdepth.tracking.tracker import Tracker
from slamdepth.types import Camera

__all__ = ["CloudTracker", "MapSnapshot", "Tracker", "Watched", "create_tracker"]


def create_tracker(
    camera: Camera, depth_model: DepthModel | None = None, config: Config | None = None
) -> Tracker | CloudTracker:
    """The tracker that ``config.odometry`` names; arguments as for :class:`Tracker`."""
    config = config or Config()
    kind = CloudTracker if config.odometry == "kiss-icp" else Tracker
    return kind(camera, depth_model, config)
