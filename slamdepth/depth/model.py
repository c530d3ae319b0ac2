# SPDX-License-Identifier: Apache-2.0
"""The embedded default: metric depth and its uncertainty from a frozen DINOv2 ViT-S/14."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2, load_dinov2, working_type
from slamdepth.depth.head import HeadEnsemble, load_head
from slamdepth.depth.preprocess import check_size, focal_factor, input_size, normalised, resize_rgb
from slamdepth.depth.registry import register
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo


class Dinov2Depth:
    """DINOv2 tokens and a small trained head; see ``slamdepth/assets/dinov2_head.md``.

    Args:
        backbone: a ViT-S/14 in eval mode.
        head: heads that read its tokens.
        weights: what the two were read from.
        device: where both run.
    """

    name = "dinov2"
    kind = DepthKind.METRIC

    def __init__(
        self,
        backbone: DinoV2,
        head: HeadEnsemble,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
    ) -> None:
        self.weights = weights
        self.device = device
        self._dtype = working_type(device)
        self._backbone = backbone.to(device, self._dtype)
        self._head = head.to(device)

    @classmethod
    def load(
        cls, *, backbone: Path | None = None, head: Path | None = None, device: str = "cpu"
    ) -> Dinov2Depth:
        """Read the backbone (default: the cached one) and the head (default: the shipped one).

        Raises:
            WeightsError: one line: what is missing or damaged, and what to do.
            ConfigError: the device is not there.
        """
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise ConfigError(f"device '{device}': no CUDA device is available; use 'cpu'")
        head_file = head or store.head_path()
        backbone_file = store.find_backbone(backbone)
        backbone_info = store.backbone_info(backbone_file)
        network, about = load_head(head_file, device)
        infos = (
            backbone_info,
            WeightsInfo(
                head_file.stem,
                store.sha256_of(head_file),
                about.get("trained_on", "unknown"),
                about.get("licence", "unknown"),
            ),
        )
        return cls(load_dinov2(backbone_file, device), network, infos, device)

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth in metres for every raw (not undistorted) pixel of ``frame``.

        Raises:
            CameraError: the image is too small or too narrow for the network.
        """
        check_size(frame)
        height, width = frame.image_rgb.shape[:2]
        rows, columns = input_size(height, width, self._head.shape.input_px)
        image = normalised(resize_rgb(frame.image_rgb, rows, columns)[None], self.device)
        with torch.inference_mode():
            tapped = self._backbone(image.to(self._dtype), self._head.shape.taps)
            tokens = torch.stack([grid for grid, _ in tapped], dim=1).float()
            class_tokens = torch.stack([token for _, token in tapped], dim=1).float()
            log_depth, sigma = self._head(tokens, class_tokens, image)
            both = torch.stack([log_depth, sigma], dim=1)
            full = F.interpolate(both, size=(height, width), mode="bilinear", align_corners=False)[0]
            log_depth_full = full[0] + math.log(focal_factor(frame.camera, rows, columns))
            values = log_depth_full.exp().cpu().numpy()
            sigma_log = full[1].cpu().numpy()
        return DepthPrediction(
            np.ascontiguousarray(values, dtype=np.float32),
            self.kind,
            np.ascontiguousarray(sigma_log, dtype=np.float32),
        )


@register("dinov2")
def create(*, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> Dinov2Depth:
    """The model with the cached backbone and the head in ``weights``, by default the shipped one.

    It has nothing random.
    """
    del seed
    return Dinov2Depth.load(head=weights, device=device)
