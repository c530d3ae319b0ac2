# SPDX-License-Identifier: Apache-2.0
"""Composition of front end, back end and map into one tracker."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.errors import ConfigError
from slamdepth.mapstore import Map
from slamdepth.tracking.cloud_tracker import CloudTracker
from slamdepth.tracking.map_localiser import MapLocaliser
from slamdepth.tracking.snapshot import MapSnapshot, Watched
from slamdepth.tracking.tracker import Tracker
from slamdepth.types import Camera

__all__ = ["CloudTracker", "MapLocaliser", "MapSnapshot", "Tracker", "Watched", "create_tracker"]


def create_tracker(
    camera: Camera,
    depth_model: DepthModel | None = None,
    config: Config | None = None,
    *,
    start_map: Map | None = None,
) -> Tracker | CloudTracker:
    """The tracker that ``config.odometry`` names; arguments as for :class:`Tracker`.

    Raises:
        ConfigError: there is a map to go on from, and the odometry makes none.
    """
    config = config or Config()
    if config.odometry != "kiss-icp":
        return Tracker(camera, depth_model, config, start_map=start_map)
    if start_map is not None:
        raise ConfigError("a run with odometry kiss-icp makes no map, and goes on from none")
    return CloudTracker(camera, depth_model, config)
