# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera from a topic of a bag, as ground truth: poses, odometry, or a tree of transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slamdepth.datasets.bag_file import BagFile
from slamdepth.datasets.poses import pose_of, trajectory_of
from slamdepth.errors import DatasetError
from slamdepth.geometry import invert
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

_TREE = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
_DEEPEST = 64


@dataclass
class _Edge:
    """Transforms from a frame to its parent, over time; a static one has one time."""

    parent: str
    is_static: bool = False
    times_s: list[float] = field(default_factory=list)
    T_parent_child: list[Floats] = field(default_factory=list)

    def at(self, times_s: Floats) -> list[Floats | None]:
        """``T_parent_child`` at each time; None beyond those that are known."""
        if self.is_static or len(self.times_s) == 1:
            return [self.T_parent_child[-1]] * len(times_s)
        from scipy.spatial.transform import Rotation, Slerp

        known_s, first = np.unique(np.array(self.times_s), return_index=True)
        T = np.stack([self.T_parent_child[i] for i in first])
        if len(known_s) == 1:
            return [T[0]] * len(times_s)
        inside = (times_s >= known_s[0]) & (times_s <= known_s[-1])
        at_s = np.clip(times_s, known_s[0], known_s[-1])
        found = np.tile(np.eye(4), (len(times_s), 1, 1))
        found[:, :3, :3] = Slerp(known_s, Rotation.from_matrix(T[:, :3, :3]))(at_s).as_matrix()
        for axis in range(3):
            found[:, axis, 3] = np.interp(at_s, known_s, T[:, axis, 3])
        return [pose if ok else None for pose, ok in zip(found, inside.tolist(), strict=True)]


def pose_topics(bag: BagFile) -> list[str]:
    """The topics that have poses, sorted by name."""
    return [name for name, one in sorted(bag.topics.items()) if one.count and one.type in (*_TREE, *_POSES)]


def poses_of_topic(
    bag: BagFile, topic: str, times_s: Floats, camera_frame: str, notes: list[str]
) -> Trajectory:
    """The camera's poses by a topic.

    Args:
        times_s: ``(N,)`` of the images.
        camera_frame: the frame that the images name.
        notes: takes a line for what was assumed.

    Raises:
        DatasetError: there is no such topic, it holds no poses, or none is valid.
    """
    found = bag.topics.get(topic)
    if found is None or found.type not in (*_TREE, *_POSES):
        known = pose_topics(bag)
        what = "there is no topic" if found is None else f"{found.type} is no pose:"
        raise DatasetError(f"{bag.path}: {what} {topic}; topics with poses: {', '.join(known) or 'none'}")
    if found.type in _TREE:
        trajectory = _from_tree(bag, topic, times_s, camera_frame, notes)
    else:
        trajectory = _from_poses(bag, topic, camera_frame, notes)
    if trajectory is None:
        raise DatasetError(f"{bag.path}: topic {topic} has no valid pose")
    return trajectory


def _from_poses(bag: BagFile, topic: str, camera_frame: str, notes: list[str]) -> Trajectory | None:
    stamps_s: list[float] = []
    poses: list[Floats | None] = []
    child = ""
    for message in bag.messages(topic):
        time_s = _seconds(message)
        if stamps_s and time_s <= stamps_s[-1]:
            continue
        child = str(getattr(message, "child_frame_id", "")) or child
        stamps_s.append(time_s)
        poses.append(_pose(message))
    T_child_camera = _static(bag, child, camera_frame) if child else None
    if T_child_camera is not None:
        poses = [None if T is None else T @ T_child_camera for T in poses]
        notes.append(f"{topic}: poses of {child} are those of the camera {camera_frame} by /tf_static")
    elif child.strip("/") != camera_frame.strip("/"):
        notes.append(
            f"{topic}: poses of {child or 'an unnamed body'} are taken as those of the camera "
            f"{camera_frame or '(unnamed)'}, since no /tf_static joins the two"
        )
    return trajectory_of(np.array(stamps_s), poses, notes)


def _from_tree(
    bag: BagFile, topic: str, times_s: Floats, camera_frame: str, notes: list[str]
) -> Trajectory | None:
    edges = _edges(bag, topic, is_static=False)
    if "/tf_static" in bag.topics and topic != "/tf_static":
        edges = {**edges, **_edges(bag, "/tf_static", is_static=True)}
    name = camera_frame.strip("/")
    if name not in edges:
        raise DatasetError(
            f"{bag.path}: the images are of the frame {camera_frame!r}, which {topic} does not place; it "
            f"places {', '.join(sorted(edges)[:20]) or 'none'}"
        )
    poses: list[Floats | None] = [np.eye(4)] * len(times_s)
    for _ in range(_DEEPEST):  # a tree with a cycle has no root
        if name not in edges:
            notes.append(f"ground truth: {camera_frame} in {name}, by {topic}")
            return trajectory_of(times_s, poses, notes)
        steps = edges[name].at(times_s)
        poses = [
            None if pose is None or step is None else step @ pose
            for pose, step in zip(poses, steps, strict=True)
        ]
        name = edges[name].parent
    raise DatasetError(f"{bag.path}: the frames of {topic} form a circle")


def _edges(bag: BagFile, topic: str, *, is_static: bool) -> dict[str, _Edge]:
    edges: dict[str, _Edge] = {}
    for message in bag.messages(topic):
        for one in message.transforms:
            child, parent = (str(name).strip("/") for name in (one.child_frame_id, one.header.frame_id))
            T = _pose(one)
            if T is None or child == parent:
                continue
            edge = edges.get(child)
            if edge is None or edge.parent != parent:
                edge = edges[child] = _Edge(parent, is_static)
            edge.times_s.append(_seconds(one))
            edge.T_parent_child.append(T)
    return edges


def _static(bag: BagFile, child: str, camera_frame: str) -> Floats | None:
    """``T_child_camera`` by ``/tf_static``; None where it does not join the two."""
    child, name = child.strip("/"), camera_frame.strip("/")
    if child == name:
        return np.eye(4)
    if "/tf_static" not in bag.topics:
        return None
    edges = _edges(bag, "/tf_static", is_static=True)
    up, down = _to_root(edges, name), _to_root(edges, child)
    for root, T_root_camera in up.items():
        if root in down:
            return np.asarray(invert(down[root]) @ T_root_camera)
    return None


def _to_root(edges: dict[str, _Edge], name: str) -> dict[str, Floats]:
    """The frames above one, and its pose in each; itself first."""
    found = {name: np.eye(4)}
    T = np.eye(4)
    while name in edges and len(found) < _DEEPEST:
        T = edges[name].T_parent_child[-1] @ T
        name = edges[name].parent
        found[name] = T
    return found


def _pose(message: Any) -> Floats | None:
    if hasattr(message, "transform"):
        position, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose
        pose = getattr(pose, "pose", pose)  # with covariance
        position, turn = pose.position, pose.orientation
    return pose_of(
        np.array([position.x, position.y, position.z], np.float64),
        np.array([turn.x, turn.y, turn.z, turn.w], np.float64),
    )


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
