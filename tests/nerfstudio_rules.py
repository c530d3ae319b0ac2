# SPDX-License-Identifier: Apache-2.0
"""The rules by which nerfstudio's ``nerfstudio_dataparser.py`` reads a ``transforms.json``, written down.

Orientation and scaling, which the parser does by its own settings, are left out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from slamdepth.geometry import invert, transform
from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Floats

CAMERA_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"}
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class ReadTransforms:
    """What the parser makes of a folder; poses have our axes, pixels integer centres."""

    width: int
    height: int
    K: Floats
    T_world_camera: Floats
    points: Floats

    def project(self, number: int, points: Floats) -> Floats:
        """Pixels ``(N, 2)`` of points in front of a camera."""
        points_c = transform(invert(self.T_world_camera[number]), points)
        points_c = points_c[points_c[:, 2] > 0.1]
        px = points_c @ self.K.T
        return np.asarray(px[:, :2] / px[:, 2:])


def read_transforms(folder: Path) -> ReadTransforms:
    """Read a folder by the parser's rules.

    Raises:
        AssertionError: the parser would refuse it, or show something else than is meant.
    """
    meta: dict[str, Any] = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    # intrinsics for all frames; a distortion key for all frames means that none is in a frame
    for key in ("fl_x", "fl_y", "cx", "cy"):
        assert float(meta[key]) > 0
    assert meta["camera_model"] in CAMERA_MODELS
    assert isinstance(meta["w"], int)
    assert isinstance(meta["h"], int)
    frames = meta["frames"]
    names = [frame["file_path"] for frame in frames]
    # the parser sorts frames by name
    assert names == sorted(names)
    assert len(set(names)) == len(names) > 1
    poses = np.array([frame["transform_matrix"] for frame in frames])
    assert poses.shape == (len(frames), 4, 4)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (len(frames), 1)))
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-6)
    for name in names:
        with Image.open(folder / name) as image:
            assert image.size == (meta["w"], meta["h"])
    assert max(meta["w"], meta["h"]) > 0
    assert meta.get("orientation_override", "none") in ("pca", "up", "vertical", "none")
    # older versions apply applied_transform to the points of ply_file_path, newer ones do not
    applied = np.array(meta["applied_transform"])
    assert applied.shape == (3, 4)
    points = np.zeros((0, 3))
    if "ply_file_path" in meta:
        cloud = import_open3d().io.read_point_cloud(str(folder / meta["ply_file_path"]))
        points = np.asarray(cloud.points)
        assert len(points) > 0
        assert len(cloud.colors) == len(points)
        np.testing.assert_allclose(points @ applied[:, :3].T + applied[:, 3], points)
    K = np.array([[meta["fl_x"], 0, meta["cx"] - 0.5], [0, meta["fl_y"], meta["cy"] - 0.5], [0, 0, 1.0]])
    return ReadTransforms(meta["w"], meta["h"], K, poses @ OPENGL, points)
