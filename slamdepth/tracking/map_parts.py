# SPDX-License-Identifier: Apache-2.0
"""The parts of one map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from slamdepth.config import Config
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.io.tree import Tree
from slamdepth.mapping.keyframe_store import StoredFrame
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.integration import KeyframeIntegration
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.map_arrays import (
    keyframe_arrays,
    keyframe_states,
    landmark_arrays,
    landmarks_of,
    metric_of,
    metric_state,
)
from slamdepth.tracking.motion import MotionModel
from slamdepth.tracking.past_frames import PastFrames
from slamdepth.tracking.pose_check import PoseCheck
from slamdepth.tracking.relocaliser import Relocaliser
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import Workers
from slamdepth.types import Camera, DepthPrediction, Frame
from slamdepth.typing import Floats


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


@dataclass(frozen=True)
class StoredKeyframes:
    """Reads images and predictions of keyframes that an earlier process made.

    Attributes:
        read_frame: reads a frame of the sequence by its index.
        read_prediction: reads the prediction that was made for a frame.
        images: JPEGs of the map that the run goes on from, by recording and frame.
    """

    read_frame: Callable[[int], Frame]
    read_prediction: Callable[[StoredFrame], DepthPrediction]
    images: Mapping[tuple[int, int], bytes] = field(default_factory=dict)


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
        aligner: aligns what placed frames see in the map's images; None leaves it as it was detected.
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
        self.aligner: Callable[[Frame, Features, Placement], Features] | None = None

    def state(self) -> Tree:
        """Everything the map and its parts remember, for a checkpoint; no keyframe is between stages."""
        map_ = self.map
        integration = self.integration.state()  # first: it waits for threads that add to other parts
        return {
            "id": self.id,
            "is_loaded": self.is_loaded,
            "placed_by": {placed_by.name: count for placed_by, count in self.placed_by.items()},
            "metric": metric_state(map_.keyframes[0].features.metric),
            "keyframes": keyframe_arrays(map_.keyframes),
            "landmarks": landmark_arrays(map_.landmarks),
            "map": {
                "starts": sorted(map_.starts),
                "session": map_.session,
                "compact_at": map_.compact_at,
                "stored": map_.stored,
            },
            "past": self.past.arrays(),
            "frames": self.frames.state(),
            "motion": self.motion.state(),
            "shutter": self.shutter.state(),
            "check": self.check.state(),
            "view_change": self.view_change.state(),
            "integration": integration,
            "relocaliser": self.relocaliser.state(),
        }

    def restore(self, state: Tree, stored: StoredKeyframes) -> None:
        """Fill an empty map with what :meth:`state` gave.

        Args:
            stored: reads images and predictions.
        """
        session = state["map"]["session"]
        sessions = state["keyframes"]["session"]

        def read(number: int, frame: StoredFrame) -> Callable[[], DepthPrediction] | None:
            return partial(stored.read_prediction, frame) if sessions[number] == session else None

        waiting = {one["keyframe"] for one in state["integration"]["waiting"]}

        def frame_of(number: int, index: int, timestamp_s: float, gravity: Floats | None) -> StoredFrame:
            if number in waiting:
                return StoredFrame(stored.read_frame(index))
            if sessions[number] == session:
                reader = partial(stored.read_frame, index)
                return StoredFrame.of_saved(index, timestamp_s, self._run.camera, gravity, reader)
            jpeg = stored.images.get((int(sessions[number]), index))
            return StoredFrame.of_saved(index, timestamp_s, self._run.camera, gravity, jpeg=jpeg)

        states = keyframe_states(state["keyframes"], metric_of(state["metric"]), frame_of, read)
        about = state["map"]
        self.map.restore(
            states,
            landmarks_of(state["landmarks"]),
            about["starts"],
            about["compact_at"],
            about["stored"],
        )
        self.map.session = session
        keyframes = self.map.keyframes
        self.id, self.is_loaded = state["id"], state["is_loaded"]
        self.placed_by = Counter({PlacedBy[name]: count for name, count in state["placed_by"].items()})
        self.past.restore(state["past"], keyframes)
        self.frames.restore(state["frames"])
        self.motion.restore(state["motion"], keyframes)
        self.shutter.restore(state["shutter"])
        self.check.restore(state["check"])
        self.view_change.restore(state["view_change"])
        self.integration.restore(state["integration"])
        self.relocaliser.restore(state["relocaliser"])
