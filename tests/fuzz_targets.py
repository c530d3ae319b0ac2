# SPDX-License-Identifier: Apache-2.0
"""What ``tests/fuzz.py`` damages and reads: good recordings and files, and checks of what is read of them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import SlamdepthError


@dataclass(frozen=True)
class Target:
    """What is damaged and read.

    Attributes:
        make: writes a good one into a folder that is empty; returns what is to be read.
        read: reads all of it and checks that the result is sound.
    """

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], None]


class FindingError(Exception):
    """A case ended in neither an error of one line nor a sound result."""


def check_dataset(path: Path) -> None:
    """Open a sequence, read every frame, and check what is promised of it."""
    from slamdepth.datasets import open_dataset
    from slamdepth.datasets.summary import summarise

    dataset = open_dataset(path)
    times_s = np.asarray(dataset.timestamps_s)
    _require(len(times_s) == len(dataset) > 0, "as many times as frames, and one at least")
    _require(bool(np.isfinite(times_s).all() and (np.diff(times_s) > 0).all()), "times increase")
    camera = dataset.camera
    _require(0 < camera.width <= 20_000 and 0 < camera.height <= 20_000, "a size that an image has")
    _require(bool(np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()), "finite intrinsics")
    _require(all("\n" not in note for note in dataset.notes), "notes of one line")
    if dataset.ground_truth is not None:
        truth = dataset.ground_truth
        _require(bool(np.isfinite(truth.T_world_camera).all()), "finite poses")
        R = truth.T_world_camera[:, :3, :3]
        _require(bool(np.allclose(R @ R.swapaxes(1, 2), np.eye(3), atol=1e-6)), "rotations")
        _require(bool(np.isfinite(truth.timestamps_s).all()), "finite times of poses")
        _require(bool((np.diff(truth.timestamps_s) > 0).all()), "times of poses increase")
    for index in range(min(len(dataset), 50)):
        try:
            frame = dataset.read(index, with_depth=dataset.has_depth)
        except SlamdepthError as error:
            _require("\n" not in str(error), "errors of one line")
            continue
        depth_m = frame.depth_m
        _require(depth_m is None or bool(np.isfinite(depth_m).all() and (depth_m >= 0).all()), "finite depth")
    summarise(dataset)


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise FindingError(f"not so: {what}")


def _read_trajectory(path: Path) -> None:
    from slamdepth.io import read_tum_trajectory

    trajectory, _ = read_tum_trajectory(path)
    _require(bool(np.isfinite(trajectory.T_world_camera).all()), "finite poses")
    _require(bool((np.diff(trajectory.timestamps_s) > 0).all()), "times increase")


def _read_camera(path: Path) -> None:
    from slamdepth.types import Camera

    camera = Camera.from_file(path, [])
    _require(bool(np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()), "finite intrinsics")


def _read_imu(path: Path) -> None:
    from slamdepth.io.imu import read_imu

    imu, _ = read_imu(path)
    _require(bool(np.isfinite(imu.rates).all() and np.isfinite(imu.forces).all()), "finite inertial data")
    _require(bool((np.diff(imu.times_s) > 0).all()), "times increase")


def _read_config(path: Path) -> None:
    from slamdepth.config import Config

    Config.from_yaml(path)


def _read_scale(path: Path) -> None:
    from slamdepth.depth.scale_file import read_scale

    _require(bool(np.isfinite(read_scale(path).scale.scale)), "a finite scale")


def _read_surface(path: Path) -> None:
    from slamdepth.evaluation.surface_file import read_surface

    _require(bool(np.isfinite(read_surface(path).vertices_m).all()), "finite vertices")


def _read_head(path: Path) -> None:
    from slamdepth.depth.head import load_head

    load_head(path)


def targets(*, slow: bool = True) -> list[Target]:
    """All of them; without the ``slow`` ones, those that load no network and no Open3D."""
    import recordings as made
    from sequences import CAMERA, image_rgb, make_sevenscenes, make_tum, write_image

    from slamdepth.io import write_camera

    def folder_of(maker: Callable[[Path], Any]) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            found = maker(folder / "recording")
            return found[0] if isinstance(found, tuple) else Path(found)

        return make

    def images(folder: Path) -> Path:
        for i in range(4):
            write_image(folder / f"{i}.png", image_rgb(i))
        write_camera(folder / "camera.yaml", CAMERA)
        return folder

    def named(name: str, text: str) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            (folder / name).write_text(text, encoding="utf-8")
            return folder / name

        return make

    makers: dict[str, Callable[[Path], Path]] = {
        "tum": folder_of(lambda folder: make_tum(folder, 6)),
        "7scenes": folder_of(lambda folder: make_sevenscenes(folder, 2)),
        "images": folder_of(images),
        "euroc": folder_of(made.make_euroc),
        "kitti": folder_of(made.make_kitti),
        "icl-tum": folder_of(made.make_icl_tum),
        "replica": folder_of(made.make_replica),
        "scannet": folder_of(made.make_scannet),
        "sens": lambda folder: made.make_sens(folder / "scene.sens"),
        "stray": folder_of(made.make_stray),
        "nerfstudio": folder_of(made.make_nerfstudio),
        "polycam": folder_of(made.make_polycam),
        "colmap": folder_of(lambda folder: made.make_colmap(folder, binary=True)),
        "colmap-text": folder_of(lambda folder: made.make_colmap(folder, binary=False)),
        "r3d": lambda folder: made.make_record3d(folder / "walk.r3d", packed=_has("lzfse")),
        "record3d": folder_of(lambda folder: made.make_record3d(folder, packed=_has("lzfse"))),
        "video": lambda folder: made.make_stray(folder / "made") / "rgb.mp4",
    }
    if _has("rosbags"):
        from bags import KINDS, bag_path, small_bag

        def bag_of(kind: str, folder: Path) -> Path:
            return small_bag(bag_path(folder, kind), kind)

        for kind in KINDS:
            makers[f"bag-{kind}"] = partial(bag_of, kind)
    found = [Target(name, make, check_dataset) for name, make in makers.items()]
    euroc = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n"
    euroc += "".join(f"{1403636579763555584 + i * 50_000_000},{i},0,0,1,0,0,0\n" for i in range(9))
    tum = "# timestamp tx ty tz qx qy qz qw\n" + "".join(f"{i / 30:.6f} {i} 0 0 0 0 0 1\n" for i in range(9))
    imu = "time,gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s),acc_x (g),acc_y (g),acc_z (g)\n"
    imu += "".join(f"{i / 100:.4f},0.1,0.2,0.3,0.0,0.1,1.0\n" for i in range(30))
    opencv = (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
        "   cols: 3\n   dt: d\n   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
        "   data: [ 0.1, -0.2, 0., 0., 0. ]\n"
    )
    kalibr = (
        "cam0:\n  camera_model: pinhole\n  intrinsics: [190.9, 190.9, 254.9, 256.8]\n"
        "  resolution: [512, 512]\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]\n"
    )
    plain = "width: 640\nheight: 480\nfx: 500.0\nfy: 500.0\ncx: 320\ncy: 240\nfps: 30\n"
    plain += "distortion: [0.1, 0, 0, 0, 0]\n"
    orb = "%YAML:1.0\nCamera.type: PinHole\nCamera.fx: 500.0\nCamera.fy: 500.0\nCamera.cx: 320\n"
    orb += "Camera.cy: 240\nCamera.width: 640\nCamera.height: 480\nCamera.k1: 0.1\nCamera.fps: 30\n"
    settings = "seed: 1\ndepth:\n  name: dinov2\nmap:\n  voxel_size_m: 0.02\nscale:\n  camera_height_m: 1.5\n"
    found += [
        Target("trajectory", named("groundtruth.txt", tum), _read_trajectory),
        Target("trajectory-euroc", named("data.csv", euroc), _read_trajectory),
        Target("imu", named("imu.csv", imu), _read_imu),
        Target("camera", named("camera.yaml", plain), _read_camera),
        Target("camera-opencv", named("camera.yaml", opencv), _read_camera),
        Target("camera-kalibr", named("camera.yaml", kalibr), _read_camera),
        Target("camera-orbslam", named("camera.yaml", orb), _read_camera),
        Target("config", named("config.yaml", settings), _read_config),
        Target("scale-file", _scale, _read_scale),
    ]
    if slow:
        found += [Target("ply", _mesh, _read_surface), Target("weights", _head, _read_head)]
    return found


def _scale(folder: Path) -> Path:
    from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit
    from slamdepth.depth.scale_file import write_scale
    from slamdepth.types import DepthKind, WeightsInfo

    fit = ScaleFit(
        scale=DepthScale(1.2, 0.0, ScaleDomain.DEPTH),
        sequence="room",
        model="dinov2",
        kind=DepthKind.METRIC,
        weights=(WeightsInfo("head", "0" * 64, "rooms", "mine"),),
        scale_sigma_log=0.01,
        shift_sigma=None,
        frames=10,
        pixels=1000,
        frame_spread_log=0.1,
        sequence_id="abc",
    )
    write_scale(folder / "scale.yaml", fit)
    return folder / "scale.yaml"


def _mesh(folder: Path) -> Path:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "mesh.ply").write_text(head + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    return folder / "mesh.ply"


def _head(folder: Path) -> Path:
    from slamdepth.depth.weights import head_path

    shutil.copy(head_path(), folder / "head.safetensors")
    return folder / "head.safetensors"


def _has(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None
