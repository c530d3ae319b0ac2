# SPDX-License-Identifier: Apache-2.0
"""Tiny recordings in the layouts that data sets and apps publish, each with frames whose pixels are known."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sequences import CAMERA, depth_raw, image_rgb, poses, write_image

from slamdepth.types import Camera

COUNT = 4
K = CAMERA.K
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def known_poses() -> NDArray[np.float64]:
    """``(COUNT, 4, 4)`` camera to world, x right, y down, z forward."""
    return poses(COUNT, 7)


def quats(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(T[..., :3, :3]).as_quat())


def rows(matrix: NDArray[Any]) -> str:
    return "\n".join(" ".join(f"{value:.17g}" for value in row) for row in np.atleast_2d(matrix)) + "\n"


def png(image: NDArray[Any]) -> bytes:
    ok, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    assert ok
    return data.tobytes()


def opencv_matrix(T: NDArray[np.float64]) -> str:
    values = ", ".join(f"{value:.17g}" for value in T.ravel())
    return f"  cols: 4\n  rows: 4\n  data: [{values}]\n"


def make_euroc(folder: Path, truth: str = "state_groundtruth_estimate0") -> Path:
    """EuRoC's ASL folder. The body is 10 cm behind the camera and turned."""
    T_body_camera = poses(1, 3)[0]
    cam = folder / "mav0" / "cam0"
    stamps = [1403636579763555584 + 50_000_000 * i for i in range(COUNT)]
    for i, stamp in enumerate(stamps):
        write_image(cam / "data" / f"{stamp}.png", image_rgb(i)[..., 0])
    lines = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
    (cam / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    (cam / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n"
        f"# Sensor extrinsics wrt. the body-frame.\nT_BS:\n{opencv_matrix(T_body_camera)}\n"
        "# Camera specific definitions.\nrate_hz: 20\nresolution: [16, 12]\ncamera_model: pinhole\n"
        "intrinsics: [20.0, 21.0, 7.5, 5.5] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    T_world_body = known_poses() @ np.linalg.inv(T_body_camera)
    (folder / "mav0" / truth).mkdir(parents=True)
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
        "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
    )
    lines = [header]
    for stamp, T in zip(stamps, T_world_body, strict=True):
        x, y, z, w = quats(T)
        values = [*T[:3, 3], w, x, y, z, 0, 0, 0]
        lines.append(",".join([str(stamp), *(f"{value:.12f}" for value in values)]))
    (folder / "mav0" / truth / "data.csv").write_text("\n".join(lines) + "\n")
    imu = folder / "mav0" / "imu0"
    imu.mkdir()
    header = (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
        "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    )
    lines = [header, *(f"{stamps[0] + 5_000_000 * i},0.1,0.2,0.3,9.8,0.1,0.2" for i in range(40))]
    (imu / "data.csv").write_text("\n".join(lines) + "\n")
    return folder


def make_kitti(root: Path, images: str = "image_2") -> Path:
    """``sequences/03`` and ``poses/03.txt``; the colour camera is 6 cm to the left of the grey one."""
    folder = root / "sequences" / "03"
    for i in range(COUNT):
        write_image(folder / images / f"{i:06d}.png", image_rgb(i))
    P0 = np.hstack([K, np.zeros((3, 1))])
    P2 = np.hstack([K, K @ np.array([[0.06], [-0.001], [0.002]])])
    named = {"P0": P0, "P1": P0, "P2": P2, "P3": P2, "Tr": P0}
    (folder / "calib.txt").write_text("".join(f"{name}: {rows(P.ravel())}" for name, P in named.items()))
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(COUNT)))
    (root / "poses").mkdir()
    T_grey_colour = np.eye(4)
    T_grey_colour[:3, 3] = -0.06, 0.001, -0.002
    T_world_grey = known_poses() @ (np.linalg.inv(T_grey_colour) if images == "image_2" else np.eye(4))
    (root / "poses" / "03.txt").write_text(rows(T_world_grey[:, :3].reshape(COUNT, 12)))
    return folder


ICL = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def make_icl_tum(folder: Path) -> Path:
    """The TUM-compatible layout; frame 0 has no pose, as in the data set."""
    for i in range(COUNT):
        write_image(folder / "rgb" / f"{i}.png", image_rgb(i, ICL))
        write_image(folder / "depth" / f"{i}.png", depth_raw(i, ICL))
    (folder / "associations.txt").write_text(
        "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(COUNT))
    )
    published = _MIRROR @ known_poses() @ _MIRROR
    lines = [np.hstack([[i], T[:3, 3], quats(T)]) for i, T in enumerate(published)][1:]
    (folder / "livingRoom0.gt.freiburg").write_text(rows(np.array(lines)))
    return folder


