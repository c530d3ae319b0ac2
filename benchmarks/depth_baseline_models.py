# SPDX-License-Identifier: Apache-2.0
"""What a depth network has to beat: a constant, the mean depth image, and the pixels without a ViT."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2_mlp import SIDE, MlpHead, at_size, load_mlp
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import focal_px_at, resize_rgb
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

PIXELS = 3 * SIDE * SIDE


class ConstantDepth:
    """The same depth everywhere, in metres."""

    name, kind = "constant", DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, depth_m: float) -> None:
        self.depth_m = depth_m

    def predict(self, frame: Frame) -> DepthPrediction:
        """``(H, W)`` metres."""
        return DepthPrediction(np.full(frame.image_rgb.shape[:2], self.depth_m, np.float32), self.kind)


class MeanImageDepth:
    """The mean of the training depth at each place of the image.

    Args:
        depth_m: ``(S, S)`` metres, seen by a camera of ``focal_px`` at that size.
    """

    name, kind = "mean-image", DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, depth_m: NDArray[np.float32], focal_px: float) -> None:
        self.depth_m, self.focal_px = depth_m, focal_px

    def predict(self, frame: Frame) -> DepthPrediction:
        """``(H, W)`` metres, scaled to the frame's focal length."""
        factor = focal_px_at(frame.camera, *self.depth_m.shape) / self.focal_px
        full = at_size(torch.from_numpy(self.depth_m)[None], *frame.image_rgb.shape[:2])
        return DepthPrediction(full * np.float32(factor), self.kind)


class PixelMlp(NetworkDepth):
    """The fully connected head on the 224x224 image itself, without a ViT."""

    def __init__(self, head: MlpHead, focal_px: float, weights: tuple[WeightsInfo, ...] = ()) -> None:
        card = ModelCard("pixel-mlp", DepthKind.METRIC, (SIDE, SIDE), focal_px, "unknown", "unknown")
        super().__init__(card, weights)
        self._head = head

    @classmethod
    def load(cls, file: Path) -> PixelMlp:
        """Read a head that ``save_mlp`` wrote.

        Raises:
            WeightsError: the file is no such head.
        """
        head, about = load_mlp(file, features=PIXELS)
        info = WeightsInfo(file.stem, store.sha256_of(file), about["trained_on"], about["licence"])
        return cls(head, float(about["focal_px"]), (info,))

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        height, width = image_rgb.shape[:2]
        pixels = torch.from_numpy(resize_rgb(image_rgb, SIDE, SIDE).reshape(1, -1)).float()
        with torch.inference_mode():
            depth_m = self._head(pixels)
        return at_size(depth_m, height, width), (SIDE, SIDE)
