# SPDX-License-Identifier: Apache-2.0
"""Keyframes with a few features and no image, and what must hold in every map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame
from slamdepth.typing import Floats, Ints

CAMERA = Camera(4, 3, 5, 5, 1.5, 1.0)
FRAME = Frame(0, 0.0, np.zeros((3, 4, 3), np.uint8), CAMERA)


@dataclass
class FakeFeatures:
    descriptors: NDArray[np.uint8]
    octave: Ints


def ids_of(*values: int) -> Ints:
    return np.array(values, dtype=np.int64)


def add_keyframe(
    map_: Map, count: int = 8, T_camera_world: Floats | None = None, ids: Ints | None = None
) -> MapKeyframe:
    """A keyframe with ``count`` features, which sees no landmark unless ``ids (count,)`` say so."""
    rng = np.random.default_rng(len(map_.keyframes))
    return map_.add_keyframe(
        FRAME,
        FakeFeatures(rng.integers(0, 256, (count, 32), dtype=np.uint8), rng.integers(0, 8, count)),
        np.eye(4) if T_camera_world is None else T_camera_world,
        np.full(count, -1, dtype=np.int64) if ids is None else ids,
    )


def create(map_: Map, keyframe: MapKeyframe, features: Sequence[int]) -> Ints:
    """Landmarks in front of the origin at some features of a keyframe."""
    n = len(features)
    position_w = np.random.default_rng(map_.size).normal((0, 0, 5), size=(n, 3))
    return map_.create_landmarks(
        keyframe, np.array(features, dtype=np.int64), position_w, np.tile(np.eye(3), (n, 1, 1))
    )


def see(map_: Map, keyframe: MapKeyframe, feature: int, id_: int) -> None:
    """Let one feature see one landmark."""
    map_.observe(keyframe, ids_of(feature), ids_of(id_))


def flat_depth(*, is_sensor: bool = False) -> DepthPrediction:
    """Two metres everywhere."""
    return DepthPrediction(np.full((3, 4), 2.0, np.float32), DepthKind.METRIC, None, is_sensor=is_sensor)


def counted_observations(map_: Map) -> Ints:
    counts = np.zeros(map_.size, dtype=np.int64)
    for keyframe in map_.keyframes:
        np.add.at(counts, keyframe.landmark_ids[keyframe.landmark_ids >= 0], 1)
    return counts


def check(map_: Map) -> None:
    """What must hold after every operation."""
    alive = map_.landmarks.alive
    assert len(alive) == map_.size
    counts = counted_observations(map_)
    np.testing.assert_array_equal(map_.landmarks.observations[alive], counts[alive])
    assert (counts[~alive] == 0).all(), "a keyframe sees a landmark that is gone"
    assert (counts[alive] > 0).all(), "no keyframe sees a living landmark"
    for keyframe in map_.keyframes:
        seen = keyframe.landmark_ids[keyframe.landmark_ids >= 0]
        assert len(np.unique(seen)) == len(seen), "a keyframe sees a landmark twice"
    ids = np.arange(map_.size)
    resolved = map_.resolve(ids)
    np.testing.assert_array_equal(resolved[alive], ids[alive])
    known = resolved[resolved >= 0]
    assert alive[known].all()
    assert not map_._own.alive[map_.size :].any()
