# SPDX-License-Identifier: Apache-2.0
"""Corruptions of a sequence: less light, fewer pixels, noise, gaps, occlusion; mirrored or backwards.

A mirrored or reversed sequence is a new one whose trajectory is known. The others are what real recordings
suffer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.datasets import Dataset
from slamdepth.types import Camera, Frame, Trajectory

_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_CUT = 0.7
_BLACK_FRAMES = 60  # two seconds


def _same(thing: Any) -> Any:
    return thing


@dataclass(frozen=True)
class Corruption:
    """What is done to every frame of a sequence.

    Attributes:
        camera: from the original camera to that of the corrupted frames.
        pixels: from an image or depth map to the corrupted one, of the shape of the new camera.
        light: from a colour image, its number n and the number of frames to the corrupted image.
        is_dropped: whether frame n is missing.
        has_depth: whether frame n keeps its sensor depth; None keeps all of it.
        truth: from the true trajectory to that of the corrupted sequence.
        backwards: the last frame comes first.
        laps: how often the sequence is played, with a cut between two laps.
    """

    camera: Callable[[Camera], Camera] = _same
    pixels: Callable[[NDArray[Any]], NDArray[Any]] = _same
    light: Callable[[NDArray[np.uint8], int, int], NDArray[np.uint8]] = lambda image, n, count: image
    is_dropped: Callable[[int], bool] = lambda n: False
    has_depth: Callable[[int], bool] | None = None
    truth: Callable[[Trajectory], Trajectory] = _same
    backwards: bool = False
    laps: int = 1

    def play(self, dataset: Dataset, count: int, *, with_depth: bool) -> Iterator[Frame]:
        """Read the first ``count`` frames, corrupt them and number them from 0.

        Raises:
            ImageDecodeError: a frame cannot be read.
        """
        camera = self.camera(dataset.camera)
        times_s = self._times_s(dataset, count)
        for at in range(self.laps * count):
            n = at % count
            if self.is_dropped(n):
                continue
            frame = dataset.read(count - 1 - n if self.backwards else n, with_depth=with_depth)
            image = self.light(np.ascontiguousarray(self.pixels(frame.image_rgb)), n, count)
            depth_m = None
            if frame.depth_m is not None and (self.has_depth is None or self.has_depth(n)):
                depth_m = np.ascontiguousarray(self.pixels(frame.depth_m))
            yield Frame(at, float(times_s[at]), image, camera, depth_m)

    def _times_s(self, dataset: Dataset, count: int) -> NDArray[np.float64]:
        """Timestamps ``(laps * count,)`` of the played frames."""
        times_s = dataset.timestamps_s[:count]
        if self.backwards:
            times_s = -times_s[::-1]
        return np.concatenate([times_s + lap * _lap_s(times_s) for lap in range(self.laps)])

    def truth_of(self, dataset: Dataset, count: int) -> Trajectory:
        """True poses at the times of the frames of :meth:`play`; the sequence has ground truth."""
        assert dataset.ground_truth is not None
        truth = self.truth(dataset.ground_truth)
        if self.laps == 1:
            return truth
        times_s = self._times_s(dataset, count)[:count]
        lap = np.flatnonzero((truth.timestamps_s >= times_s[0]) & (truth.timestamps_s <= times_s[-1]))
        return Trajectory(
            np.concatenate([truth.timestamps_s[lap] + n * _lap_s(times_s) for n in range(self.laps)]),
            np.tile(truth.T_world_camera[lap], (self.laps, 1, 1)),
        )


def _lap_s(times_s: NDArray[np.float64]) -> float:
    """Seconds between the first frames of two laps, at the sequence's frame rate."""
    return float(times_s[-1] - times_s[0]) * len(times_s) / max(len(times_s) - 1, 1)


def mirrored_truth(truth: Trajectory) -> Trajectory:
    """Mirror the world and the camera in x."""
    return Trajectory(truth.timestamps_s, _MIRROR @ truth.T_world_camera @ _MIRROR)


def backward_truth(truth: Trajectory) -> Trajectory:
    """Reverse the poses; times become negative."""
    return Trajectory(-truth.timestamps_s[::-1], truth.T_world_camera[::-1])


def _half(pixels: NDArray[Any]) -> NDArray[Any]:
    size = (pixels.shape[1] // 2, pixels.shape[0] // 2)
    how = cv2.INTER_AREA if pixels.ndim == 3 else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(pixels, size, interpolation=how))


def _cut_edges(length: int) -> tuple[int, int]:
    kept = round(_CUT * length)
    return (length - kept) // 2, (length - kept) // 2 + kept


def _middle(pixels: NDArray[Any]) -> NDArray[Any]:
    (top, bottom), (left, right) = map(_cut_edges, pixels.shape[:2])
    return pixels[top:bottom, left:right]


def _middle_camera(camera: Camera) -> Camera:
    (top, bottom), (left, right) = _cut_edges(camera.height), _cut_edges(camera.width)
    return replace(camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top)


def _noisy(image: NDArray[np.uint8], n: int, grey: float) -> NDArray[np.uint8]:
    noise = np.random.default_rng(n).normal(0.0, grey, image.shape)
    return np.asarray(np.clip(image + noise, 0, 255), dtype=np.uint8)


def _brighter(image: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image * factor, 0, 255), dtype=np.uint8)


def _black(image: NDArray[np.uint8], now: bool) -> NDArray[np.uint8]:
    return np.zeros_like(image) if now else image


def _with_bar(image: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    """Cover half of the width by a grey bar, which crosses the image every three seconds."""
    width = image.shape[1]
    left = (n * width // 60) % (width * 3 // 2) - width // 2
    out: NDArray[np.uint8] = image.copy()
    out[:, max(0, left) : max(0, left + width // 2)] = 60
    return out


CORRUPTIONS: dict[str, Corruption] = {
    "as it is": Corruption(),
    "mirrored": Corruption(
        camera=Camera.mirrored, pixels=lambda pixels: pixels[:, ::-1], truth=mirrored_truth
    ),
    "backwards": Corruption(truth=backward_truth, backwards=True),
    "half the pixels": Corruption(
        camera=lambda c: c.scaled(c.width // 2, c.height // 2), pixels=_half
    ),
    "a view of 70 %": Corruption(camera=_middle_camera, pixels=_middle),
    "noise of 10": Corruption(light=lambda image, n, count: _noisy(image, n, 10.0)),
    "a quarter of the light": Corruption(
        light=lambda image, n, count: _noisy(_brighter(image, 0.25), n, 3.0)
    ),
    "flickering light": Corruption(light=lambda image, n, count: _brighter(image, 1 + 0.35 * np.sin(n / 4))),
    "every 15th black": Corruption(light=lambda image, n, count: _black(image, n % 15 == 7)),
    "two seconds black": Corruption(
        light=lambda image, n, count: _black(image, count // 3 <= n < count // 3 + _BLACK_FRAMES)
    ),
    "gaps of 8 frames": Corruption(is_dropped=lambda n: n % 90 >= 82),
    "every third frame": Corruption(is_dropped=lambda n: n % 3 > 0),
    "begun at frame 50": Corruption(is_dropped=lambda n: n < 50),
    "three times over": Corruption(laps=3),
    "half hidden by a bar": Corruption(light=lambda image, n, count: _with_bar(image, n)),
    "depth of 4 in 7 frames": Corruption(has_depth=lambda n: n % 7 >= 3),
}  # fmt: skip
"""Corruptions by their names in the table."""
