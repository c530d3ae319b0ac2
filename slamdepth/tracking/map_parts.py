# SPDX-License-Identifier: Apache-2.0
"""The parts of one map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from slamdepth.config import Config
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import PlacedBy
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.integration import KeyframeIntegration
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.motion import MotionModel
from slamdepth.tracking.past_frames import PastFrames
from slamdepth.tracking.pose_check import PoseCheck
from slamdepth.tracking.relocaliser import Relocaliser
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import Workers
from slamdepth.types import Camera, Frame


@dataclass(frozen=True)
class RunParts:
    """What the maps of a run share.

    Attributes:
        camera: that took the frames.
        config: settings of the run.
        levels: pyramid levels of the extractor.
        workers: threads, and the depth model.
        watch: measures where the time goes.
        wide_features: finds more features of a frame, for a search over a wide baseline.
        grows_maps: False where frames are placed in a map that must not change.
    """

    camera: Camera
    config: Config
    levels: ScaleLevels
    workers: Workers
    watch: Stopwatch
    wide_features: Callable[[Frame], Features]
    grows_maps: bool = True


class MapParts:
    """A map, and all that belongs to it alone.

    Args:
        id_: number of the map in its run.
        run: what it shares with other maps.

    Attributes:
        id: number of the map, from 0 in the order of their start.
        map, frames, motion, shutter, localiser, check, view_change, integration, relocaliser: the parts.
        placed_by: how many frames were placed by what.
        past: frames of earlier recordings, where the map was loaded.
        is_loaded: the map, or a part of it, is of an earlier recording.
    """

    def __init__(self, id_: int, run: RunParts) -> None:
        camera, config, workers = run.camera, run.config, run.workers
        self.id = id_
        self._run = run
        self.map = Map(config.map.keyframe_memory_mib)
        self.frames = FrameLog(camera, self.map)
        self.motion = MotionModel()
        self.shutter = RollingShutter(camera, config.shutter, self.map)
        self.localiser = Localiser(camera, config, self.map, run.levels)
        self.check = PoseCheck(camera, self.map, self.localiser)
        self.view_change = self.localiser.view_change
        self.integration = KeyframeIntegration(
            camera,
            config,
            self.map,
            self.localiser,
            self.frames,
            self.shutter,
            workers,
            run.watch,
        )
        self.relocaliser = Relocaliser(
            camera,
            config,
            self.map,
            self.localiser,
            self.integration.loops.places,
            workers.depth,
        )
        self.placed_by: Counter[PlacedBy] = Counter()
        self.past = PastFrames()
        self.is_loaded = False
