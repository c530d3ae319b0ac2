# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 (``.bag``) and ROS 2 (a folder with ``metadata.yaml``, ``.db3``, ``.mcap``).

Intrinsics are those of the ``camera_info`` next to the images. Messages are indexed once and decoded one at a
time. Poses become ground truth only where a topic is asked for: they may be an estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.association import associate
from slamdepth.datasets.bag_file import ENDINGS, BagFile, TopicIndex, TopicReader
from slamdepth.datasets.bag_images import (
    COMPRESSED,
    IMAGE,
    depth_m,
    encoding_of,
    image_rgb,
    is_colour,
    is_depth,
)
from slamdepth.datasets.bag_poses import pose_topics, poses_of_topic
from slamdepth.datasets.options import ReadOptions
from slamdepth.datasets.recording import Recording, camera_for, recorded_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import MAX_TIME_DIFFERENCE_S
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats32

_INFO = "sensor_msgs/msg/CameraInfo"
_METADATA = "metadata.yaml"
_UNLIKELY = (
    "infra",
    "ir/",
    "right",
    "cam1",
    "fisheye",
    "thermal",
    "mask",
    "label",
    "debug",
    "depth",
    "image_2",
)
"""Parts of names of topics that are seldom the camera of a recording."""
_FEW = 0.1
"""Topics with less than this share of the largest number of images are not taken unasked."""
_REGISTERED = ("aligned", "registered")


@register_reader
class RosbagReader:
    """Opens bags of ROS 1, ROS 2 and MCAP."""

    name = "rosbag"
    needs = f"a bag: {', '.join(ENDINGS)}, or a folder of ROS 2 with {_METADATA}"

    def matches(self, path: Path) -> bool:
        if path.is_dir():
            return (path / _METADATA).is_file() or _storage_of(path) is not None
        return path.name.endswith((*ENDINGS, ".bag.active")) and path.is_file()

    def open(self, path: Path, camera: Camera | None) -> Recording:
        return self.open_with(path, camera, ReadOptions())

    def open_with(self, path: Path, camera: Camera | None, options: ReadOptions) -> Recording:
        if path.name.endswith(".active"):
            raise DatasetError(
                f"{path}: this bag was never closed; try: rosbag reindex {path}, then rename it"
            )
        if path.is_dir() and not (path / _METADATA).is_file():
            path = _storage_of(path) or path
        bag = BagFile(path)
        notes: list[str] = []
        views = _views(bag)
        view = _chosen_view(bag, views, options.topic, notes)
        index = bag.index(view.topic)
        notes += index.notes
        shape = _first_shape(bag, view)
        taken_by, source = camera_for(
            path, shape, camera, lambda: _camera_of(bag, view, shape, notes), f"camera_info of {view.topic}"
        )
        truth = None
        if options.pose_topic is not None:
            truth = poses_of_topic(bag, options.pose_topic, index.times_s, view.frame, notes)
        elif known := pose_topics(bag):
            notes.append(f"topics with poses, not used: {', '.join(known)}; --pose-topic takes one as truth")
        depth = _depth_of(bag, views, view, index, taken_by, options.depth_topic, notes)
        images = _Images(bag.reader_of(view.topic, index), view.topic)
        return Recording(
            path.name.removesuffix(path.suffix) if path.suffix in ENDINGS else path.resolve().name,
            path,
            taken_by,
            index.times_s,
            images.read,
            depth=depth,
            truth=truth,
            notes=notes,
            source=source,
        )


@dataclass(frozen=True)
class _View:
    """An image topic, and what its first message tells.

    Attributes:
        encoding: in small letters; of a compressed one its format.
        frame: the frame of the camera.
        size: (width, height), None of compressed images.
    """

    topic: str
    count: int
    is_compressed: bool
    encoding: str
    frame: str
    size: tuple[int, int] | None

    @property
    def is_depth(self) -> bool:
        return is_depth(self.encoding, self.topic)

    @property
    def base(self) -> str:
        """The topic without the ending of a transport."""
        end = self.topic.rsplit("/", 1)[-1]
        return self.topic.rsplit("/", 1)[0] if end in ("compressed", "compressedDepth") else self.topic


