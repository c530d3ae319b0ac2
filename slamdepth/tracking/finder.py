# SPDX-License-Identifier: Apache-2.0
"""Every way to find out where a frame is, the cheapest first."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.landmarks import LandmarkMap
from slamdepth.tracking.depth_thread import DepthThread
from slamdepth.tracking.keyframes import Moved
from slamdepth.tracking.localiser import Localiser, Placement
from slamdepth.tracking.motion import Motion
from slamdepth.tracking.rescue import CloudRescue
from slamdepth.tracking.retry import Retry
from slamdepth.types import DepthPrediction, Frame, TrackingStatus
from slamdepth.typing import Floats

log = logging.getLogger(__name__)

_RELOCALISATION_CANDIDATES = 4


class Finder:
    """Places frames: by the motion, by the last keyframe, by places that look alike, by their depth.

    Args:
        join: lets waiting keyframes have their depth and ``motion`` follow; None where none waits.
        depth_of: a frame's depth, waited for.

    Attributes:
        relocalisations, rescues: frames placed by places that look alike, and by their depth.
    """

    def __init__(
        self,
        config: Config,
        landmarks: LandmarkMap,
        localiser: Localiser,
        places: PlaceRecogniser,
        rescue: CloudRescue,
        depth: DepthThread,
        motion: Motion,
        join: Callable[[], Moved | None],
        depth_of: Callable[[Frame], DepthPrediction],
    ) -> None:
        self._config = config
        self._map = landmarks
        self._localiser = localiser
        self._places = places
        self._rescue = rescue
        self._depth = depth
        self._motion = motion
        self._join = join
        self._depth_of = depth_of
        self._retry = Retry()
        self.relocalisations = 0
        self.rescues = 0

    def place(self, frame: Frame, features: Features) -> tuple[Placement | None, TrackingStatus]:
        """Where ``frame`` is, and how that was found out; None where nothing says it.

        A lost camera's motion is forgotten; where it led to last is tried again for some frames. Forgotten is
        also the motion of a camera found by what it sees alone: the recording may have been cut.
        """
        placement, status = self._try(frame, features)
        if placement is None:
            if self._motion.last is not None:
                self._retry.start(self._motion.last.T_camera_world, self._motion.step)
            self._motion.last = None
        return placement, status

    def _try(self, frame: Frame, features: Features) -> tuple[Placement | None, TrackingStatus]:
        if self._motion.last is None:
            self._retry.count_frame()
        else:
            T_guess = self._motion.guess(frame.timestamp_s)
            rows = self._map.resolve(self._motion.last.point_ids)
            placement = self._localiser.track(features, T_guess, np.unique(rows[rows >= 0]))
            if placement is not None:
                return placement, TrackingStatus.TRACKING
            if self._join() is not None:
                return self._try(frame, features)
            placement = self._localiser.from_keyframe(features, len(self._map.keyframes) - 1)
            if placement is not None:
                self._motion.last = None
                return placement, TrackingStatus.TRACKING
        placement = self._relocalise(features)
        if placement is not None:
            self.relocalisations += 1
            self._motion.last = None
            return placement, TrackingStatus.RELOCALISED
        placement = self._rescued(frame, features)
        return placement, TrackingStatus.LOST if placement is None else TrackingStatus.REGISTERED

    def _relocalise(self, features: Features) -> Placement | None:
        answers = self._places.query(features.place_descriptors, top_k=_RELOCALISATION_CANDIDATES)
        newest = len(self._map.keyframes) - 1
        tried = newest if self._motion.last is not None else -1
        for k in dict.fromkeys([newest, *(k for k, _ in answers)]):
            if k == tried:
                continue
            placement = self._localiser.from_keyframe(
                features, k, minimum=self._config.loops.min_inliers if k != newest else None, is_lost=True
            )
            if placement is not None:
                return placement
        return None

    def _rescued(self, frame: Frame, features: Features) -> Placement | None:
        """By registration of its depth: last, as the clouds of two places fit sooner than their features.

        Not by what a network makes up of an image that shows nothing.
        """
        is_blank = len(features) < self._config.tracking.min_inliers
        if is_blank and not self._depth.is_instant(frame):
            return None
        if self._motion.last is not None:
            return self._register(frame, features, self._motion.guess(frame.timestamp_s))
        if not self._retry.is_due(
            has_depth=self._depth.has_depth(frame),
            is_instant=self._depth.is_instant(frame),
        ):
            return None
        return self._register(frame, features, self._retry.guess(), is_old=True)

    def _register(
        self, frame: Frame, features: Features, T_guess: Floats, *, is_old: bool = False
    ) -> Placement | None:
        if not self._depth.has_depth(frame):
            return None
        T = self._rescue.place(self._depth_of(frame), T_guess, is_old=is_old)
        if T is None:
            return None
        self.rescues += 1
        log.info("frame %d: too few features match; placed by registration of its depth", frame.index)
        empty = Placement(T, np.full(len(features), -1, dtype=np.int64))
        recent = self._map.points_of(
            [k.id for k in self._map.keyframes[-self._config.tracking.local_keyframes :]]
        )
        return self._localiser.attach(features, empty, recent)
