# SPDX-License-Identifier: Apache-2.0
"""Readers of published layouts: pixels, times, intrinsics, depth and poses come out as they went in."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings as made
from recordings import COUNT, known_poses
from sequences import CAMERA, depth_raw, image_rgb, poses, write_image

from slamdepth.datasets import Dataset, known_readers, open_dataset, write_camera
from slamdepth.datasets.intrinsics import Certainty
from slamdepth.datasets.recording import Recording
from slamdepth.errors import CameraError, DatasetError, InputError
from slamdepth.io.imu import read_imu
from slamdepth.types import Camera

DISTORTED = (0.01, -0.02, 0.001, 0.002, 0.0)


def check_images(dataset: Dataset, camera: Camera = CAMERA) -> None:
    assert len(dataset) == COUNT
    for index in range(COUNT):
        np.testing.assert_array_equal(dataset.read(index).image_rgb, image_rgb(index, camera))


def check_camera(dataset: Dataset, *, distortion: tuple[float, ...] = (0.0,) * 5) -> None:
    found = dataset.camera
    np.testing.assert_allclose(found.K, CAMERA.K)
    assert found.distortion == distortion
    assert dataset.camera_source.certainty is Certainty.GIVEN


def check_truth(dataset: Dataset, kept: Any = slice(None), *, is_metric: bool = True) -> None:
    truth = dataset.ground_truth
    assert truth is not None
    assert truth.is_metric == is_metric
    np.testing.assert_allclose(truth.timestamps_s, dataset.timestamps_s[kept])
    np.testing.assert_allclose(truth.T_world_camera, known_poses()[kept], atol=1e-6)


def depth_of(dataset: Dataset, index: int) -> np.ndarray:
    depth_m = dataset.read(index, with_depth=True).depth_m
    assert depth_m is not None
    return depth_m


def test_euroc(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_euroc(tmp_path / "V1_01_easy"))
    assert (dataset.layout, dataset.name) == ("euroc", "V1_01_easy")
    for index in range(COUNT):
        np.testing.assert_array_equal(dataset.read(index).image_rgb[..., 1], image_rgb(index)[..., 0])
    np.testing.assert_allclose(np.diff(dataset.timestamps_s), 0.05, atol=1e-6)
    check_camera(dataset, distortion=(-0.28, 0.07, 0.0002, 1.8e-05, 0.0))
    check_truth(dataset)
    assert dataset.imu_path is not None
    imu, _ = read_imu(dataset.imu_path)
    assert len(imu.times_s) == 40
    assert open_dataset(tmp_path / "V1_01_easy" / "mav0").name == "V1_01_easy"


def test_tum_vi_has_its_camera_in_a_chain_and_its_truth_in_mocap(tmp_path: Path) -> None:
    folder = made.make_euroc(tmp_path / "dataset-room1_512_16", "mocap0")
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    sensor.unlink()
    T_camera_body = np.linalg.inv(poses(1, 3)[0]).tolist()
    lens = "  camera_model: pinhole\n  intrinsics: [20.0, 21.0, 7.5, 5.5]\n  resolution: [16, 12]\n"
    lens += "  distortion_model: radtan\n  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n"
    one = f"  T_cam_imu: {json.dumps(T_camera_body)}\n{lens}"
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text(f"cam0:\n{one}cam1:\n{one}")
    dataset = open_dataset(folder)
    check_camera(dataset)
    assert dataset.camera_source.how == "cam0 of camchain.yaml"
    check_truth(dataset)


@pytest.mark.parametrize("images", ["image_2", "image_0"])
def test_kitti(tmp_path: Path, images: str) -> None:
    dataset = open_dataset(made.make_kitti(tmp_path, images))
    assert (dataset.layout, dataset.name) == ("kitti", "kitti_03")
    check_images(dataset)
    check_camera(dataset)
    check_truth(dataset)
    np.testing.assert_allclose(dataset.timestamps_s, [0.0, 0.1, 0.2, 0.3])


def test_icl_nuim_in_the_tum_layout_is_mirrored(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_icl_tum(tmp_path / "living_room_traj0_frei_png"))
    assert dataset.layout == "icl-nuim"
    check_images(dataset, made.ICL)
    assert (dataset.camera.fx, dataset.camera.fy) == (481.2, 480.0)
    check_truth(dataset, slice(1, None))
    np.testing.assert_allclose(depth_of(dataset, 1), depth_raw(1, made.ICL) / 5000.0, rtol=1e-6)


def test_icl_nuim_in_its_own_layout_has_depth_along_the_ray(tmp_path: Path) -> None:
    folder, z = made.make_icl_own(tmp_path / "lr_kt0")
    dataset = open_dataset(folder)
    check_images(dataset, made.ICL)
    check_truth(dataset)
    np.testing.assert_allclose(depth_of(dataset, 1), z, rtol=1e-5)


def test_replica(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_replica(tmp_path))
    assert dataset.layout == "replica"
    check_camera(dataset)
    check_truth(dataset)
    np.testing.assert_allclose(depth_of(dataset, 2), depth_raw(2) / 6553.5, rtol=1e-6)
    assert abs(float(dataset.read(3).image_rgb.mean()) - 120) < 3


def test_scannet(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_scannet(tmp_path / "scene0000_00"))
    assert dataset.layout == "scannet"
    np.testing.assert_allclose(dataset.camera.K, CAMERA.scaled(32, 24).K)
    check_truth(dataset, [0, 1, 3])
    depth_m = depth_of(dataset, 1)
    np.testing.assert_allclose(depth_m[::2, ::2], depth_raw(1) / 1000.0, rtol=1e-6)
    assert "BundleFusion" in dataset.truth_source


def test_large_images_are_reduced_and_can_be_read_as_they_were(tmp_path: Path) -> None:
    folder = made.make_scannet(tmp_path / "scene0000_00")
    for image in (folder / "color").iterdir():
        write_image(image, np.full((960, 1280, 3), 77, np.uint8))
    larger = np.eye(4)
    larger[:3, :3] = CAMERA.scaled(1280, 960).K
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(made.rows(larger))
    dataset = open_dataset(folder)
    assert isinstance(dataset, Recording)
    frame, original = dataset.read(1, with_depth=True), dataset.read_original(1)
    assert frame.image_rgb.shape == (480, 640, 3)
    assert frame.depth_m is not None
    assert original.image_rgb.shape == (960, 1280, 3)
    np.testing.assert_allclose(original.camera.K, larger[:3, :3])
    np.testing.assert_allclose(frame.camera.K, CAMERA.scaled(640, 480).K)


@pytest.mark.parametrize("kind", [0, 1])
def test_scannet_sens(tmp_path: Path, kind: int) -> None:
    path = made.make_sens(tmp_path / "scene0000_00.sens", kind)
    dataset = open_dataset(path)
    assert (dataset.layout, dataset.name) == ("scannet-sens", "scene0000_00")
    check_images(dataset)
    check_camera(dataset)
    check_truth(dataset)
    np.testing.assert_allclose(depth_of(dataset, 3), depth_raw(3) / 1000.0, rtol=1e-6)
    path.write_bytes(path.read_bytes()[:-100])
    cut = open_dataset(path)
    assert len(cut) == COUNT - 1
    assert any("promises 4 frames, 3 are there" in note for note in cut.notes)


@pytest.mark.parametrize("name", ["walk.r3d", "unpacked"])
def test_record3d(tmp_path: Path, name: str) -> None:
    pytest.importorskip("lzfse", reason="depth of Record3D is unpacked by the extra [record3d]")
    dataset = open_dataset(made.make_record3d(tmp_path / name))
    assert (dataset.layout, dataset.name) == ("record3d", name.removesuffix(".r3d"))
    check_images(dataset)
    check_camera(dataset)
    check_truth(dataset)
    assert "ARKit" in dataset.truth_source
    assert any("ARKit" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.timestamps_s[:2], [100.0, 100.0 + 1 / 60])
    depth_m = depth_of(dataset, 1)
    assert depth_m.shape == (12, 16)
    assert (depth_m[:2] == 0).all()
    np.testing.assert_allclose(depth_m[2::2, ::2], depth_raw(1)[1:6, :8] / 1000.0, rtol=1e-6)


def test_record3d_without_the_package_has_no_depth_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "lzfse", None)
    dataset = open_dataset(made.make_record3d(tmp_path / "walk.r3d", packed=False))
    assert not dataset.has_depth
    assert any("pip install 'slamdepth[record3d]'" in note for note in dataset.notes)
    check_truth(dataset)


def test_record3d_exported_as_exr_and_rgb(tmp_path: Path) -> None:
    folder = tmp_path / "EXR_RGBD"
    files = made.record3d_files(packed=False)
    for i in range(COUNT):
        write_image(folder / "rgb" / f"{i}.png", image_rgb(i))
    (folder / "metadata.json").write_bytes(files["metadata"])
    dataset = open_dataset(folder)
    assert dataset.layout == "record3d"
    check_images(dataset)
    check_truth(dataset)


def test_an_archive_of_record3d_unpacks_nothing_it_should_not(tmp_path: Path) -> None:
    """A member that leads out of the archive is no frame, and one that is too large is not read."""
    path = made.make_record3d(tmp_path / "walk.r3d", packed=False)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("../../evil.jpg", b"x")
        archive.writestr("rgbd/4.jpg", b"\0" * (70 * 1024 * 1024))
    dataset = open_dataset(path)
    assert len(dataset) == COUNT + 1
    from slamdepth.errors import ImageDecodeError

    with pytest.raises(ImageDecodeError, match="has more than"):
        dataset.read(COUNT)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["walk.r3d"]


def test_stray_scanner(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_stray(tmp_path / "71de12f9"))
    assert (dataset.layout, dataset.name) == ("stray-scanner", "71de12f9")
    assert len(dataset) == COUNT
    np.testing.assert_allclose(dataset.camera.K, made.STRAY.K)
    check_truth(dataset)
    np.testing.assert_allclose(dataset.timestamps_s, [500.0 + i / 60 for i in range(COUNT)], atol=1e-6)
    frame = dataset.read(2, with_depth=True)
    assert abs(float(frame.image_rgb.mean()) - 100) < 6
    assert frame.depth_m is not None
    assert (frame.depth_m[:4] == 0).all()
    np.testing.assert_allclose(frame.depth_m[4::4, ::4], depth_raw(2)[1:] / 1000.0, rtol=1e-6)
    assert "ARKit" in dataset.truth_source


@pytest.mark.parametrize("named", ["", "transforms.json"])
def test_nerfstudio(tmp_path: Path, named: str) -> None:
    folder = made.make_nerfstudio(tmp_path / "room")
    dataset = open_dataset(folder / named)
    assert (dataset.layout, dataset.name) == ("nerfstudio", "room")
    check_images(dataset)
    check_camera(dataset, distortion=DISTORTED)
    check_truth(dataset, is_metric=False)
    np.testing.assert_allclose(depth_of(dataset, 2), depth_raw(2) / 1000.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "fx", "cx"),
    [
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 2 * float(np.arctan(0.4))}, 20.0, 7.5),
        ({"cx": None, "cy": None, "camera_model": None}, 20.0, 7.5),
        ({"w": 32, "h": 24, "fl_x": 40.0, "fl_y": 42.0, "cx": 16.0, "cy": 12.0}, 20.0, 7.5),
    ],
    ids=["instant-ngp's angle", "no centre", "smaller images"],
)
def test_transforms_of_other_tools(tmp_path: Path, changed: dict[str, Any], fx: float, cx: float) -> None:
    camera = open_dataset(made.make_nerfstudio(tmp_path, **changed)).camera
    assert camera.fx == pytest.approx(fx)
    assert camera.cx == pytest.approx(cx)


def test_transforms_with_a_lens_for_each_frame_and_names_without_ending(tmp_path: Path) -> None:
    folder = made.make_nerfstudio(tmp_path)
    values = json.loads((folder / "transforms.json").read_text())
    del values["fl_x"], values["fl_y"]
    for i, frame in enumerate(values["frames"]):
        frame |= {"fl_x": 20.0 + i, "fl_y": 21.0 + i}
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    (folder / "transforms.json").write_text(json.dumps(values))
    dataset = open_dataset(folder)
    check_images(dataset)
    assert dataset.camera.fx in (21.0, 22.0)
    assert any("fl_x is 20.0 to 23.0" in note for note in dataset.notes)


def test_polycam(tmp_path: Path) -> None:
    dataset = open_dataset(made.make_polycam(tmp_path / "export"))
    assert dataset.layout == "polycam"
    check_images(dataset)
    check_camera(dataset)
    check_truth(dataset)
    np.testing.assert_allclose(depth_of(dataset, 1)[::2, ::2], depth_raw(1)[:6, :8] / 1000.0, rtol=1e-6)
    assert "ARKit" in dataset.truth_source


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("below", ["sparse/0", "sparse"])
def test_colmap(tmp_path: Path, binary: bool, below: str) -> None:
    dataset = open_dataset(made.make_colmap(tmp_path / "castle", binary=binary, below=below))
    assert (dataset.layout, dataset.name) == ("colmap", "castle")
    check_images(dataset)
    check_camera(dataset, distortion=DISTORTED)
    check_truth(dataset, is_metric=False)
    assert "COLMAP" in dataset.truth_source


def test_a_pattern_takes_the_images_that_it_fits_in_natural_order(tmp_path: Path) -> None:
    for i in range(COUNT):
        write_image(tmp_path / f"img_{i + 8}.png", image_rgb(i))
    write_image(tmp_path / "img_8_depth.png", depth_raw(0))
    write_image(tmp_path / "other.png", image_rgb(9))
    write_camera(tmp_path / "camera.yaml", CAMERA)
    dataset = open_dataset(tmp_path / "img_[0-9].png", tmp_path / "camera.yaml")
    assert len(dataset) == 2
    dataset = open_dataset(str(tmp_path / "img_*[0-9].png"))
    assert dataset.layout == "pattern"
    check_images(dataset)
    with pytest.raises(DatasetError, match="fits no image"):
        open_dataset(tmp_path / "nothing_*.png")


def test_every_layout_has_a_reader_and_says_what_it_needs() -> None:
    names = [reader.name for reader in known_readers()]
    assert len(names) >= 17  # and folders of images
    assert all(reader.needs for reader in known_readers())


LAYOUTS: dict[str, Callable[[Path], Path]] = {
    "euroc": made.make_euroc,
    "kitti": made.make_kitti,
    "replica": made.make_replica,
    "scannet": made.make_scannet,
    "nerfstudio": made.make_nerfstudio,
    "colmap": lambda folder: made.make_colmap(folder, binary=True),
    "stray": made.make_stray,
    "polycam": made.make_polycam,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_camera_file_overrules_every_layout(tmp_path: Path, layout: str) -> None:
    folder = LAYOUTS[layout](tmp_path / "recording")
    size = (open_dataset(folder).camera.width, open_dataset(folder).camera.height)
    write_camera(tmp_path / "mine.yaml", CAMERA.scaled(*size))
    dataset = open_dataset(folder, tmp_path / "mine.yaml")
    assert not dataset.camera.is_distorted
    assert dataset.camera_source.how == "--camera"
    write_camera(tmp_path / "wrong.yaml", Camera(100, 100, 90.0, 90.0, 49.5, 49.5))
    with pytest.raises(CameraError, match="the camera says 100x100"):
        open_dataset(folder, tmp_path / "wrong.yaml")


@pytest.mark.parametrize(
    ("layout", "file", "text"),
    [
        ("euroc", "mav0/cam0/sensor.yaml", "intrinsics: [20, 21, 7.5, 5.5]\nresolution: [99, 12]\n"),
        ("replica", "../cam_params.json", "{}"),
        ("scannet", "intrinsic/intrinsic_color.txt", "0 0 0 0\n" * 4),
        ("stray", "camera_matrix.csv", "0 0 0\n" * 3),
    ],
)
def test_a_camera_file_takes_the_place_of_intrinsics_that_cannot_be_used(
    tmp_path: Path, layout: str, file: str, text: str
) -> None:
    folder = LAYOUTS[layout](tmp_path / "recording")
    size = (open_dataset(folder).camera.width, open_dataset(folder).camera.height)
    (folder / file).write_text(text)
    with pytest.raises(CameraError):
        open_dataset(folder)
    write_camera(tmp_path / "mine.yaml", CAMERA.scaled(*size))
    assert open_dataset(folder, tmp_path / "mine.yaml").camera_source.how == "--camera"


@pytest.mark.parametrize(
    ("layout", "file", "text", "message"),
    [
        ("euroc", "mav0/cam0/data.csv", "12,a.png\n11,b.png\n", "data.csv:2: time 11 does not come after 12"),
        ("euroc", "mav0/cam0/data.csv", "1e3,a.png\n", "data.csv:1: expected 'timestamp"),
        ("euroc", "mav0/cam0/sensor.yaml", "T_BS: 3\n", "sensor.yaml"),
        ("kitti", "calib.txt", "P2: 1 2 3\n", "calib.txt:1: expected 'P2:' and twelve numbers"),
        ("kitti", "times.txt", "0.1\nx\n", "times.txt:2: expected 1 numbers"),
        ("kitti", "../../poses/03.txt", "1 2\n", "03.txt:1: expected 12 numbers"),
        ("replica", "traj.txt", "1 2\n", "traj.txt:1: expected 16 numbers"),
        ("replica", "../cam_params.json", "{", "cam_params.json:1: not valid JSON"),
        ("replica", "../cam_params.json", '{"camera": {"w": true}}', "expected 'camera' with the numbers"),
        ("scannet", "pose/1.txt", "1 2 3\n", "1.txt:1: expected 4 lines of 4 numbers"),
        ("scannet", "intrinsic/intrinsic_color.txt", "0 0 0 0\n" * 4, "fx and fy must be positive"),
        ("nerfstudio", "transforms.json", "[]", "has no list 'frames'"),
        ("nerfstudio", "transforms.json", '{"frames": [1]}', "frame 0 has no 'file_path'"),
        ("colmap", "sparse/0/images.bin", "\x01\0\0\0", "images.bin: this file is cut short"),
        ("stray", "odometry.csv", "a, b\n", "odometry.csv: its first line must name the columns"),
        ("stray", "camera_matrix.csv", "1 2\n", "camera_matrix.csv:1: expected 3 lines of 3 numbers"),
    ],
)
def test_malformed_files_are_named_with_their_line(
    tmp_path: Path, layout: str, file: str, text: str, message: str
) -> None:
    folder = LAYOUTS[layout](tmp_path / "recording")
    (folder / file).write_text(text)
    with pytest.raises(InputError) as caught:
        open_dataset(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tum_vi_has_a_wide_lens_and_is_seen_as_by_a_pinhole(tmp_path: Path) -> None:
    folder = made.make_euroc(tmp_path / "dataset-room1_512_16", "mocap0")
    (folder / "mav0" / "cam0" / "sensor.yaml").unlink()
    for image in (folder / "mav0" / "cam0" / "data").iterdir():
        write_image(image, np.full((512, 512), 40000, np.uint16))
    T_camera_body = np.linalg.inv(poses(1, 3)[0]).tolist()
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text(
        f"cam0:\n  T_cam_imu: {json.dumps(T_camera_body)}\n  cam_overlaps: [1]\n  camera_model: pinhole\n"
        "  distortion_coeffs: [0.00348238, 0.00071503, -0.00205323, 0.00020293]\n"
        "  distortion_model: equidistant\n"
        "  intrinsics: [190.97847715, 190.97330705, 254.93170606, 256.89744280]\n"
        "  resolution: [512, 512]\n  rostopic: /cam0/image_raw\n"
    )
    dataset = open_dataset(folder)
    assert dataset.layout == "euroc"
    assert not dataset.camera.is_distorted
    assert dataset.imu_path is not None
    check_truth(dataset)
    seen = dataset.read(0).image_rgb
    assert seen.shape[:2] == (dataset.camera.height, dataset.camera.width)
    assert int(seen[seen.shape[0] // 2, seen.shape[1] // 2, 0]) == 40000 >> 8