def make_icl_own(folder: Path) -> tuple[Path, NDArray[np.float64]]:
    """The data set's own layout of POV-Ray; returns also the depth (H, W) in metres of frame 1."""
    z = np.random.default_rng(5).uniform(0.5, 4.0, (480, 640))
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    ray = z * np.sqrt(((u - ICL.cx) / ICL.fx) ** 2 + ((v - ICL.cy) / ICL.fy) ** 2 + 1.0)
    folder.mkdir()
    for i, T in enumerate(_MIRROR @ known_poses() @ _MIRROR):
        stem = folder / f"scene_00_{i:04d}"
        write_image(stem.with_suffix(".png"), image_rgb(i, ICL))
        vectors = {"cam_pos": T[:3, 3], "cam_dir": T[:3, 2], "cam_up": T[:3, 1], "cam_right": 1.33 * T[:3, 0]}
        text = "".join(f"{n:<14} = [{a:.15g}, {b:.15g}, {c:.15g}]';\n" for n, (a, b, c) in vectors.items())
        stem.with_suffix(".txt").write_text(text + "cam_angle      = 90;\n")
        stem.with_suffix(".depth").write_text(" ".join(f"{value:.9g}" for value in ray.ravel()))
    return folder, z


def make_replica(root: Path) -> Path:
    folder = root / "room0"
    for i in range(COUNT):
        write_image(folder / "results" / f"frame{i:06d}.jpg", np.full((12, 16, 3), 40 * i, np.uint8))
        write_image(folder / "results" / f"depth{i:06d}.png", depth_raw(i))
    (folder / "traj.txt").write_text(rows(known_poses().reshape(COUNT, 16)))
    camera = {"w": 16, "h": 12, "fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5, "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def make_scannet(folder: Path) -> Path:
    """SensReader's export: colour of twice the depth's size; frame 2 has no pose."""
    larger = CAMERA.scaled(32, 24)
    for i, T in enumerate(known_poses()):
        write_image(folder / "color" / f"{i}.jpg", np.full((24, 32, 3), 40 * i, np.uint8))
        write_image(folder / "depth" / f"{i}.png", depth_raw(i))
        (folder / "pose").mkdir(exist_ok=True)
        text = "-inf -inf -inf -inf\n" * 4 if i == 2 else rows(T)
        (folder / "pose" / f"{i}.txt").write_text(text)
    for name, camera in (("color", larger), ("depth", CAMERA)):
        matrix = np.eye(4)
        matrix[:3, :3] = camera.K
        (folder / "intrinsic").mkdir(exist_ok=True)
        (folder / "intrinsic" / f"intrinsic_{name}.txt").write_text(rows(matrix))
        (folder / "intrinsic" / f"extrinsic_{name}.txt").write_text(rows(np.eye(4)))
    return folder


def make_sens(path: Path, depth_kind: int = 1) -> Path:
    matrix = np.eye(4)
    matrix[:3, :3] = K
    matrices = np.concatenate([m.ravel() for m in (matrix, np.eye(4), matrix, np.eye(4))])
    name = b"StructureSensor"
    out = struct.pack("<IQ", 4, len(name)) + name + struct.pack("<64f", *matrices)
    out += struct.pack("<iiIIIIfQ", 2, depth_kind, 16, 12, 16, 12, 1000.0, COUNT)
    for i, T in enumerate(known_poses()):
        colour = png(image_rgb(i))
        depth = depth_raw(i).tobytes()
        depth = zlib.compress(depth) if depth_kind == 1 else depth
        out += struct.pack("<16f", *T.ravel()) + struct.pack(
            "<QQQQ", 33_333 * i, 33_333 * i, len(colour), len(depth)
        )
        out += colour + depth
    path.write_bytes(out)
    return path


def record3d_files(*, packed: bool) -> dict[str, bytes]:
    """The files in a ``.r3d``; depth of half the image's size, the first row without confidence."""
    T = known_poses() @ OPENGL
    meta = {
        "w": 16, "h": 12, "fps": 60, "dw": 8, "dh": 6, "cameraType": 1,
        "K": K.T.ravel().tolist(),
        "poses": np.hstack([quats(T), T[:, :3, 3]]).tolist(),
        "frameTimestamps": [100.0 + i / 60 for i in range(COUNT)],
    }  # fmt: skip
    files = {"metadata": json.dumps(meta).encode(), "icon": b"x", "sound.m4a": b"x"}
    for i in range(COUNT):
        depth = (depth_raw(i)[:6, :8] / 1000.0).astype(np.float32).tobytes()
        confidence = np.full((6, 8), 2, np.uint8)
        confidence[0] = 0
        files[f"rgbd/{i}.jpg"] = png(image_rgb(i))  # the bytes tell what they are, not the name
        files[f"rgbd/{i}.depth"], files[f"rgbd/{i}.conf"] = depth, confidence.tobytes()
        if packed:
            import lzfse

            for name in (f"rgbd/{i}.depth", f"rgbd/{i}.conf"):
                files[name] = lzfse.compress(files[name])
    return files


def make_record3d(path: Path, *, packed: bool = True) -> Path:
    """A ``.r3d`` where ``path`` has that ending, else the same unpacked."""
    files = record3d_files(packed=packed)
    if path.suffix == ".r3d":
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        return path
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path


STRAY = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def make_stray(folder: Path) -> Path:
    folder.mkdir(parents=True)
    writer = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60.0, (64, 48))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, T in enumerate(known_poses()):
        writer.write(np.full((48, 64, 3), 40 * i + 20, np.uint8))
        write_image(folder / "depth" / f"{i:06d}.png", depth_raw(i))
        confidence = np.full((12, 16), 2, np.uint8)
        confidence[0] = 0
        write_image(folder / "confidence" / f"{i:06d}.png", confidence)
        values = ", ".join(f"{value:.12f}" for value in (*T[:3, 3], *quats(T)))
        lines.append(f"{500.0 + i / 60:.6f}, {i:06d}, {values}")
    writer.release()
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in STRAY.K) + "\n")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    return folder


