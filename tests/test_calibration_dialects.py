# SPDX-License-Identifier: Apache-2.0
"""Calibrations as OpenCV and ROS write them."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamdepth.calibration import WideLens
from slamdepth.datasets import open_dataset
from slamdepth.errors import CameraError
from slamdepth.types import Camera

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60
)
CAMERA = Camera(640, 480, 535.5, 536.25, 342.25, 235.5, (-0.265, -0.0467, 0.0018, -0.0003, 0.252))

OPENCV = """%YAML:1.0
---
calibration_time: "Tue 12 Mar 2024 10:00:00 AM CET"
nframes: 13
image_width: 640
image_height: 480
board_width: 9
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3550000000000000e+02, 0., 342.25, 0., 536.25,
       2.3550000000000000e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.65e-01, -4.67e-02, 1.8e-03, -3.e-04, 2.52e-01 ]
avg_reprojection_error: 2.1e-01
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [535.5, 0, 342.25, 0, 536.25, 235.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.265, -0.0467, 0.0018, -3e-04, 0.252]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [536, 0, 342, 0, 0, 536, 235, 0, 0, 0, 1, 0]
"""


def read(folder: Path, text: str) -> Camera:
    (folder / "own.yaml").write_text(text)
    return Camera.from_file(folder / "own.yaml", [])


@pytest.mark.parametrize(
    "text", [OPENCV, ROS, OPENCV.replace("image_w", "image_W").replace("camera_m", "Camera_M")]
)
def test_what_tools_write_is_read(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text) == CAMERA
    assert read(tmp_path, text.replace("distortion_coefficients", "dist_coeffs")) == CAMERA
    assert read(tmp_path, text + "fps: 25\ndepth_factor: 1000\n").fps == 25.0


def test_what_was_read_is_noted(tmp_path: Path, tiny_room: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        "image_width: 320\nimage_height: 240\ncamera_matrix: [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]\n"
    )
    said = (
        "own.yaml: another tool's calibration, read as 320x240, fx 300 fy 300 cx 159.5 cy 119.5, "
        "distortion [0, 0, 0, 0, 0], 30 Hz"
    )
    assert open_dataset(tiny_room, path).notes[0] == said
    with caplog.at_level(logging.WARNING, logger="slamdepth"):
        Camera.from_file(path)
    assert said in caplog.text


real = st.floats(-1e-2, 1e-2)


@RELAXED
@given(
    st.tuples(*[st.floats(600.0, 900.0)] * 2), st.tuples(*[st.floats(200.0, 400.0)] * 2),
    st.lists(real, max_size=5), st.sampled_from(["yml", "json"]),
)  # fmt: skip
def test_what_opencv_writes_comes_back(
    tmp_path: Path,
    focal: tuple[float, float],
    centre: tuple[float, float],
    distortion: list[float],
    ending: str,
) -> None:
    path = tmp_path / f"own.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([distortion or [0.0]]))
    storage.release()
    camera = Camera.from_file(path, [])
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((*focal, *centre), rel=1e-14)
    assert camera.distortion == pytest.approx(
        (*distortion, *[0.0] * (5 - len(distortion))), rel=1e-14, abs=1e-300
    )


@RELAXED
@given(
    st.tuples(*[st.floats(600.0, 900.0)] * 2), st.tuples(*[st.floats(200.0, 400.0)] * 2),
    st.lists(real, min_size=4, max_size=5),
)  # fmt: skip
def test_what_ros_writes_comes_back(
    tmp_path: Path, focal: tuple[float, float], centre: tuple[float, float], distortion: list[float]
) -> None:
    K = [focal[0], 0.0, centre[0], 0.0, focal[1], centre[1], 0.0, 0.0, 1.0]
    values: dict[str, Any] = {
        "image_width": 640, "image_height": 480, "distortion_model": "plumb_bob",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": distortion},
    }  # fmt: skip
    camera = read(tmp_path, yaml.safe_dump(values))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (*focal, *centre)
    assert camera.distortion == (*distortion, *[0.0] * (5 - len(distortion)))


ECHO = """header:
  seq: 12
  stamp:
    secs: 1403636579
    nsecs: 763555584
  frame_id: "camera"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.265, -0.0467, 0.0018, -3e-04, 0.252]
