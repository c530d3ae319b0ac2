# SPDX-License-Identifier: Apache-2.0
"""Ways to ask which earlier frame shows the same place."""

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
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.local_mapper import ray_covariance
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.loop_closer import LoopCloser
from slamdepth.types import Camera, DepthPrediction, Frame
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray


TAPS = (8, 11)
RERANKED = 10
_SURE = 0.5  # cosine from which two patches may show one thing


@dataclass(frozen=True)
class Place:
    """A frame as the methods see it.

    Attributes:
        T_world_camera: ``(4, 4)`` true pose; only the map for the verification stands on it.
        patches, classes: of each of ``TAPS``, ``(P, 384)`` patch tokens and ``(384,)`` class token,
            unit length; empty where there is no backbone.
    """

    frame: Frame
    features: Features
    depth: DepthPrediction
    T_world_camera: NDArray[np.float64]
    patches: tuple[Floats32, ...] = ()
    classes: tuple[Floats32, ...] = ()


Answer = Callable[[int, Sequence[int]], Answers]
"""Ranks earlier frames for a query."""


def features_of(frame: Frame, config: Config) -> Features:
    gray = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
    return create_extractor(config.features).extract(np.asarray(gray, dtype=np.uint8), frame.camera)


def ask(answer: Answer, earlier: Mapping[int, Sequence[int]]) -> tuple[dict[int, Answers], float]:
    """The answers to all queries, and the CPU milliseconds each took on average."""
    start_s = time.process_time()
    answers = {q: answer(q, frames) for q, frames in earlier.items()}
    return answers, 1e3 * (time.process_time() - start_s) / max(1, len(answers))


def bag_of_words(places: Sequence[Place], *, top_k: int | None = None) -> Answer:
    """What the tracker asks: tf-idf over binary words."""
    bag = PlaceRecogniser()
    for k, place in enumerate(places):
        bag.add(k, place.features.descriptors)

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        later = set(range(len(places))) - set(earlier)
        descriptors = places[query].features.descriptors
        return bag.query(descriptors, exclude=later, top_k=top_k or len(places))

    return answer


def vectors(descriptors: Sequence[Floats32]) -> Answer:
    """Cosine of one vector an image."""
    table = np.stack([d / np.linalg.norm(d) for d in descriptors])

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        frames = np.asarray(earlier, dtype=np.int64)
        return ranked(frames, table[frames] @ table[query])

    return answer


def ranked(frames: NDArray[np.int64], scores: NDArray[np.floating]) -> Answers:
    """Best first; equal scores by frame."""
    order = np.lexsort((frames, -scores))
    return [(int(frames[i]), float(scores[i])) for i in order]


def reranked(places: Sequence[Place], tap: int, first: Answer, *, with_bag: bool) -> Answer:
    """The first answers of ``first``, ordered by how many of their patches are mutual neighbours.

    Args:
        tap: which of ``TAPS``.
        with_bag: order by the product with the first method's score instead.
    """

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        found = first(query, earlier)[:RERANKED]
        mine = places[query].patches[tap]
        shares = [mutual_share(mine, places[k].patches[tap]) for k, _ in found]
        scores = [s * (bag if with_bag else 1.0) for s, (_, bag) in zip(shares, found, strict=True)]
        return ranked(np.array([k for k, _ in found], dtype=np.int64), np.array(scores))

    return answer


def mutual_share(a: Floats32, b: Floats32) -> float:
    """Share of the patches ``(P, D)`` of unit length that are each other's nearest, and near."""
    table = a @ b.T
    best, back = table.argmax(axis=1), table.argmax(axis=0)
    rows = np.arange(len(a))
    return float(np.mean((back[best] == rows) & (table[rows, best] > _SURE)))


def verified(places: Sequence[Place], camera: Camera, config: Config, min_gap: int) -> Answer:
    """What the tracker closes a loop on: its own candidates, matched and placed by its own code.

    The score is the number of points that agree. Every frame is a keyframe at its true pose with
    the points of its own depth; a tracker's map has more, which its neighbours saw too.
    """
    landmarks = LandmarkMap()
    config = config.model_copy(update={"loops": config.loops.model_copy(update={"min_gap": min_gap})})
    closer = LoopCloser(config, landmarks, Localiser(camera, config, landmarks))
    for k, place in enumerate(places):
        _add(landmarks, camera, config, k, place)
        keyframe = landmarks.keyframes[k]
        closer.add(keyframe, closer.describe(keyframe.features))

    def answer(query: int, earlier: Sequence[int]) -> Answers:
        keyframe = landmarks.keyframes[query]
        allowed = set(earlier)
        found = []
        for k in closer.candidates(keyframe):
            placed = closer.verify(keyframe, k) if k in allowed else None
            if placed is not None:
                found.append((k, float(placed[0].inliers)))
        return found

    return answer


def _add(landmarks: LandmarkMap, camera: Camera, config: Config, k: int, place: Place) -> None:
    features = place.features
    log_depth, sigma_log = log_depth_at(place.depth, features.raw_px)
    born = np.flatnonzero(
        (log_depth > np.log(config.depth.min_m))
        & (log_depth < np.log(config.depth.max_m))
        & (sigma_log < config.depth.max_sigma_log)
    )
    keyframe = MapKeyframe(
        id=k,
        frame=place.frame,
        features=features,
        T_camera_world=invert(place.T_world_camera),
        point_ids=np.full(len(features), -1, dtype=np.int64),
        log_depth=log_depth,
        sigma_log=sigma_log,
        prediction=place.depth,
    )
    landmarks.add_keyframe(keyframe)
    pinhole = camera.without_distortion()
    position_c = backproject(pinhole, features.px[born], np.exp(log_depth[born]))
    covariance_c = ray_covariance(
        pinhole, features.px[born], position_c, sigma_log[born], features.sigma_px[born]
    )
    R = place.T_world_camera[:3, :3]
    landmarks.add_points(keyframe, born, transform(place.T_world_camera, position_c), R @ covariance_c @ R.T)