def make_nerfstudio(folder: Path, **changed: Any) -> Path:
    """nerfstudio's processed data: pixels with corners at whole numbers."""
    frames = []
    for i, T in enumerate(known_poses()):
        write_image(folder / "images" / f"frame_{i + 8:05d}.png", image_rgb(i))
        write_image(folder / "depths" / f"{i}.png", depth_raw(i))
        named = f"images/frame_{i + 8:05d}.png"
        frames.append(
            {
                "file_path": named,
                "transform_matrix": (T @ OPENGL).tolist(),
                "depth_file_path": f"depths/{i}.png",
            }
        )
    values = {
        "camera_model": "OPENCV", "w": 16, "h": 12, "fl_x": 20.0, "fl_y": 21.0, "cx": 8.0, "cy": 6.0,
        "k1": 0.01, "k2": -0.02, "p1": 0.001, "p2": 0.002, "frames": frames[::-1], **changed,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in values.items() if v is not None}))
    return folder


def make_polycam(folder: Path) -> Path:
    """A raw export that Polycam has optimised; depth of half the image's size."""
    for i, T in enumerate(known_poses() @ OPENGL):
        for kind in ("", "corrected_"):
            write_image(
                folder / "keyframes" / f"{kind}images" / f"{1000 + i}.jpg", np.zeros((12, 16, 3), np.uint8)
            )
        data = png(image_rgb(i))  # the bytes tell what they are, not the name
        (folder / "keyframes" / "corrected_images" / f"{1000 + i}.jpg").write_bytes(data)
        write_image(folder / "keyframes" / "depth" / f"{1000 + i}.png", depth_raw(i)[:6, :8])
        lens = {"fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5, "width": 16, "height": 12, "blur_score": 90.5}
        pose = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        cameras = folder / "keyframes" / "corrected_cameras"
        cameras.mkdir(exist_ok=True)
        (cameras / f"{1000 + i}.json").write_text(json.dumps({**lens, **pose, "timestamp": 1000 + i}))
    return folder


def make_colmap(folder: Path, *, binary: bool, below: str = "sparse/0") -> Path:
    """A workspace of one OPENCV camera; COLMAP's numbers of images are not in their order."""
    model = folder / below
    model.mkdir(parents=True)
    parameters = (20.0, 21.0, 8.0, 6.0, 0.01, -0.02, 0.001, 0.002)
    images = []
    for i, T in enumerate(np.linalg.inv(known_poses())):
        write_image(folder / "images" / "left" / f"{i + 8}.png", image_rgb(i))
        x, y, z, w = quats(T)
        images.append((COUNT - i, (w, x, y, z, *T[:3, 3]), 1, f"left/{i + 8}.png"))
    images.reverse()
    if binary:
        (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 1, 4, 16, 12, *parameters))
        data = struct.pack("<Q", COUNT)
        for number, pose, camera, name in images:
            data += struct.pack("<I7dI", number, *pose, camera) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.0, 2.0, 7, 3.0, 4.0, -1)
        (model / "images.bin").write_bytes(data)
        (model / "points3D.bin").write_bytes(struct.pack("<Q", 0))
        return folder
    text = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    (model / "cameras.txt").write_text(text + "1 OPENCV 16 12 " + " ".join(map(str, parameters)) + "\n")
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for place, (number, pose, camera, name) in enumerate(images):
        lines.append(f"{number} {' '.join(f'{value:.17g}' for value in pose)} {camera} {name}")
        lines.append("1.0 2.0 7 3.0 4.0 -1" if place else "")
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder
