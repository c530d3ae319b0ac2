# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1, ROS 2 and MCAP."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import KINDS, BagWriter, bag_path, encoded
from command_line import call
from sequences import CAMERA, depth_raw, image_rgb, imread, poses

from slamdepth.datasets import ReadOptions, open_dataset
from slamdepth.datasets.bag_images import _CONVERSIONS
from slamdepth.datasets.bag_images import depth_m as depth_of
from slamdepth.datasets.bag_images import image_rgb as rgb_of
from slamdepth.datasets.intrinsics import Certainty
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError
from slamdepth.geometry import invert
from slamdepth.types import Camera

pytest.importorskip("rosbags", reason="bags are read with rosbags: the extra [ros]")

LENS = Camera(16, 12, 20.0, 21.0, 7.5, 5.5, (0.01, -0.02, 0.001, 0.002, 0.0))
COUNT = 5
FRAME = "camera_color_optical_frame"


def times(count: int = COUNT) -> list[float]:
    return [100.0 + 0.1 * i for i in range(count)]


def write_bag(path: Path, kind: str, extra: Callable[[BagWriter], None] | None = None, **given: Any) -> Path:
    """A RealSense-like bag: colour, its camera_info, depth aligned to it and depth that is not."""
    camera = given.get("camera", LENS)
    with BagWriter(path, kind) as bag:
        for i, t in enumerate(times()):
            bag.write("/camera/color/image_raw", bag.image(t, FRAME, image_rgb(i), "rgb8"), t + 0.02)
            bag.write(
                "/camera/color/camera_info",
                bag.camera_info(t, FRAME, camera, **given.get("info", {})),
                t + 0.02,
            )
            aligned = bag.image(t + 0.004, FRAME, depth_raw(i), "16UC1")
            bag.write("/camera/aligned_depth_to_color/image_raw", aligned, t + 0.03)
            other = bag.image(t + 0.004, "camera_depth_optical_frame", depth_raw(90 + i)[:6, :8], "16UC1")
            bag.write("/camera/depth/image_rect_raw", other, t + 0.03)
            infrared = image_rgb(i)[..., 0]
            bag.write("/camera/infra1/image_rect_raw", bag.image(t, "infra1", infrared, "mono8"), t + 0.02)
        if extra is not None:
            extra(bag)
    return path