K: [535.5, 0.0, 342.25, 0.0, 536.25, 235.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [536.0, 0.0, 342.0, 0.0, 0.0, 536.0, 235.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: False
---
"""
ECHO_OF_ROS_2 = (
    "height: 480\nwidth: 640\ndistortion_model: plumb_bob\n"
    "d:\n- -0.265\n- -0.0467\n- 0.0018\n- -3e-04\n- 0.252\n"
    "k:\n- 535.5\n- 0.0\n- 342.25\n- 0.0\n- 536.25\n- 235.5\n- 0.0\n- 0.0\n- 1.0\nbinning_x: 0\n---\n"
)


@pytest.mark.parametrize(
    "text", [ECHO, ECHO_OF_ROS_2, ECHO + ECHO.replace("seq: 12", "seq: 13") + ECHO, "---\n" + ECHO]
)
def test_a_printed_camera_info_is_read(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text) == CAMERA


@pytest.mark.parametrize("model", ["''", "plumb_bob", "None", "inverse_brown_conrady"])
@pytest.mark.parametrize("coefficients", ["D: []", "D:", "D: [0.0, 0.0, 0.0, 0.0, 0.0]", "binning_y: 0"])
def test_no_distortion_needs_no_model(tmp_path: Path, model: str, coefficients: str) -> None:
    text = ECHO.replace("binning_y: 0\n", "").replace('"plumb_bob"', model)
    text = text.replace("D: [-0.265, -0.0467, 0.0018, -3e-04, 0.252]", coefficients)
    assert read(tmp_path, text) == CAMERA.without_distortion()


def ros(what: str, by: str) -> str:
    assert what in ROS
    return ROS.replace(what, by)


EIGHT = "rows: 1\n  cols: 8\n  data: [-0.265, -0.0467, 0.0018, -3e-04, 0.252, {}, 0, 0]"
TWELVE = "rows: 1\n  cols: 12\n  data: [0, 0, 0, 0, 0, 0, 0, 0, 1e-3, 0, 0, 0]"
FIVE = ROS[ROS.index("rows: 1\n") : ROS.index("\nrectification")]


def test_coefficients_that_are_zero_may_follow(tmp_path: Path) -> None:
    text = ros(FIVE, EIGHT.format(0)).replace("plumb_bob", "rational_polynomial")
    assert read(tmp_path, text) == CAMERA


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial"])
def test_eight_coefficients_of_the_rational_model_are_read(tmp_path: Path, model: str) -> None:
    camera = read(tmp_path, ros(FIVE, EIGHT.format(0.1)).replace("plumb_bob", model))
    assert camera.distortion == (*CAMERA.distortion, 0.1, 0.0, 0.0)


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "kannala_brandt4"])
def test_a_fisheye_of_ros_or_opencv_is_read(tmp_path: Path, model: str) -> None:
    four = "rows: 1\n  cols: 4\n  data: [-0.05, 0.01, 0.002, -0.001]"
    lens = WideLens("fisheye", (-0.05, 0.01, 0.002, -0.001))
    expected = replace(CAMERA, distortion=(0.0,) * 5, lens=lens)
    assert read(tmp_path, ros(FIVE, four).replace("plumb_bob", model)) == expected
    text = ros(FIVE, four).replace("distortion_model: plumb_bob", "fisheye_model: 1")
    assert read(tmp_path, text) == expected


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ros("plumb_bob", "mirror_ball"), "a lens of the model 'mirror_ball' is not supported"),
        (ros("plumb_bob", "equidistant"), "the model 'fisheye' must be 4 numbers [k1, k2, k3, k4], found 5"),
        (OPENCV + "fisheye_model: 1\n", "the model 'fisheye' must be 4 numbers [k1, k2, k3, k4], found 5"),
        (ros(FIVE, TWELVE), "key 'distortion_coefficients' has 12 coefficients; supported are"),
        (ECHO.replace('"plumb_bob"', "''"), "a lens of the model '' is not supported"),
        (ECHO.replace('"plumb_bob"', "equidistant").replace("D: [-0.265", "D: [0"), "must be 4 numbers"),
        (ECHO[: ECHO.index("K: ")] + "K: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n", "all zero: this camera was never"),
        (ECHO + ECHO.replace("535.5", "600.0"), "holds 2 documents that differ"),
        (ros("image_height: 480\n", ""), "a calibration without image_height: add the size"),
        (ros("image_height: 480\n", "height: no\n"), "key 'height' must be a whole number of pixels"),
        (ros("image_height: 480\n", "image_height: 480\nheight: 240\n"), "'image_height' and 'height' say"),
        (ros("[535.5, 0,", "[535.5, 3,"), "key 'camera_matrix' has a skew of 3"),
        (ros("0, 0, 1]\ndist", "0, 1, 1]\ndist"), "must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]"),
        (ros("535.5, 0, 342", "342"), "has 7 numbers in 'data', not rows x cols = 3 x 3"),
        (ros("data: [535.5", "data: [x"), "key 'camera_matrix' must hold numbers, found 'x'"),
        (ros("data: [535.5", "data: [-535.5"), "fx and fy must be positive"),
        (ros("data: [535.5", "data: [.nan"), "must be finite"),
        (ros("342.25", "3422.5"), "cx 3422.5 lies outside the image"),
        (ros("distortion_coefficients", "lens_distortion"), "'lens_distortion' is not known; write 'dist"),
        (ros("  cols: 3\n  data: [535.5", "  rows: 3\n  data: [535.5"), "key 'rows' is given twice"),
        ("camera_matrix: 3\nimage_width: 1\nimage_height: 1\n", "must be a matrix with 'rows', 'cols' a"),
        (OPENCV.replace("   dt: d", "\tdt: d"), "not valid YAML: line 12: "),
        (OPENCV.replace("opencv-matrix", "opencv-graph"), "not valid YAML: line 9: could not determine"),
        ("width: 640\nheight: 480\nfx: [\n", "not valid YAML: line 4: "),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(CameraError) as caught:
        read(tmp_path, text)
    assert says in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path / 'own.yaml'}: ")
    assert "\n" not in str(caught.value)


anything = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.dates()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=9), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=12,
)
matrices = st.fixed_dictionaries({}, optional={"rows": anything, "cols": anything, "data": anything})


@RELAXED
@given(
    st.fixed_dictionaries(
        {"camera_matrix": st.one_of(anything, matrices)},
        optional={
            "image_width": anything, "image_height": anything, "distortion_model": anything,
            "distortion_coefficients": st.one_of(anything, matrices), "fps": anything,
            "fisheye_model": anything,
        },
    )
)  # fmt: skip
def test_garbage_in_the_right_keys_is_a_camera_error(tmp_path: Path, values: dict[str, Any]) -> None:
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(values, allow_unicode=True), encoding="utf-8")
    with pytest.raises(CameraError) as caught:
        Camera.from_file(tmp_path / "own.yaml", [])
    assert "\n" not in str(caught.value)
