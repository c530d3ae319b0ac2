# SPDX-License-Identifier: Apache-2.0
"""A slanted, textured wall seen by a camera that moves sideways: every depth is known exactly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.datasets import Dataset
from slamdepth.errors import ImageDecodeError
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, Trajectory

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
NORMAL = np.array([0.35, 0.1, 1.0])  # n . X = DISTANCE_M
DISTANCE_M = 2.0


def pose(x_m: float) -> NDArray[np.float64]:
    """Camera at ``x_m`` to the right of the first, looking ahead."""
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def depth_m(x_m: float, camera: Camera = CAMERA) -> NDArray[np.float32]:
    """Exact depth of the wall."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=2)
    return np.asarray((DISTANCE_M - NORMAL[0] * x_m) / (rays @ NORMAL), np.float32)


def image(x_m: float, camera: Camera = CAMERA, *, textured: bool = True) -> NDArray[np.uint8]:
    """The wall with paint that is the same wherever it is seen from."""
    if not textured:
        return np.full((camera.height, camera.width, 3), 128, np.uint8)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    z = depth_m(x_m, camera)
    x, y = (u - camera.cx) / camera.fx * z + x_m, (v - camera.cy) / camera.fy * z
    paint = np.random.default_rng(0).uniform(20, 235, (400, 400)).astype(np.float32)
    paint = np.asarray(cv2.GaussianBlur(paint, (0, 0), 1.5), np.float32)
    paint = 128 + 4.0 * (paint - paint.mean())
    grey = cv2.remap(
        paint, (200 + 80 * x).astype(np.float32), (200 + 80 * y).astype(np.float32), cv2.INTER_CUBIC
    )
    return np.repeat(np.clip(grey, 1, 255).astype(np.uint8)[..., None], 3, axis=2)


class Walk(Dataset):
    """Seven keyframes, and all frames as a dataset.

    Attributes:
        error: factor ``(h, w)`` that the predictions are off by.
        broken: indices of images that do not decode.
    """

    name, path, camera, has_depth, ground_truth = "walk", Path("walk"), CAMERA, False, None

    def __init__(
        self, reconstruction: Reconstruction, error: NDArray[np.float32], *, textured: bool = True
    ) -> None:
        self.reconstruction, self.error, self.textured = reconstruction, error, textured
        self.timestamps_s = reconstruction.trajectory.timestamps_s
        self.notes: list[str] = []
        self.broken: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        if index in self.broken:
            raise ImageDecodeError(f"frame {index}")
        x_m = self.reconstruction.trajectory.T_world_camera[index, 0, 3]
        return Frame(index, float(self.timestamps_s[index]), image(x_m, textured=self.textured), CAMERA)


def walk(*, textured: bool = True, is_sensor: bool = False) -> Walk:
    """Depth of the keyframes is a wave about the truth, or a sensor's with its right half missing."""
    places = np.linspace(0.0, 0.9, 19)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    error = np.exp(0.15 * np.sin(u / 25.0) * np.cos(v / 20.0)).astype(np.float32)
    keyframes = []
    for n, i in enumerate(range(0, 19, 3)):
        x = places[i]
        values = depth_m(x) * error
        if is_sensor:
            values = depth_m(x)
            values[:, CAMERA.width // 2 :] = 0.0
        prediction = DepthPrediction(values, DepthKind.METRIC, np.full_like(values, 0.2), is_sensor=is_sensor)
        frame = Frame(i, 0.1 * i, image(x, textured=textured), CAMERA)
        keyframes.append(
            Keyframe(
                n, StoredFrame(frame), pose(x), np.zeros((0, 2)), 1.0, StoredPrediction(prediction),
                lambda given: given.values,
            )
        )  # fmt: skip
    times_s: NDArray[np.float64] = 0.1 * np.arange(19.0)
    trajectory = Trajectory(times_s, np.array([pose(x) for x in places]))
    return Walk(Reconstruction(trajectory, tuple(keyframes), np.zeros((0, 3))), error, textured=textured)
