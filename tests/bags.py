# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and ROS 2 for tests, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slamdepth.types import Camera

KINDS = ("ros1", "mcap", "sqlite3")


class BagWriter:
    """Writes messages by topic into ``path``: a ``.bag``, or the folder of a bag of ROS 2.

    Args:
        kind: one of ``KINDS``.
    """

    def __init__(self, path: Path, kind: str) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.is1 = kind == "ros1"
        self.store: Any = get_typestore(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)
        if self.is1:
            text = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.types: Any = self.store.types
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self._writer: Any = Writer1(path) if self.is1 else Writer(path, version=8, storage_plugin=plugin)
        self._topics: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def write(self, topic: str, message: Any, time_s: float) -> None:
        name = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, name, typestore=self.store)
        raw = (
            self.store.serialize_ros1(message, name) if self.is1 else self.store.serialize_cdr(message, name)
        )
        self._writer.write(self._topics[topic], round(1e9 * time_s), raw)

    def make(self, name: str, **fields: Any) -> Any:
        """A message of a type such as ``sensor_msgs/Image``."""
        package, short = name.split("/")
        return self.types[f"{package}/msg/{short}"](**fields)

    def header(self, time_s: float, frame: str) -> Any:
        nanoseconds = round(1e9 * time_s)
        stamp = self.types["builtin_interfaces/msg/Time"](
            sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        more = {"seq": 0} if self.is1 else {}
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **more)

    def image(
        self,
        time_s: float,
        frame: str,
        pixels: NDArray[Any],
        encoding: str,
        *,
        padding: int = 0,
        big: bool = False,
    ) -> Any:
        height, width = pixels.shape[:2]
        pixels = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return self.make(
            "sensor_msgs/Image",
            header=self.header(time_s, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=int(big),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, time_s: float, frame: str, data: bytes, kind: str) -> Any:
        return self.make(
            "sensor_msgs/CompressedImage",
            header=self.header(time_s, frame),
            format=kind,
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(
        self, time_s: float, frame: str, camera: Camera, model: str = "plumb_bob", **given: Any
    ) -> Any:
        K = given.get("K", camera.K.ravel())
        P = np.zeros((3, 4))
        P[:, :3] = np.asarray(K).reshape(3, 3)
        fields = {
            "D": np.array(given.get("D", camera.distortion)),
            "K": K,
            "R": np.eye(3).ravel(),
            "P": P.ravel(),
        }
        roi = self.make(
            "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(time_s, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **{name if self.is1 else name.lower(): np.asarray(v, np.float64) for name, v in fields.items()},
        )

    def transform(self, time_s: float, parent: str, child: str, T: NDArray[np.float64]) -> Any:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        return self.make(
            "geometry_msgs/TransformStamped",
            header=self.header(time_s, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/Transform",
                translation=self.make("geometry_msgs/Vector3", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
                rotation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )

    def tree(self, transforms: Iterable[Any]) -> Any:
        return self.make("tf2_msgs/TFMessage", transforms=list(transforms))

    def pose(self, time_s: float, frame: str, T: NDArray[np.float64]) -> Any:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        return self.make(
            "geometry_msgs/PoseStamped",
            header=self.header(time_s, frame),
            pose=self.make(
                "geometry_msgs/Pose",
                position=self.make("geometry_msgs/Point", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
                orientation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )


def bag_path(folder: Path, kind: str, name: str = "recording") -> Path:
    return folder / (f"{name}.bag" if kind == "ros1" else name)


def encoded(image: NDArray[Any], ending: str) -> bytes:
    ok, data = cv2.imencode(ending, image)
    assert ok
    return data.tobytes()


def small_bag(path: Path, kind: str) -> Path:
    """Four images with their camera and depth, and poses."""
    from sequences import CAMERA, depth_raw, image_rgb

    with BagWriter(path, kind) as bag:
        for i in range(4):
            time_s = 100.0 + 0.1 * i
            bag.write("/cam/image_raw", bag.image(time_s, "optical", image_rgb(i), "rgb8"), time_s)
            bag.write("/cam/camera_info", bag.camera_info(time_s, "optical", CAMERA), time_s)
            bag.write("/cam/depth_registered", bag.image(time_s, "optical", depth_raw(i), "16UC1"), time_s)
            bag.write("/pose", bag.pose(time_s, "world", np.eye(4)), time_s)
    return path