class _Images:
    def __init__(self, reader: TopicReader, topic: str) -> None:
        self._reader, self._topic = reader, topic

    def read(self, index: int) -> Bytes:
        message, what = _message(self._reader, self._topic, index)
        return image_rgb(message, what)


class _Depths:
    """Depth images by the frames of the colour camera; ``numbers`` has -1 where there is none."""

    def __init__(self, reader: TopicReader, topic: str, numbers: list[int]) -> None:
        self._reader, self._topic, self._numbers = reader, topic, numbers

    def read(self, index: int) -> Floats32 | None:
        number = self._numbers[index]
        if number < 0:
            return None
        message, what = _message(self._reader, self._topic, number)
        return depth_m(message, what)


def _message(reader: TopicReader, topic: str, index: int) -> tuple[Any, str]:
    what = f"{topic}, image {index}"
    try:
        return reader.read(index), what
    except DatasetError as error:  # one damaged chunk costs its images, not the run
        raise ImageDecodeError(f"{what}: {error}") from error


def _storage_of(folder: Path) -> Path | None:
    """The only storage file of a folder of ROS 2 whose metadata is missing; None where there is none."""
    found = [path for ending in (".mcap", ".db3") for path in sorted(folder.glob(f"*{ending}"))]
    if len(found) > 1:
        raise DatasetError(
            f"{folder}: holds {len(found)} files of a bag but no {_METADATA}; try: ros2 bag reindex "
            f"{folder}, or name one of them, such as {found[0].name}"
        )
    return found[0] if found else None


def _views(bag: BagFile) -> list[_View]:
    views = []
    for topic in sorted(bag.topics.values(), key=lambda one: one.name):
        if topic.type not in (IMAGE, COMPRESSED) or not topic.count:
            continue
        message = bag.first(topic.name)
        if message is None:
            continue
        size = (int(message.width), int(message.height)) if topic.type == IMAGE else None
        frame = str(message.header.frame_id)
        views.append(
            _View(topic.name, topic.count, topic.type == COMPRESSED, encoding_of(message), frame, size)
        )
    return views


def _chosen_view(bag: BagFile, views: list[_View], asked: str | None, notes: list[str]) -> _View:
    if asked is not None:
        for view in views:
            if asked in (view.topic, view.base):
                if view.is_depth:
                    raise DatasetError(f"{bag.path}: topic {asked} is depth ({view.encoding}), no images")
                return view
        raise DatasetError(f"{bag.path}: no images in topic {asked}; {_named(bag, views)}")
    colour = [view for view in views if not view.is_depth]
    if not colour:
        raise DatasetError(f"{bag.path}: has no images; {_named(bag, views)}")
    most = max(view.count for view in colour)

    def rank(view: _View) -> tuple[bool, bool, bool, bool, str]:
        is_unlikely = any(word in view.topic.lower() for word in _UNLIKELY)
        is_video = "h264" in view.encoding or "h265" in view.encoding
        return (
            is_video or view.count < _FEW * most,
            is_unlikely,
            not is_colour(view.encoding),
            view.is_compressed,
            view.topic,
        )

    best = min(colour, key=rank)
    others = [view.topic for view in colour if view is not best]
    rest = f"; --topic takes another: {', '.join(others)}" if others else ""
    notes.append(f"images of the topic {best.topic}{rest}")
    return best


def _named(bag: BagFile, views: list[_View]) -> str:
    if views:
        return f"topics with images: {', '.join(view.topic for view in views)}"
    found = [f"{topic.name} ({topic.type})" for topic in sorted(bag.topics.values(), key=lambda t: t.name)]
    return f"its topics: {', '.join(found[:20]) or 'none'}"


def _first_shape(bag: BagFile, view: _View) -> tuple[int, ...]:
    trouble: ImageDecodeError | None = None
    for number, message in enumerate(bag.messages(view.topic)):
        try:
            return image_rgb(message, f"{view.topic}, image {number}").shape
        except ImageDecodeError as error:
            trouble = trouble or error
    raise DatasetError(f"{bag.path}: none of the images decodes; the first: {trouble}")


