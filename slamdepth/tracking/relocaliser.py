# SPDX-License-Identifier: Apache-2.0
"""Place a frame that the motion model and the last keyframe did not place.

First by keyframes that look alike, then by registering the frame's depth with that of the last keyframes
(KISS-ICP): clouds of two places fit sooner than hundreds of their features. Where places look alike hundreds
of features fit the wrong one, too: a place counts only if the frame fits no other one within the camera's
reach.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.frontend.registration import RegistrationConfig, depth_to_cloud, register_cloud
from slamdepth.geometry import invert, project, se3_exp, se3_log, transform
from slamdepth.io.tree import Tree
from slamdepth.loops.look_alikes import Place, Reach, View, distance_seen_m, fits, fits_elsewhere
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.workers import DepthWorker
from slamdepth.types import Camera, DepthPrediction, Frame
from slamdepth.typing import Floats, Floats32

log = logging.getLogger(__name__)

_CANDIDATES = 4
_OTHERS = 2  # maps that are asked whether a frame fits them, too
_RECENT = 3
_CLOUD_KEYFRAMES = 4
_CLOUD_COLUMNS = 80  # points across a cloud, whatever the image's size
# A camera lost for a while has an old guess. Of 1,000 registrations over 0.3 to 3 s of two real sequences,
# with a sensor's and a network's depth, the usual bounds trust 148, 12 of them off by more than 0.1 m or
# 0.1 rad; these trust 91 and err in one, by 0.103 rad.
_OLD_GUESS = RegistrationConfig(min_fitness=0.8, min_observability=0.08)
_MAX_SEEN_THROUGH = 0.1
_NEARER = 0.9  # of the measured depth: a landmark nearer than that would be in the way
_SCHEDULE_FRAMES = 120  # four seconds at 30 Hz: after that the camera may be anywhere
_EVERY, _EVERY_PREDICTED = 3, 6
_VELOCITY_DECAY = 0.5  # with every frame: how the motion went on is unknown
_FASTEST_M_S2 = 9.8  # a hand or a vehicle does not accelerate by more than that for long


class Relocaliser:
    """Finds the place of frames without a guess, or with an old one; changes neither map nor motion.

    Attributes:
        schedule: when a lost camera's depth is registered.
        others: the other maps of the run: a frame that fits one of them, too, has no place.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        map_: MapView,
        localiser: Localiser,
        places: PlaceRecogniser,
        depth: DepthWorker,
    ) -> None:
        self._config = config
        self._map = map_
        self._localiser = localiser
        self._places = places
        self._depth = depth
        self._clouds = _CloudRegistration(camera, config, map_)
        self._frame_s = 1.0 / camera.fps
        self.others: Callable[[], Sequence[Place]] = tuple
        self.schedule = RegistrationSchedule()

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {"schedule": self.schedule.state(), "clouds": self._clouds.state()}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self.schedule.restore(state["schedule"])
        self._clouds.restore(state["clouds"])

    def by_place(
        self, features: Features, *, without: int | None = None, reach: Reach | None = None
    ) -> Placement | None:
        """Place a frame by the newest keyframe or by those that look like it.

        Args:
            without: keyframe that was tried before.
            reach: where the camera can have got to; None where that is not known.

        Returns:
            None also where the frame, or the keyframe it is placed by, fits another place within reach.
        """
        words = self._places.describe(features.place_descriptors)
        answers = self._places.query_vector(words, top_k=_CANDIDATES)
        newest = len(self._map.keyframes) - 1
        for k in dict.fromkeys([newest, *(k for k, _ in answers)]):
            if k == without:
                continue
            minimum = None if k == newest else self._config.loops.min_inliers
            placement = self._localiser.from_keyframe(features, k, minimum=minimum, is_lost=True)
            if placement is not None:
                return self._unique(features, words, placement, k, reach)
        return None

    def by_recent(self, features: Features, *, is_lost: bool, reach: Reach | None = None) -> Placement | None:
        """Place a frame by one of the newest keyframes or by those that look like it.

        Args:
            is_lost: no motion leads from the frame before to this one.
            reach: see :meth:`by_place`.
        """
        newest = len(self._map.keyframes) - 1
        for k in range(newest, max(newest - _RECENT, -1), -1):
            placement = self._localiser.from_keyframe(
                features, k, minimum=self._config.loops.min_inliers, is_lost=is_lost or k < newest
            )
            if placement is not None:
                if not is_lost:
                    return replace(placement, placed_by=PlacedBy.LAST_KEYFRAME)
                words = self._places.describe(features.place_descriptors)
                return self._unique(features, words, placement, k, reach)
        return self.by_place(features, without=newest, reach=reach)

    def _unique(
        self, features: Features, words: Floats32, placement: Placement, k: int, reach: Reach | None
    ) -> Placement | None:
        """The placement by keyframe ``k``; None where it is one of several that look alike."""
        if reach is not None and not reach.includes(placement.T_camera_world):
            reach = None  # the recording was cut: the camera may be anywhere
        keyframe = self._map.keyframes[k]
        views = (
            View(features, words, placement.T_camera_world, placement.landmark_ids),
            View.of(keyframe, self._places.vector(k)),
        )
        distance_m = distance_seen_m(self._map, placement.T_camera_world, placement.landmark_ids)
        fewest = self._config.loops.min_inliers
        is_near = reach is not None and reach.radius_m < distance_m
        others = [] if is_near else sorted(self.others(), key=lambda map_: -map_.places.best_score(words))
        if any(fits_elsewhere(view, self, distance_m, fewest, reach=reach) for view in views) or any(
            fits(views[0], map_, fewest) for map_ in others[:_OTHERS]
        ):
            log.debug("a frame that was lost fits keyframe %d, and other places as well", k)
            return None
        return replace(placement, placed_by=PlacedBy.PLACE)

    @property
    def map(self) -> MapView:
        """The map that frames are placed in."""
        return self._map

    @property
    def places(self) -> PlaceRecogniser:
        """Index of its keyframes by what they look like."""
        return self._places

    def place_view(self, features: Features, candidate: int) -> Placement | None:
        """Place an image by matching its features with the keyframe ``candidate``."""
        return self._localiser.from_keyframe(features, candidate, is_lost=True)

    def reach(self, T_last: Floats | None, step: Floats) -> Reach | None:
        """Where the camera can have got to since it was placed last; None where it never was.

        Args:
            T_last: ``(4, 4)`` camera from world a frame ago; None while the camera is lost.
            step: ``(4, 4)`` the last step, see :class:`MotionModel`.
        """
        if T_last is not None:
            return _reach(T_last, step, 1, self._frame_s)
        return self.schedule.reach(self._frame_s)

    def by_registration(self, frame: Frame, features: Features, T_guess: Floats | None) -> Placement | None:
        """Place a frame by registering its depth.

        An image without features is not registered by a network's depth, which is made up there.

        Args:
            T_guess: ``(4, 4)`` camera from world by the motion model; None while the camera is lost:
                then it is tried when :attr:`schedule` says so.
        """
        is_blank = len(features) < self._config.tracking.min_inliers
        if is_blank and not self._depth.is_instant(frame):
            return None
        has_depth = self._depth.has_depth(frame)
        is_old = T_guess is None
        if T_guess is None:
            if not self.schedule.is_due(has_depth=has_depth, is_instant=self._depth.is_instant(frame)):
                return None
            T_guess = self.schedule.guess()
        if not has_depth:
            return None
        T_camera_world = self._clouds.register(self._depth.take(frame), T_guess, is_old=is_old)
        if T_camera_world is None:
            return None
        log.info("frame %d: too few features match; placed by registration of its depth", frame.index)
        last = self._map.keyframes[-self._config.tracking.local_keyframes :]
        recent = self._map.seen_from([keyframe.id for keyframe in last])
        placement = self._localiser.attach(features, T_camera_world, recent)
        return replace(placement, placed_by=PlacedBy.REGISTRATION)


