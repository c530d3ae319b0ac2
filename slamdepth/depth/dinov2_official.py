# SPDX-License-Identifier: Apache-2.0
"""Depth by DINOv2 ViT-S/14 and one of the heads published with it, trained on NYU or KITTI."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.checkpoints import check_device, find_checkpoint, load_strictly, read_checkpoint
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.dinov2_heads import DptHead, LinearHead, OfficialHead, linear_layers
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import PATCH, normalised, resize_rgb
from slamdepth.depth.registry import register
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, WeightsInfo

LICENCE = "Apache-2.0 (DINOv2)"
_DIM = 384
_TAPS = {1: (11,), 4: (2, 5, 8, 11)}


@dataclass(frozen=True)
class _Training:
    data: str
    max_depth_m: float
    size: tuple[int, int]
    focal_px: float


_TRAININGS = {
    "nyu": _Training("NYU Depth v2", 10.0, (480, 640), 518.8579),
    "kitti": _Training("KITTI", 80.0, (375, 1242), 721.5377),
}
_FILES = {
    "linear": ("dinov2_vits14_{}_linear4_head.pth", "dinov2_vits14_{}_linear_head.pth"),
    "dpt": ("dinov2_vits14_{}_dpt_head.pth",),
}


class Dinov2OfficialDepth(NetworkDepth):
    """A DINOv2 backbone and an official head as a depth model.

    Args:
        backbone: in eval mode; its final norm is removed, because the heads were trained without it.
        head: in eval mode.
        card: what the head was trained on and at which size and focal length.
        weights: the files the two were read from.
        device: where both run.
        taps: blocks that the head reads; default: those of a ViT-S.
    """

    def __init__(
        self,
        backbone: DinoV2,
        head: OfficialHead,
        card: ModelCard,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
        taps: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__(card, weights, device)
        backbone.norm = nn.Identity()  # type: ignore[assignment]
        self._backbone = backbone.to(device)
        self._head = head.to(device)
        self._taps = taps or _TAPS[head.layers]

    @classmethod
    def load(
        cls,
        head: str,
        data: str = "nyu",
        *,
        weights: Path | None = None,
        backbone: Path | None = None,
        device: str = "cpu",
    ) -> Dinov2OfficialDepth:
        """Read an official head file.

        Args:
            head: ``"linear"`` (the file decides whether it reads one block or four) or ``"dpt"``.
            data: ``"nyu"`` or ``"kitti"``.
            weights: the head's file; default: by its official name from the cache folder.
            backbone: the ViT-S/14; default: the cached one.
            device: where both run.

        Raises:
            WeightsError: a file is missing or another one; says which and where to put it.
            ConfigError: the device is not available.
        """
        check_device(device)
        card = model_card(head, data)
        names = tuple(name.format(data) for name in _FILES[head])
        path = find_checkpoint(card.name, names, weights)
        for other in _TRAININGS:
            if other != data and other in path.name.lower():
                raise WeightsError(f"{path}: named as trained on {other}; '{card.name}' takes {names[0]}")
        tensors = read_checkpoint(path)
        network = load_strictly(partial(_build, head, data, tensors), tensors, str(path), device=device)
        backbone_file = store.find_backbone(backbone)
        infos = (
            store.backbone_info(backbone_file),
            WeightsInfo(path.stem, sha256_of(path), card.trained_on, card.licence),
        )
        return cls(load_dinov2(backbone_file, device), network, card, infos, device)

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        height, width = image_rgb.shape[:2]
        rows, columns = network_size(height, width, self.card.native_size)
        image = normalised(resize_rgb(image_rgb, rows, columns)[None], self.device)
        top, left = (-rows % PATCH) // 2, (-columns % PATCH) // 2
        padded = F.pad(image, (left, -columns % PATCH - left, top, -rows % PATCH - top))
        with torch.inference_mode():
            depth_m = self._head(self._backbone(padded, self._taps))[:, None]
            depth_m = F.interpolate(depth_m, size=padded.shape[-2:], mode="bilinear", align_corners=False)
            depth_m = depth_m[:, :, top : top + rows, left : left + columns]
            if (rows, columns) != (height, width):
                depth_m = F.interpolate(depth_m, size=(height, width), mode="bilinear", align_corners=False)
        return depth_m[0, 0].cpu().numpy(), (rows, columns)


def model_card(head: str, data: str) -> ModelCard:
    """The card of the official head ``"linear"`` or ``"dpt"``, trained on ``"nyu"`` or ``"kitti"``."""
    training = _TRAININGS[data]
    name = f"dinov2-{head}" if data == "nyu" else f"dinov2-{head}-{data}"
    return ModelCard(name, DepthKind.METRIC, training.size, training.focal_px, LICENCE, training.data)


def network_size(height: int, width: int, native: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns that an image is resized to: the area of ``native``, the aspect of the image."""
    scale = math.sqrt(native[0] * native[1] / (height * width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def _build(head: str, data: str, tensors: dict[str, torch.Tensor]) -> OfficialHead:
    max_depth_m = _TRAININGS[data].max_depth_m
    if head == "dpt":
        return OfficialHead(DptHead(_DIM, max_depth_m))
    shapes = {name: tuple(value.shape) for name, value in tensors.items()}
    return OfficialHead(LinearHead(_DIM, linear_layers(shapes, _DIM), max_depth_m))


def _create(
    head: str, data: str, *, device: str = "cpu", seed: int = 0, weights: Path | None = None
) -> Dinov2OfficialDepth:
    del seed
    return Dinov2OfficialDepth.load(head, data, weights=weights, device=device)


for _head in _FILES:
    for _data in _TRAININGS:
        register(model_card(_head, _data).name)(partial(_create, _head, _data))
