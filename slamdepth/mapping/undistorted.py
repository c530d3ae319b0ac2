# SPDX-License-Identifier: Apache-2.0
"""Images and depth of keyframes as a pinhole camera would see them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.keyframe import Keyframe
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray


def undistorted_depth(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Undistort depth ``(H, W)`` by nearest neighbour: a mean of two surfaces lies on neither."""
    if not camera.is_distorted:
        return depth_m
    import cv2

    x, y = _undistortion_maps(camera)
    return np.asarray(cv2.remap(depth_m, x, y, cv2.INTER_NEAREST, borderValue=0), np.float32)


def undistorted_color(keyframe: Keyframe) -> NDArray[np.uint8]:
    """The image ``(H, W, 3)`` of a keyframe without distortion."""
    camera, image_rgb = keyframe.frame.camera, keyframe.frame.load().image_rgb
    if not camera.is_distorted:
        return image_rgb
    import cv2

    x, y = _undistortion_maps(camera)
    image = cv2.remap(image_rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(image, np.uint8)


def _undistortion_maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    import cv2

    x, y = cv2.initUndistortRectifyMap(
        camera.K, camera.distortion_array, np.eye(3), camera.K, (camera.width, camera.height), cv2.CV_32FC1
    )
    return np.asarray(x, np.float32), np.asarray(y, np.float32)