def test_topics_with_poses_are_named_until_one_is_taken(tmp_path: Path) -> None:
    def poses(bag: BagWriter) -> None:
        bag.write("/vicon/pose", bag.pose(100.0, "world", np.eye(4)), 100.0)

    path = write_bag(tmp_path / "a.bag", "ros1", poses)
    told = "topics with poses, not used: /vicon/pose; --pose-topic takes one as truth"
    assert told in open_dataset(path).notes
    taken = open_dataset(path, options=ReadOptions(pose_topic="/vicon/pose"))
    assert told not in taken.notes


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_read_without_a_camera_file(tmp_path: Path, kind: str) -> None:
    dataset = open_dataset(write_bag(bag_path(tmp_path, kind), kind))
    assert dataset.layout == "rosbag"
    assert dataset.name == "recording"
    np.testing.assert_allclose(dataset.timestamps_s, times())
    assert dataset.camera.distortion == LENS.distortion
    assert (dataset.camera.fx, dataset.camera.cy) == (20.0, 5.5)
    assert dataset.camera.fps == pytest.approx(10.0)
    assert dataset.camera_source.certainty is Certainty.GIVEN
    assert dataset.camera_source.how == "camera_info of /camera/color/image_raw"
    assert dataset.ground_truth is None
    assert dataset.has_depth
    for index in (0, 1, 2, 3, 4, 1, 4, 0):  # forwards, and to and fro
        frame = dataset.read(index, with_depth=True)
        np.testing.assert_array_equal(frame.image_rgb, image_rgb(index))
        assert frame.depth_m is not None
        np.testing.assert_allclose(frame.depth_m, depth_raw(index) / 1000.0, rtol=1e-6)
    assert any("--topic takes another: /camera/infra1/image_rect_raw" in note for note in dataset.notes)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_the_file_inside_a_bag_of_ros_2_is_read_with_or_without_its_metadata(
    tmp_path: Path, kind: str
) -> None:
    folder = write_bag(bag_path(tmp_path, kind), kind)
    (file,) = (path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    assert len(open_dataset(file)) == COUNT
    (folder / "metadata.yaml").unlink()
    assert len(open_dataset(folder)) == COUNT


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_can_be_chosen_and_its_depth(tmp_path: Path, kind: str) -> None:
    bag = write_bag(bag_path(tmp_path, kind), kind)
    dataset = open_dataset(bag, options=ReadOptions("/camera/infra1/image_rect_raw"))
    assert not dataset.has_depth
    assert dataset.camera_source.certainty is Certainty.GUESSED
    np.testing.assert_array_equal(dataset.read(2).image_rgb[..., 1], image_rgb(2)[..., 0])
    with_depth = open_dataset(bag, options=ReadOptions(depth_topic="/camera/depth/image_rect_raw"))
    depth_m = with_depth.read(1, with_depth=True).depth_m
    assert depth_m is not None
    assert set(np.unique(depth_m)) <= set(np.unique((depth_raw(91)[:6, :8] / 1000.0).astype(np.float32)))
    for options, message in (
        (ReadOptions("/nothing"), "no images in topic /nothing; topics with images: /camera/aligned"),
        (ReadOptions("/camera/depth/image_rect_raw"), "is depth"),
        (ReadOptions(depth_topic="/camera/color/image_raw"), "no depth in topic /camera/color/image_raw"),
        (ReadOptions(pose_topic="/odom"), "there is no topic /odom; topics with poses: none"),
    ):
        with pytest.raises(DatasetError, match=message):
            open_dataset(bag, options=options)


def test_depth_of_another_view_is_left_out_unasked(tmp_path: Path) -> None:
    path = tmp_path / "recording.bag"
    with BagWriter(path, "ros1") as bag:
        for i, t in enumerate(times()):
            bag.write("/color/image_raw", bag.image(t, FRAME, image_rgb(i), "bgr8"), t)
            bag.write("/depth/image_rect_raw", bag.image(t, "depth", depth_raw(i), "16UC1"), t)
    dataset = open_dataset(path)
    assert not dataset.has_depth
    assert any("/depth/image_rect_raw; --depth-topic takes it" in note for note in dataset.notes)
    np.testing.assert_array_equal(dataset.read(0).image_rgb, image_rgb(0)[..., ::-1])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_compressed_images_and_compressed_depth_are_read(tmp_path: Path, kind: str) -> None:
    path = bag_path(tmp_path, kind)
    raw = depth_raw(3)
    inverse = np.full((12, 16), 200, np.uint16)
    header = struct.pack("<iff", 0, 300.0, 50.0)
    with BagWriter(path, kind) as bag:
        for i, t in enumerate(times()):
            png = encoded(image_rgb(i)[..., ::-1], ".png")
            bag.write(
                "/cam/rgb/image_raw/compressed", bag.compressed(t, FRAME, png, "rgb8; png compressed bgr8"), t
            )
            bag.write("/cam/rgb/camera_info", bag.camera_info(t, FRAME, LENS), t)
            deep = header + encoded(raw if i else inverse, ".png")
            form = "16UC1; compressedDepth png" if i else "32FC1; compressedDepth png"
            bag.write("/cam/depth_registered/image/compressedDepth", bag.compressed(t, FRAME, deep, form), t)
    dataset = open_dataset(path)
    assert dataset.camera.fx == 20.0
    first, second = (dataset.read(index, with_depth=True) for index in (0, 1))
    np.testing.assert_array_equal(second.image_rgb, image_rgb(1))
    assert first.depth_m is not None
    assert second.depth_m is not None
    np.testing.assert_allclose(first.depth_m, 2.0)
    np.testing.assert_allclose(second.depth_m, raw / 1000.0, rtol=1e-6)


def message(pixels: np.ndarray, encoding: str, **given: Any) -> Any:
    class Message:
        height, width = pixels.shape[:2]
        is_bigendian = given.get("big", 0)
        data = np.frombuffer(
            pixels.astype(pixels.dtype.newbyteorder(">" if is_bigendian else "<")).tobytes(), np.uint8
        )
        step = given.get("step", data.size // height)

    Message.encoding = encoding  # type: ignore[attr-defined]
    return Message()


def test_every_encoding_becomes_the_colours_it_means() -> None:
    colours = np.zeros((8, 8, 3), np.uint8)
    colours[..., 0], colours[..., 1], colours[..., 2] = 200, 120, 40
    grey = np.full((8, 8), 90, np.uint8)
    alpha = np.dstack([colours, np.full((8, 8), 255, np.uint8)])
    yuv = cv2.cvtColor(colours, cv2.COLOR_RGB2YUV)
    uyvy, yuyv = np.empty((8, 8, 2), np.uint8), np.empty((8, 8, 2), np.uint8)
    uyvy[..., 1] = yuyv[..., 0] = 16 + 219.0 / 255.0 * yuv[..., 0]
    uyvy[:, ::2, 0] = yuyv[:, ::2, 1] = 128 + (yuv[:, ::2, 1] - 128.0) * 0.79 * 1.14
    uyvy[:, 1::2, 0] = yuyv[:, 1::2, 1] = 128 + (yuv[:, 1::2, 2] - 128.0) * 0.72 * 0.79 * 1.42
    mosaics: dict[str, np.ndarray] = {}
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        channels = ["rgb".index(letter) for letter in pattern]
        mosaic = np.empty((8, 8), np.uint8)
        for place, channel in enumerate(channels):
            mosaic[place // 2 :: 2, place % 2 :: 2] = colours[0, 0, channel]
        mosaics |= {f"bayer_{pattern}8": mosaic, f"bayer_{pattern}16": mosaic.astype(np.uint16) * 256}
    images = {
        "rgb8": colours,
        "bgr8": colours[..., ::-1],
        "8uc3": colours[..., ::-1],
        "rgba8": alpha,
        "bgra8": alpha[..., [2, 1, 0, 3]],
        "8uc4": alpha[..., [2, 1, 0, 3]],
        "mono8": grey,
        "8uc1": grey,
        "mono16": grey.astype(np.uint16) * 256,
        "rgb16": colours.astype(np.uint16) * 256,
        "bgr16": colours[..., ::-1].astype(np.uint16) * 256,
        "yuv422": uyvy,
        "uyvy": uyvy,
        "yuv422_yuy2": yuyv,
        "yuyv": yuyv,
        **mosaics,
    }
    assert set(images) == set(_CONVERSIONS)
    for encoding, pixels in images.items():
        expected = np.dstack([grey] * 3) if encoding in ("mono8", "8uc1", "mono16") else colours
        for big in (0, 1):
            found = rgb_of(message(np.ascontiguousarray(pixels), encoding, big=big), "image")
            within = 12 if "uy" in encoding or "yuv" in encoding else 1
            assert np.abs(found.astype(int) - expected)[2:-2, 2:-2].max() <= within, encoding


def test_depth_in_either_encoding_and_byte_order_is_in_metres() -> None:
    raw = depth_raw(0)
    metres = raw.astype(np.float32) / 1000
    metres[0, :3] = np.nan, -1.0, np.inf
    expected = raw.astype(np.float32) / 1000
    for big in (0, 1):
        np.testing.assert_allclose(depth_of(message(raw, "16UC1", big=big), "depth"), expected)
        found = depth_of(message(metres, "32FC1", big=big), "depth")
        assert (found[0, :3] == 0).all()
        np.testing.assert_allclose(found[1:], expected[1:])
    with pytest.raises(ImageDecodeError, match="are no depth"):
        depth_of(message(image_rgb(0), "rgb8"), "depth")


def test_images_of_impossible_sizes_do_not_decode() -> None:
    good = message(image_rgb(0), "rgb8")
    for name, value in (("height", 13), ("width", 17), ("step", 47), ("height", 2**31), ("width", 0)):
        bad = message(image_rgb(0), "rgb8")
        setattr(bad, name, value)
        with pytest.raises(ImageDecodeError):
            rgb_of(bad, "image")
    with pytest.raises(ImageDecodeError, match="encoding 'h264' are not read"):
        rgb_of(message(image_rgb(0), "h264"), "image")
    np.testing.assert_array_equal(rgb_of(good, "image"), image_rgb(0))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_become_ground_truth_only_where_asked_for(tmp_path: Path, kind: str) -> None:
    T_world_base = poses(COUNT, 1)
    T_world_base[:, :3, :3] = T_world_base[0, :3, :3]  # so that poses in between are known exactly
    static = poses(2, 3)

    def extra(bag: BagWriter) -> None:
        for i, t in enumerate(times()):
            bag.write("/vicon", bag.pose(t, "world", T_world_base[i]), t)
            bag.write("/base", bag.transform(t, "world", "base", T_world_base[i]), t)
            moving = [bag.transform(t, "map", "base", T_world_base[i])]
            bag.write("/tf", bag.tree(moving), t)
        fixed = [
            bag.transform(100.0, "base", "link", static[0]),
            bag.transform(100.0, "link", FRAME, static[1]),
        ]
        bag.write("/tf_static", bag.tree(fixed), 100.0)

    path = write_bag(bag_path(tmp_path, kind), kind, extra)
    assert open_dataset(path).ground_truth is None
    vicon = open_dataset(path, options=ReadOptions(pose_topic="/vicon"))
    assert vicon.ground_truth is not None
    np.testing.assert_allclose(vicon.ground_truth.T_world_camera, T_world_base, atol=1e-9)
    assert any("taken as those of the camera" in note for note in vicon.notes)
    T_base_camera = static[0] @ static[1]
    for topic in ("/base", "/tf"):
        truth = open_dataset(path, options=ReadOptions(pose_topic=topic)).ground_truth
        assert truth is not None
        np.testing.assert_allclose(truth.timestamps_s, times())
        np.testing.assert_allclose(truth.T_world_camera @ invert(T_base_camera), T_world_base, atol=1e-9)


def test_a_rectified_topic_has_the_projection_and_no_distortion(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for i, t in enumerate(times()):
            bag.write("/cam/image_rect_color", bag.image(t, FRAME, image_rgb(i), "rgb8"), t)
            bag.write("/cam/camera_info", bag.camera_info(t, FRAME, LENS), t)
    camera = open_dataset(tmp_path / "a.bag").camera
    assert not camera.is_distorted
    assert camera.fx == 20.0


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({"K": np.zeros(9)}, "never calibrated"),
        ({"model": "plumb_bob", "D": []}, None),
    ],
)
def test_an_uncalibrated_camera_is_guessed(
    tmp_path: Path, info: dict[str, Any], expected: str | None
) -> None:
    dataset = open_dataset(write_bag(tmp_path / "a.bag", "ros1", info=info))
    is_guess = dataset.camera_source.certainty is Certainty.GUESSED
    assert is_guess == (expected is not None)
    assert expected is None or any(expected in note for note in dataset.notes)


def test_camera_info_of_a_larger_image_is_scaled_and_of_another_shape_refused(tmp_path: Path) -> None:
    larger = Camera(32, 24, 40.0, 42.0, 15.5, 11.5)
    dataset = open_dataset(write_bag(tmp_path / "a.bag", "ros1", camera=larger))
    assert dataset.camera.fx == pytest.approx(20.0)
    with pytest.raises(CameraError, match="another shape"):
        open_dataset(write_bag(tmp_path / "b.bag", "ros1", camera=Camera(32, 18, 40.0, 42.0, 15.5, 8.5)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_damaged_bag_is_refused_in_one_line_that_says_what_to_do(
    tmp_path: Path, kind: str, share: float
) -> None:
    path = write_bag(bag_path(tmp_path, kind), kind)
    file = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    fix = {"ros1": "rosbag reindex", "mcap": "mcap recover|ros2 bag reindex", "sqlite3": "ros2 bag reindex"}[
        kind
    ]
    with pytest.raises(DatasetError, match=fix) as caught:
        open_dataset(path)
    assert "\n" not in str(caught.value)


def test_a_bag_without_images_names_its_topics(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        bag.write("/odom", bag.pose(1.0, "world", np.eye(4)), 1.0)
    with pytest.raises(
        DatasetError, match=r"has no images; its topics: /odom \(geometry_msgs/msg/PoseStamped\)"
    ):
        open_dataset(tmp_path / "a.bag")
    (tmp_path / "b.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(DatasetError, match="never closed; try: rosbag reindex"):
        open_dataset(tmp_path / "b.bag.active")


def test_stamps_that_are_not_set_give_way_to_the_recorders_times(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for i, t in enumerate(times()):
            bag.write("/cam/image_raw", bag.image(0.0, FRAME, image_rgb(i), "rgb8"), t)
    dataset = open_dataset(tmp_path / "a.bag")
    np.testing.assert_allclose(dataset.timestamps_s, times())
    assert any("those of the recorder" in note for note in dataset.notes)


def test_what_is_assumed_of_times_is_told_of_images_and_of_depth(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for i, t in enumerate([*times(), times()[-1]]):
            bag.write("/cam/image_raw", bag.image(0.0, FRAME, image_rgb(i), "rgb8"), t)
            bag.write("/cam/aligned_depth", bag.image(0.0, FRAME, depth_raw(i), "16UC1"), t)
    dataset = open_dataset(tmp_path / "a.bag")
    for topic in ("/cam/image_raw", "/cam/aligned_depth"):
        assert f"{topic}: stamps are not set; times are those of the recorder" in dataset.notes
        assert f"{topic}: 1 messages repeat a time and are left out" in dataset.notes


def test_messages_out_of_order_come_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    order = [0, 1, 3, 2, 4, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20]
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for place, i in enumerate(order):
            image = bag.image(100.0 + 0.1 * i, FRAME, image_rgb(i), "rgb8")
            bag.write("/cam/image_raw", image, 200.0 + place // 3)  # three at a time in one chunk
    dataset = open_dataset(tmp_path / "a.bag")
    assert len(dataset) == 21
    for index in (2, 3, 20, 0, 10):
        np.testing.assert_array_equal(dataset.read(index).image_rgb, image_rgb(index))
    assert any("1 messages repeat a time" in note for note in dataset.notes)


def test_one_command_makes_a_mesh_of_a_bag(tiny_room: Path, tmp_path: Path) -> None:
    """Bag to mesh without a camera file."""
    camera = Camera.from_file(tiny_room / "camera.yaml")
    images, depths = (sorted((tiny_room / kind).iterdir()) for kind in ("rgb", "depth"))
    path = tmp_path / "walk"
    with BagWriter(path, "mcap") as bag:
        for i, (image, depth) in enumerate(zip(images, depths, strict=True)):
            t = 10.0 + i / 30.0
            bag.write("/camera/color/image_raw", bag.image(t, FRAME, imread(image), "bgr8"), t)
            bag.write("/camera/color/camera_info", bag.camera_info(t, FRAME, camera), t)
            raw = imread(depth, cv2.IMREAD_UNCHANGED)
            metres = raw.astype(np.float32) / np.float32(camera.depth_factor)
            bag.write("/camera/aligned_depth_to_color/image_raw", bag.image(t, FRAME, metres, "32FC1"), t)
    done = call("run", path, "--depth", "sensor", "--output", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "mesh.ply").stat().st_size > 10_000
    told = call("info", path, "--json")
    assert told.returncode == 0, told.stderr
    assert '"layout": "rosbag"' in told.stdout


def test_info_names_the_camera_file_over_camera_info(tmp_path: Path) -> None:
    from slamdepth.datasets import write_camera

    write_camera(tmp_path / "mine.yaml", CAMERA)
    dataset = open_dataset(write_bag(tmp_path / "a.bag", "ros1"), tmp_path / "mine.yaml")
    assert dataset.camera_source.how == "--camera"
    assert not dataset.camera.is_distorted
