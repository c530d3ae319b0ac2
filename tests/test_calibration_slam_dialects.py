# SPDX-License-Identifier: Apache-2.0
"""Calibrations as Kalibr, EuRoC and ORB-SLAM write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamdepth.calibration.camera_yaml import read_camera
from slamdepth.errors import CameraError
from slamdepth.types import Camera

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.283, 0.074, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [458.5, 457.5, 367.25, 248.5]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
EUROC = """# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.5, 457.5, 367.25, 248.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.283, 0.074, 0.0002, 1.7e-05]
"""
ORB_SLAM = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 458.5
Camera1.fy: 457.5
Camera1.cx: 367.25
Camera1.cy: 248.5
Camera1.k1: -0.283
Camera1.k2: 0.074
Camera1.p1: 0.0002
Camera1.p2: 1.7e-05
Camera.width: 752
Camera.height: 480
Camera.fps: 20
RGBD.DepthMapFactor: 1000.0
ORBextractor.nFeatures: 1000
"""
DISTORTION = (-0.283, 0.074, 0.0002, 1.7e-05, 0.0)


def read(folder: Path, text: str, notes: list[str] | None = None) -> Camera:
    path = folder / "own.yaml"
    path.write_text(text)
    return read_camera(path, Camera, [] if notes is None else notes)


@pytest.mark.parametrize(
    ("text", "rest"),
    [
        (KALIBR, {}),
        (EUROC, {"fps": 20.0}),
        (ORB_SLAM, {"fps": 20.0, "depth_factor": 1000.0}),
        (ORB_SLAM.replace("Camera1.", "Camera."), {"fps": 20.0, "depth_factor": 1000.0}),
    ],
)
def test_a_camera_of_another_system_is_read(tmp_path: Path, text: str, rest: dict[str, float]) -> None:
    notes: list[str] = []
    assert read(tmp_path, text, notes) == Camera(752, 480, 458.5, 457.5, 367.25, 248.5, DISTORTION, **rest)
    assert notes[0].startswith("own.yaml: another tool's calibration, read as 752x480, fx 458.5")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (KALIBR.replace("radtan", "equidistant"), "a lens of the model 'equidistant' is not supported"),
        (KALIBR.replace("pinhole", "omni"), "camera_model 'omni' is not supported"),
        (KALIBR.replace("[752, 480]", "752"), r"key 'resolution' must be \[width, height\], found 752"),
        (KALIBR.replace("458.5, ", ""), r"key 'intrinsics' must be \[fx, fy, cx, cy\]"),
        (KALIBR.replace("458.5", "wide"), "must hold numbers, found 'wide'"),
        (KALIBR + KALIBR.replace("cam0", "cam1"), "holds the cameras cam0, cam1; leave the one"),
        (ORB_SLAM.replace('"PinHole"', '"KannalaBrandt8"'), "Camera.type 'KannalaBrandt8' is not supported"),
        (ORB_SLAM.replace("Camera.width: 752\n", ""), "an ORB-SLAM file without Camera.width: add it"),
        (ORB_SLAM.replace("Camera1.fy: 457.5\n", ""), "an ORB-SLAM file without Camera1.fy: add it"),
    ],
)
def test_what_is_no_pinhole_or_incomplete_is_refused_in_one_line(
    tmp_path: Path, text: str, problem: str
) -> None:
    with pytest.raises(CameraError, match=problem) as refused:
        read(tmp_path, text)
    assert "own.yaml: " in str(refused.value)
    assert "\n" not in str(refused.value)


def test_focal_lengths_of_pixels_that_are_not_square_are_noted(tmp_path: Path) -> None:
    notes: list[str] = []
    read(tmp_path, "width: 640\nheight: 480\nfx: 525\nfy: 262\ncx: 319.5\ncy: 239.5\n", notes)
    assert any("pixels that are not square" in note for note in notes)