def _camera_of(bag: BagFile, view: _View, shape: tuple[int, ...], notes: list[str]) -> Camera | None:
    """The camera by its ``camera_info``; None where there is none, or it was never calibrated."""
    info = _info_of(bag, view)
    if info is None:
        notes.append(f"no camera_info belongs to {view.topic}")
        return None
    K, D, P = (np.asarray(getattr(info, n, getattr(info, n.lower(), ())), np.float64) for n in "KDP")
    model = str(info.distortion_model)
    if view.base.rsplit("/", 1)[-1].startswith("image_rect") and len(P) == 12 and P[0] > 0:
        K, D = P.reshape(3, 4)[:, :3].ravel(), np.zeros(0)
    if len(K) != 9 or not K[0] > 0:
        notes.append(f"camera_info of {view.topic} is empty: this camera was never calibrated")
        return None
    values = {
        "image_width": int(info.width) or shape[1],
        "image_height": int(info.height) or shape[0],
        "camera_matrix": K.reshape(3, 3).tolist(),
        "distortion_model": model,
        "distortion_coefficients": D.tolist(),
    }
    return recorded_camera(Path(f"{bag.path}: camera_info of {view.topic}"), values, shape, notes)


def _info_of(bag: BagFile, view: _View) -> Any:
    """The first ``camera_info`` of the same camera; None where there is none."""
    infos = sorted(topic.name for topic in bag.topics.values() if topic.type == _INFO and topic.count)
    above = view.base.rsplit("/", 1)[0]
    sibling = f"{above}/camera_info"
    if sibling in infos:
        return bag.first(sibling)
    for name in infos:
        message = bag.first(name)
        if message is None:
            continue
        is_same_size = view.size is None or view.size == (int(message.width), int(message.height))
        if is_same_size and (
            str(message.header.frame_id) == view.frame != "" or name.startswith(f"{view.base}/")
        ):
            return message
    return None


def _depth_of(
    bag: BagFile,
    views: list[_View],
    view: _View,
    index: TopicIndex,
    camera: Camera,
    asked: str | None,
    notes: list[str],
) -> Any:
    """What reads the depth of a frame; None where there is none that belongs to the colour image."""
    depth = [one for one in views if one.is_depth]
    if asked is not None:
        depth = [one for one in depth if asked in (one.topic, one.base)]
        if not depth:
            raise DatasetError(f"{bag.path}: no depth in topic {asked}; {_named(bag, views)}")
        chosen = depth[0]
    else:
        fitting = [one for one in depth if _is_registered(one, view, camera)]
        if depth and not fitting:
            names = ", ".join(one.topic for one in depth)
            notes.append(
                f"depth of another view than the images' is left out: {names}; --depth-topic takes it"
            )
        if not fitting:
            return None
        chosen = min(fitting, key=lambda one: (one.is_compressed, one.topic))
    found = bag.index(chosen.topic)
    notes += found.notes
    numbers = [-1] * len(index.times_s)
    for i, j in associate(index.times_s, found.times_s, MAX_TIME_DIFFERENCE_S):
        numbers[i] = j
    without = numbers.count(-1)
    notes.append(f"depth of the topic {chosen.topic}")
    if without == len(numbers):
        notes.append(f"none of its images is within {MAX_TIME_DIFFERENCE_S} s of a colour image")
        return None
    if without:
        notes.append(f"{without} of {len(numbers)} images have no depth within {MAX_TIME_DIFFERENCE_S} s")
    return _Depths(bag.reader_of(chosen.topic, found), chosen.topic, numbers).read


def _is_registered(depth: _View, colour: _View, camera: Camera) -> bool:
    """True where depth is in the view of the colour camera, by its frame, its name and its size."""
    if depth.frame and colour.frame and depth.frame != colour.frame:
        return False
    if any(word in depth.topic.lower() for word in _REGISTERED):
        return True
    is_same_size = depth.size is None or depth.size == (camera.width, camera.height)
    return is_same_size and depth.frame == colour.frame != ""
