# SPDX-License-Identifier: Apache-2.0
"""Only the map writes the map: what it hands out can be read, and follows changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from growing_map import add_keyframe, create, flat_depth, ids_of, see
from numpy.typing import NDArray

from slamdepth.geometry import invert, se3_exp
from slamdepth.mapping.map import Map, MapKeyframe

ATTRIBUTES = tuple(name for name, value in vars(MapKeyframe).items() if isinstance(value, property))


def a_map() -> Map:
    map_ = Map()
    for _ in range(2):
        keyframe = add_keyframe(map_)
        create(map_, keyframe, [0, 1, 2])
        depth = np.linspace(0.0, 1.0, 8)
        map_.set_depth(keyframe, flat_depth(), depth, depth, predicted_log_depth=depth)
    return map_


def arrays(holder: object, names: tuple[str, ...]) -> Iterator[tuple[str, NDArray[Any]]]:
    for name in names:
        value = getattr(holder, name)
        if isinstance(value, np.ndarray):
            yield name, value


def handed_out(map_: Map) -> dict[str, NDArray[Any]]:
    found = dict(arrays(map_.landmarks, tuple(field.name for field in fields(map_.landmarks))))
    found |= dict(arrays(map_, ("T_world_camera", "units")))
    for keyframe in map_.keyframes:
        found |= {f"{name} of {keyframe.id}": array for name, array in arrays(keyframe, ATTRIBUTES)}
    return found


def test_no_array_of_the_map_can_be_written() -> None:
    map_ = a_map()
    found = handed_out(map_)
    assert len(found) == 12 + 2 + 2 * 8
    for name, array in found.items():
        assert array.size, name
        before = array.copy()
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1
        with pytest.raises(ValueError, match="read-only"):
            array[:1] += 1
        np.testing.assert_array_equal(array, before)


def test_arrays_cannot_be_written_after_the_map_has_grown_and_was_compacted() -> None:
    map_ = a_map()
    create(map_, add_keyframe(map_, 5000), range(5000))
    map_.remove(np.arange(100, 3000))
    assert map_.compact() is not None
    map_.correct_similarities(map_.T_world_camera, np.full(3, 2.0))
    for name, array in handed_out(map_).items():
        assert not array.flags.writeable, name


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_no_attribute_of_a_keyframe_can_be_set(name: str) -> None:
    keyframe = a_map().keyframes[0]
    with pytest.raises(AttributeError):
        setattr(keyframe, name, getattr(keyframe, name))
    with pytest.raises(AttributeError):
        delattr(keyframe, name)


def test_neither_a_keyframe_nor_the_landmarks_take_new_attributes() -> None:
    map_ = a_map()
    with pytest.raises(AttributeError):
        map_.keyframes[0].weight = 1.0  # type: ignore[attr-defined]
    for field in fields(map_.landmarks):
        with pytest.raises(AttributeError):
            setattr(map_.landmarks, field.name, getattr(map_.landmarks, field.name))
    with pytest.raises(TypeError):
        map_.keyframes[0] = map_.keyframes[1]  # type: ignore[index]


def test_what_was_handed_out_earlier_follows_changes() -> None:
    map_ = a_map()
    first, second = map_.keyframes
    landmarks, seen = map_.landmarks, second.landmark_ids
    T_new = se3_exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]))
    map_.correct([1], T_new[None])
    np.testing.assert_array_equal(second.T_camera_world, T_new)
    np.testing.assert_allclose(second.T_world_camera, invert(T_new))
    np.testing.assert_array_equal(landmarks.position_w, map_.landmarks.position_w)
    see(map_, second, 5, 0)
    map_.fuse(ids_of(4), ids_of(1))
    np.testing.assert_array_equal(seen, second.landmark_ids)
    np.testing.assert_array_equal(seen[[1, 5]], [1, 0])
    assert landmarks.observations[0] == 2
    assert (landmarks.alive[4], landmarks.alias[4]) == (False, 1)
    map_.rescale(2.0)
    np.testing.assert_allclose(first.log_depth, np.linspace(0.0, 1.0, 8) + np.log(2.0))
    assert (first.scale, first.unit) == (2.0, 2.0)
    np.testing.assert_array_equal(landmarks.distance_m, map_.landmarks.distance_m)


def test_keyframes_follow_when_the_map_gives_ids_to_others() -> None:
    map_ = a_map()
    keyframe = map_.keyframes[1]
    map_.remove(ids_of(0, 1))
    map_._compact_at = 0
    assert map_.compact() is not None
    np.testing.assert_array_equal(keyframe.landmark_ids[:3], [1, 2, 3])
    assert map_.size == len(map_.landmarks) == 4


def test_writing_what_was_given_to_the_map_changes_nothing() -> None:
    map_ = Map()
    T, ids, velocity, depth = np.eye(4), np.full(8, -1), np.arange(6.0), np.linspace(0.0, 1.0, 8)
    keyframe = add_keyframe(map_, T_camera_world=T, ids=ids)
    map_.set_velocity(keyframe, velocity)
    map_.set_depth(keyframe, flat_depth(), depth, depth, predicted_log_depth=depth)
    position_w, covariance_w = np.ones((1, 3)), np.eye(3)[None].copy()
    map_.create_landmarks(keyframe, ids_of(0), position_w, covariance_w)
    T_new = 1.0 * np.eye(4)[None]
    map_.correct([0], T_new)
    before = {name: array.copy() for name, array in handed_out(map_).items()}
    for array in (T, ids, velocity, depth, position_w, covariance_w, T_new):
        array[...] = 7
    for name, array in handed_out(map_).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


def test_two_maps_side_by_side_share_nothing() -> None:
    one, other = a_map(), a_map()
    before = {name: array.copy() for name, array in handed_out(other).items()}
    one.rescale(2.0)
    one.remove(ids_of(0, 1))
    for name, array in handed_out(other).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)
    assert [k.id for k in other.keyframes] == [0, 1]