class RegistrationSchedule:
    """When a lost camera's depth is registered, and from which guess.

    Frames are counted, never milliseconds: a sequence is tried at the same frames on every
    machine. A network's depth costs several frames' time, a sensor's hardly any.
    """

    def __init__(self) -> None:
        self._T_camera_world: Floats | None = None
        self._step = np.eye(4)
        self._lost = 0
        self._tried = 0  # the lost frame tried last

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {
            "T_camera_world": self._T_camera_world,
            "step": self._step,
            "lost": self._lost,
            "tried": self._tried,
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        T = state["T_camera_world"]
        self._T_camera_world = None if T is None else np.array(T)
        self._step = np.array(state["step"])
        self._lost, self._tried = state["lost"], state["tried"]

    def start(self, T_camera_world: Floats, step: Floats) -> None:
        """The camera was lost at this frame; a frame ago it was at ``T_camera_world`` after ``step``.

        Args:
            T_camera_world, step: ``(4, 4)`` each, see :class:`MotionModel`.
        """
        self._T_camera_world = T_camera_world
        self._step = step
        self._lost, self._tried = 1, 1

    def count_frame(self) -> None:
        """Count a frame of a lost camera."""
        self._lost += 1

    def is_due(self, *, has_depth: bool, is_instant: bool) -> bool:
        """Whether to register this lost frame, which then counts as tried.

        Args:
            has_depth: there is a depth to register.
            is_instant: the depth costs nothing, as a sensor's.
        """
        if not has_depth or self._T_camera_world is None or self._lost > _SCHEDULE_FRAMES:
            return False
        every = _EVERY if is_instant else _EVERY_PREDICTED
        if self._lost < self._tried + every:
            return False
        self._tried = self._lost
        return True

    def guess(self) -> Floats:
        """``T_camera_world (4, 4)`` now, had the motion decayed since the camera was lost."""
        assert self._T_camera_world is not None
        steps = sum(_VELOCITY_DECAY**n for n in range(self._lost))
        return se3_exp(se3_log(self._step) * steps) @ self._T_camera_world

    def reach(self, frame_s: float) -> Reach | None:
        """Where the camera can have got to since it was lost; None where it never was.

        Args:
            frame_s: seconds from frame to frame.
        """
        if self._T_camera_world is None:
            return None
        return _reach(self._T_camera_world, self._step, self._lost, frame_s)


def _reach(T_last: Floats, step: Floats, frames: int, frame_s: float) -> Reach:
    """Where a camera can be so many ``frames`` after ``T_last``, where it moved by ``step``."""
    duration_s = frames * frame_s
    radius_m = frames * float(np.linalg.norm(step[:3, 3])) + 0.5 * _FASTEST_M_S2 * duration_s**2
    return Reach(invert(T_last)[:3, 3], radius_m)


class _CloudRegistration:
    """Registers a frame's depth cloud with those of the last keyframes."""

    def __init__(self, camera: Camera, config: Config, map_: MapView) -> None:
        self._camera = camera
        self._config = config
        self._map = map_
        self._clouds: dict[int, Floats] = {}

    def state(self) -> Tree:
        """The clouds that are cached: they keep the scale that their keyframes had."""
        return {str(k): cloud for k, cloud in self._clouds.items()}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self._clouds = {int(k): np.array(cloud) for k, cloud in state.items()}

    def register(
        self, prediction: DepthPrediction, T_camera_world_guess: Floats, *, is_old: bool
    ) -> Floats | None:
        """``T_camera_world (4, 4)`` of a frame from its depth; None where it cannot be trusted.

        Args:
            is_old: the guess is not of the frame before, so the result has to fit better, and
                the frame must not see through what the map holds.
        """
        scale = 1.0 if prediction.is_sensor else self._map.keyframes[-1].scale
        depth_m = prediction.values * np.float32(scale)
        cloud_c = self._cloud(depth_m)
        recent = [k for k in self._map.keyframes[-_CLOUD_KEYFRAMES:] if _has_depth(k)]
        map_w = np.concatenate([np.zeros((0, 3)), *(self._keyframe_cloud_w(k) for k in recent)])
        if len(cloud_c) < 200 or len(map_w) < 200:
            return None
        config = _OLD_GUESS if is_old else None
        result = register_cloud(map_w, cloud_c, invert(T_camera_world_guess), config)
        T_camera_world = invert(result.T_world_camera)
        if not result.is_trusted or (
            is_old and self._seen_through(depth_m, transform(T_camera_world, map_w)) > _MAX_SEEN_THROUGH
        ):
            return None
        return T_camera_world

    def _seen_through(self, depth_m: Floats32, map_c: Floats) -> float:
        """Share of the map's points in view ``(M, 3)`` behind which the frame measured something."""
        px, z = project(self._camera.without_distortion(), map_c)
        limit = np.array([self._camera.width - 1, self._camera.height - 1])
        seen = np.flatnonzero((z > self._config.depth.min_m) & ((px >= 0) & (px <= limit)).all(axis=1))
        column, row = np.rint(px[seen]).astype(np.int64).T
        measured_m = depth_m[row, column]
        known = measured_m > 0
        return float(np.mean(z[seen][known] < _NEARER * measured_m[known])) if known.any() else 1.0

    def _cloud(self, depth_m: Floats32) -> Floats:
        return depth_to_cloud(
            depth_m,
            self._camera,
            stride=max(1, round(self._camera.width / _CLOUD_COLUMNS)),
            min_m=self._config.depth.min_m,
            max_m=min(self._config.depth.max_m, 5.0),
            max_jump=0.05,
        )

    def _keyframe_cloud_w(self, keyframe: MapKeyframe) -> Floats:
        if keyframe.id not in self._clouds:
            assert keyframe.prediction is not None
            scale = 1.0 if keyframe.prediction.is_sensor else keyframe.scale
            self._clouds[keyframe.id] = self._cloud(keyframe.prediction.load().values * np.float32(scale))
            for old in [k for k in self._clouds if k <= keyframe.id - 2 * _CLOUD_KEYFRAMES]:
                del self._clouds[old]
        return transform(keyframe.T_world_camera, self._clouds[keyframe.id])


def _has_depth(keyframe: MapKeyframe) -> bool:
    """Whether the depth of a keyframe can be read; that of a saved map may not have been kept."""
    assert keyframe.prediction is not None
    return keyframe.prediction.is_kept
