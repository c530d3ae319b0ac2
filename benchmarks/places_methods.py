# SPDX-License-Identifier: Apache-2.0
"""Methods of place recognition: which earlier frame shows the place of a query."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from benchmarks.places_scores import Answers
from slamdepth.config import Config
from slamdepth.depth.alignment import log_depth_at
from slamdepth.frontend.features import Features, create_extractor
from slamdepth.geometry import backproject, invert, transform
from slamdepth.loops.closer import LoopCloser
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.map import Map
from slamdepth.tracking.local_mapper import ray_covariance
from slamdepth.tracking.localiser import Localiser
from slamdepth.types import Camera, DepthPrediction, Frame
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray


TAPS = (8, 11)


@dataclass(frozen=True)
class Place:
    """A frame with what the methods compare.

    Attributes:
        T_world_camera: ``(4, 4)`` true pose; only :func:`verified` uses it, for its map.
        means, classes: mean patch token and class token ``(384,)`` after each of ``TAPS``; empty where
            there is no backbone.
    """

    frame: Frame
    features: Features
    depth: DepthPrediction
    T_world_camera: NDArray[np.float64]
    means: tuple[Floats32, ...] = ()
    classes: tuple[Floats32, ...] = ()


Answer = Callable[[int, Sequence[int]], Answers]
"""Ranks the earlier frames for a query."""


def features_of(frame: Frame, config: Config) -> Features:
    """The features that the tracker would extract."""
    gray = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
    return create_extractor(config.features).extract(np.asarray(gray, dtype=np.uint8), frame.camera)


def ask(answer: Answer, earlier: Mapping[int, Sequence[int]]) -> tuple[dict[int, Answers], float]:
    """The answers to all queries, and the mean CPU milliseconds of one."""
    start_s = time.process_time()
    answers = {q: answer(q, frames) for q, frames in earlier.items()}
    return answers, 1e3 * (time.process_time() - start_s) / max(1, len(answers))


def bag_of_words(places: Sequence[Place], *, top_k: int | None = None) -> Answer:
    """The tracker's own recogniser: tf-idf over binary visual words."""
    bag = PlaceRecogniser()
    for k, place in enumerate(places):
        bag.add(k, place.features.descriptors)

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        later = set(range(len(places))) - set(earlier)
        descriptors = places[query].features.descriptors
        return bag.query(descriptors, exclude=later, top_k=top_k or len(places))

    return answer


def vectors(descriptors: Sequence[Floats32]) -> Answer:
    """Cosine similarity of one vector per image."""
    table = np.stack([d / np.linalg.norm(d) for d in descriptors])

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        frames = np.asarray(earlier, dtype=np.int64)
        return ranked(frames, table[frames] @ table[query])

    return answer


def ranked(frames: NDArray[np.int64], scores: NDArray[np.floating]) -> Answers:
    """Frames and scores, best first; equal scores in the order of the frames."""
    order = np.lexsort((frames, -scores))
    return [(int(frames[i]), float(scores[i])) for i in order]


def verified(places: Sequence[Place], camera: Camera, config: Config, min_gap: int) -> Answer:
    """The tracker's loop candidates that pass its verification by matching and PnP.

    The score is the number of inliers. Every frame is a keyframe at its true pose with the landmarks of its
    own depth; in a tracker's map it shares landmarks with its neighbours, so recall here is a lower bound.
    """
    map_ = Map()
    config = config.model_copy(update={"loops": config.loops.model_copy(update={"min_gap": min_gap})})
    closer = LoopCloser(camera, config, map_, Localiser(camera, config, map_))
    for k, place in enumerate(places):
        _add_keyframe(map_, camera, config, place)
        closer.places.add_vector(k, closer.describe(place.features))

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        keyframe = map_.keyframes[query]
        allowed = set(earlier)
        found = []
        for k in closer.candidates(keyframe, closer.drift())[0]:
            placed = closer.verify(keyframe, k) if k in allowed else None
            if placed is not None:
                found.append((k, float(placed[0].inliers)))
        return found

    return answer


def _add_keyframe(map_: Map, camera: Camera, config: Config, place: Place) -> None:
    features = place.features
    log_depth, sigma_log = log_depth_at(place.depth, features.raw_px)
    created = np.flatnonzero(
        (log_depth > np.log(config.depth.min_m))
        & (log_depth < np.log(config.depth.max_m))
        & (sigma_log < config.depth.max_sigma_log)
    )
    keyframe = map_.add_keyframe(
        place.frame,
        features,
        invert(place.T_world_camera),
        np.full(len(features), -1, dtype=np.int64),
    )
    map_.set_depth(keyframe, place.depth, log_depth, sigma_log)
    pinhole = camera.without_distortion()
    position_c = backproject(pinhole, features.px[created], np.exp(log_depth[created]))
    covariance_c = ray_covariance(
        pinhole, features.px[created], position_c, sigma_log[created], features.sigma_px[created]
    )
    R = place.T_world_camera[:3, :3]
    position_w = transform(place.T_world_camera, position_c)
    map_.create_landmarks(keyframe, created, position_w, R @ covariance_c @ R.T)
