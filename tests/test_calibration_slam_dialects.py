# SPDX-License-Identifier: Apache-2.0
"""Calibrations as Kalibr, EuRoC, ORB-SLAM, Basalt and VINS-Mono write them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamdepth.calibration import WideLens
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


OMNI = KALIBR.replace("pinhole", "omni").replace("[458.5,", "[1.8, 458.5,")
EQUIDISTANT = KALIBR.replace("radtan", "equidistant")
DS = KALIBR.replace("pinhole", "ds").replace("[458.5,", "[-0.2, 0.6, 458.5,").replace("radtan", "none")
EUCM = KALIBR.replace("pinhole", "eucm").replace("[458.5,", "[0.6, 1.1, 458.5,").replace("radtan", "none")
NO_DISTORTION = ("distortion_coeffs: [-0.283, 0.074, 0.0002, 1.7e-05]", "distortion_coeffs: []")
FOV = KALIBR.replace("radtan", "fov").replace(NO_DISTORTION[0], "distortion_coeffs: [0.9]")
BASALT = """{
    "value0": {
        "T_imu_cam": [{"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}],
        "intrinsics": [
            {
                "camera_type": "ds",
                "intrinsics": {"fx": 458.5, "fy": 457.5, "cx": 367.25, "cy": 248.5, "xi": -0.2, "alpha": 0.6}
            }
        ],
        "resolution": [[752, 480]],
        "cam_time_offset_ns": 0
    }
}
"""
KB4 = BASALT.replace('"ds"', '"kb4"').replace(
    '"xi": -0.2, "alpha": 0.6', '"k1": -0.01, "k2": 0.02, "k3": -0.003, "k4": 0.001'
)
VINS = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters:
   xi: 1.8
distortion_parameters:
   k1: -0.283
   k2: 0.074
   p1: 0.0002
   p2: 1.7e-05
projection_parameters:
   gamma1: 458.5
   gamma2: 457.5
   u0: 367.25
   v0: 248.5
"""
VINS_FISHEYE = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
  {k2: -0.01, k3: 0.02, k4: -0.003, k5: 0.001, mu: 458.5, mv: 457.5, u0: 367.25, v0: 248.5}
"""
ORB_FISHEYE = (
    ORB_SLAM.replace('"PinHole"', '"KannalaBrandt8"')
    .replace("Camera1.k1: -0.283", "Camera1.k1: -0.01")
    .replace("Camera1.k2: 0.074", "Camera1.k2: 0.02")
    .replace("Camera1.p1: 0.0002", "Camera1.k3: -0.003")
    .replace("Camera1.p2: 1.7e-05", "Camera1.k4: 0.001")
)
FISHEYE = ("fisheye", (-0.01, 0.02, -0.003, 0.001))


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
def test_a_camera_of_another_system_is_read(tmp_path: Path, text: str, rest: dict[str, Any]) -> None:
    notes: list[str] = []
    expected = Camera(752, 480, 458.5, 457.5, 367.25, 248.5, DISTORTION)
    assert read(tmp_path, text, notes) == replace(expected, **rest)
    assert notes[0].startswith("own.yaml: another tool's calibration, read as 752x480, fx 458.5")


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    [
        (EQUIDISTANT, "fisheye", DISTORTION[:4]),
        (OMNI, "unified", (1.8, *DISTORTION[:4])),
        (OMNI.replace("radtan", "none").replace(*NO_DISTORTION), "unified", (1.8, 0.0, 0.0, 0.0, 0.0)),
        (DS, "double_sphere", (-0.2, 0.6)),
        (DS.replace(*NO_DISTORTION), "double_sphere", (-0.2, 0.6)),
        (EUCM.replace(*NO_DISTORTION), "extended_unified", (0.6, 1.1)),
        (
            KALIBR.replace("radtan", "fov").replace(NO_DISTORTION[0], "distortion_coeffs: [0.9]"),
            "fov",
            (0.9,),
        ),
        (BASALT, "double_sphere", (-0.2, 0.6)),
        (KB4, *FISHEYE),
        (BASALT.replace('"ds"', '"ucm"'), "extended_unified", (0.6, 1.0)),
        (VINS, "unified", (1.8, *DISTORTION[:4])),
        (VINS_FISHEYE, *FISHEYE),
        (ORB_FISHEYE, *FISHEYE),
    ],
)
def test_a_wide_lens_of_another_system_is_read(
    tmp_path: Path, text: str, model: str, coefficients: tuple[float, ...]
) -> None:
    camera = read(tmp_path, text)
    assert camera.lens == WideLens(model, coefficients)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (752, 480, 458.5, 457.5)
    assert (camera.cx, camera.cy, camera.is_distorted) == (367.25, 248.5, False)


def test_pinholes_of_basalt_and_vins_are_read(tmp_path: Path) -> None:
    plain = Camera(752, 480, 458.5, 457.5, 367.25, 248.5)
    assert read(tmp_path, BASALT.replace('"ds"', '"pinhole"')) == plain
    eight = '"k1": 0.4, "k2": -0.3, "p1": 0.001, "p2": -0.001, "k3": 0.1, "k4": 0.5, "k5": -0.2, "k6": 0.05'
    text = BASALT.replace('"ds"', '"pinhole-radtan8"').replace('"xi": -0.2, "alpha": 0.6', eight)
    assert read(tmp_path, text).distortion == (0.4, -0.3, 0.001, -0.001, 0.1, 0.5, -0.2, 0.05)
    vins = VINS.replace("MEI", "PINHOLE").replace("gamma1", "fx").replace("gamma2", "fy")
    vins = vins.replace("u0:", "cx:").replace("v0:", "cy:")
    assert read(tmp_path, vins).distortion == DISTORTION


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (KALIBR.replace("pinhole", "mirror"), "camera_model 'mirror' is not supported, only pinhole, omni"),
        (KALIBR.replace("pinhole", "omni"), r"'intrinsics' must be \[xi, fx, fy, cx, cy\]"),
        (
            OMNI.replace("radtan", "equidistant"),
            "'omni' with distortion_model 'equidistant' is not supported",
        ),
        (KALIBR.replace("[752, 480]", "752"), r"key 'resolution' must be \[width, height\], found 752"),
        (KALIBR.replace("458.5, ", ""), r"key 'intrinsics' must be \[fx, fy, cx, cy\]"),
        (KALIBR.replace("458.5", "wide"), "must hold numbers, found 'wide'"),
        (KALIBR + KALIBR.replace("cam0", "cam1"), "holds the cameras cam0, cam1; leave the one"),
        (ORB_SLAM.replace('"PinHole"', '"Mirror"'), "Camera.type 'Mirror' is not supported"),
        (ORB_SLAM.replace('"PinHole"', '"KannalaBrandt8"'), "an ORB-SLAM file without Camera1.k3: add it"),
        (
            BASALT.replace('"ds"', '"mirror"'),
            "camera_type 'mirror' is not supported, only pinhole, pinhole-r",
        ),
        (BASALT.replace('"xi"', '"x"'), "intrinsics of 'ds' without 'xi': add it"),
        (BASALT.replace("[[752, 480]]", "[752, 480]"), "must be lists of one length"),
        (BASALT.replace("[[752, 480]]", "[752]"), r"'resolution' must be \[\[width, height\]\]"),
        (BASALT.replace("[[752, 480]]", "[[1, 2], [3, 4]]"), "must be lists of one length"),
        (VINS.replace("MEI", "MIRROR"), "model_type 'MIRROR' is not supported, only PINHOLE, MEI, KANNALA"),
        (VINS.replace("xi:", "x:"), "mirror_parameters without 'xi': add it"),
        (VINS.replace("image_width: 752\n", ""), "camera file without 'image_width': add it"),
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
