# SPDX-License-Identifier: Apache-2.0
"""Which recordings have the camera of a map: by what they tell of their own, their size and their shape."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from slamdepth.datasets import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of
from slamdepth.mapstore import Map
from slamdepth.pipeline.saved_maps import camera_at_size, use_camera_of_map
from slamdepth.types import Camera

THEIRS = Camera(640, 480, 500.0, 510.0, 322.0, 237.0, (0.1, -0.05, 0.001, 0.002, 0.01))
SAVED = cast("Map", SimpleNamespace(camera=THEIRS))
GUESSED = CameraSource(Certainty.GUESSED, "a guess")


def dataset_of(camera: Camera, source: CameraSource) -> Any:
    return SimpleNamespace(camera=camera, camera_source=source, notes=[])


def given_to(width: int, height: int, source: CameraSource, fx: float = 600.0) -> Any:
    own = Camera(width, height, fx, fx, width / 2, height / 2, fps=15.0)
    dataset = dataset_of(own, source)
    use_camera_of_map(cast("Dataset", dataset), SAVED)
    return dataset


def test_guessed_intrinsics_of_the_same_size_are_the_maps() -> None:
    dataset = given_to(640, 480, GUESSED)
    assert dataset.camera == replace(THEIRS, fps=15.0)
    assert dataset.camera_source.certainty is Certainty.GIVEN
    assert "intrinsics are those of the map, since those of the sequence are guessed" in dataset.notes[0]


def test_images_of_the_same_shape_start_from_the_maps_camera() -> None:
    dataset = given_to(320, 240, GUESSED)
    assert dataset.camera == replace(THEIRS.scaled(320, 240), fps=15.0)
    assert dataset.camera_source.certainty is Certainty.NOMINAL
    assert "those of the map, at 320x240 pixels" in dataset.notes[0]


def test_images_on_their_side_have_the_maps_focal_lengths_exchanged() -> None:
    camera = given_to(240, 320, GUESSED).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (255.0, 250.0, 119.5, 159.5)
    assert camera.distortion == (0.1, -0.05, 0.0, 0.0, 0.01)


@pytest.mark.parametrize("size", [(640, 360), (480, 480), (1280, 720)])
def test_images_of_another_shape_keep_what_they_have(size: tuple[int, int]) -> None:
    dataset = given_to(*size, GUESSED)
    assert dataset.camera.fx == 600.0
    assert dataset.camera_source is GUESSED
    assert not dataset.notes


def test_a_given_camera_stays() -> None:
    source = CameraSource(Certainty.GIVEN, "camera.yaml")
    assert given_to(640, 480, source).camera.fx == 600.0


@pytest.mark.parametrize(("fx", "is_theirs"), [(500.0, True), (560.0, True), (437.0, True), (650.0, False)])
def test_a_focal_length_far_from_the_maps_is_that_of_another_lens(fx: float, is_theirs: bool) -> None:
    source = CameraSource(Certainty.NOMINAL, "EXIF: 26 mm", 0.05)
    dataset = given_to(640, 480, source, fx)
    assert (dataset.camera.fx == THEIRS.fx) is is_theirs
    assert (dataset.camera_source is source) is not is_theirs
    said = "since those of the sequence are nominal" if is_theirs else "another lens took this (EXIF: 26 mm)"
    assert said in dataset.notes[0]


def test_a_named_focal_length_of_another_size_stays() -> None:
    source = CameraSource(Certainty.NOMINAL, "EXIF: 26 mm", 0.05)
    assert given_to(320, 240, source, 260.0).camera.fx == 260.0


def test_rounded_sizes_have_the_same_shape() -> None:
    phone = intrinsics_of(1920, 1080).camera
    found = camera_at_size(phone, 854, 480)
    assert found is not None
    assert math.isclose(found.fx / 854, phone.fx / 1920)
    assert camera_at_size(phone, 640, 480) is None
