# SPDX-License-Identifier: Apache-2.0
"""Depth Anything V2 (Yang et al. 2024) from its official files: relative inverse depth, or metric depth.

Relative and metric files have the same tensors and differ in their names only. A metric model therefore
refuses a file whose name does not say what it was trained on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from slamdepth.depth.card import ModelCard
from slamdepth.depth.checkpoints import check_device, find_checkpoint, load_strictly, read_checkpoint
from slamdepth.depth.dinov2 import IMAGENET_MEAN, IMAGENET_STD
from slamdepth.depth.dpt import BASE, LARGE, SMALL, DepthAnything, DptShape
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import PATCH
from slamdepth.depth.registry import register
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, WeightsInfo

SHORT_SIDE = 518
"""Least pixels of the shorter side of the official input; sides are multiples of 14."""


@dataclass(frozen=True)
class _Training:
    """The training of one set of metric weights.

    Attributes:
        word: that names the data set in file names.
        data: the data set.
        max_depth_m: largest depth that is predicted.
        focal_px: focal length in pixels of images of ``size``.
        size: rows and columns of the network's input.
    """

    word: str
    data: str
    max_depth_m: float
    focal_px: float
    size: tuple[int, int]


_RELATIVE_DATA = "pseudo labels on 62 M images of eight public sets, by a teacher of five synthetic sets"
_HYPERSIM_FOCAL_PX = 886.81 * math.sqrt((518 / 768) * (686 / 1024))  # 886.81 px at 1024x768
_VKITTI_FOCAL_PX = 725.0087 * math.sqrt((518 / 375) * (1722 / 1242))  # 725.0087 px at 1242x375
_METRIC = {
    "indoor": _Training("hypersim", "Hypersim", 20.0, _HYPERSIM_FOCAL_PX, (518, 686)),
    "outdoor": _Training("vkitti", "Virtual KITTI 2", 80.0, _VKITTI_FOCAL_PX, (518, 1722)),
}
_SIZES: dict[str, tuple[str, DptShape, str]] = {
    "small": ("vits", SMALL, "Apache-2.0"),
    "base": ("vitb", BASE, "CC-BY-NC-4.0"),
    "large": ("vitl", LARGE, "CC-BY-NC-4.0"),
}
_METRIC_WORDS = ("metric", "hypersim", "vkitti", "indoor", "outdoor")


class DepthAnythingV2(NetworkDepth):
    """A published Depth Anything V2 network as a depth model.

    Args:
        network: in eval mode.
        card: what it was trained on and at which size and focal length.
        weights: the file it was read from.
        device: where it runs.
        short_side: least pixels of the shorter side of the network's input; 518 is official.
    """

    def __init__(
        self,
        network: DepthAnything,
        card: ModelCard,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
        short_side: int = SHORT_SIDE,
    ) -> None:
        super().__init__(card, weights, device)
        self._network = network.to(device)
        self.short_side = short_side

    @classmethod
    def load(
        cls, size: str, scene: str | None = None, *, weights: Path | None = None, device: str = "cpu"
    ) -> DepthAnythingV2:
        """Read an official file.

        Args:
            size: ``"small"``, ``"base"`` or ``"large"``.
            scene: None for relative inverse depth, ``"indoor"`` or ``"outdoor"`` for metric depth.
            weights: the file; default: by its official name from the cache folder.
            device: where the network runs.

        Raises:
            WeightsError: the file is missing or another one; says which and where to put it.
            ConfigError: the device is not available.
        """
        check_device(device)
        card, stem = model_card(size, scene)
        path = find_checkpoint(card.name, (f"{stem}.pth", f"{stem}.safetensors"), weights)
        _check_name(path, card.name, stem, scene)
        _, shape, _ = _SIZES[size]
        max_depth_m = _METRIC[scene].max_depth_m if scene is not None else None
        network = load_strictly(
            lambda: DepthAnything(shape, max_depth_m),
            read_checkpoint(path),
            str(path),
            unused={"pretrained.mask_token": (1, shape.dim)},
            device=device,
        )
        info = WeightsInfo(path.stem, sha256_of(path), card.trained_on, card.licence)
        return cls(network, card, (info,), device)

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        height, width = image_rgb.shape[:2]
        rows, columns = network_size(height, width, self.short_side)
        image = _prepared(image_rgb, rows, columns, self.device)
        with torch.inference_mode():
            out = self._network(image)[:, None]
            full = F.interpolate(out, size=(height, width), mode="bilinear", align_corners=True)
        return full[0, 0].cpu().numpy(), (rows, columns)


def model_card(size: str, scene: str | None) -> tuple[ModelCard, str]:
    """The card of a published model, and the official name of its file without its suffix."""
    code, _, licence = _SIZES[size]
    if scene is None:
        name = f"depth-anything-v2-{size}"
        card = ModelCard(
            name, DepthKind.AFFINE_INVERSE_DEPTH, (SHORT_SIDE, SHORT_SIDE), None, licence, _RELATIVE_DATA
        )
        return card, f"depth_anything_v2_{code}"
    training = _METRIC[scene]
    name = f"depth-anything-v2-{size}-metric-{scene}"
    card = ModelCard(name, DepthKind.METRIC, training.size, training.focal_px, licence, training.data)
    return card, f"depth_anything_v2_metric_{training.word}_{code}"


def network_size(height: int, width: int, short_side: int = SHORT_SIDE) -> tuple[int, int]:
    """Rows and columns of the official input of a ``height`` x ``width`` image.

    The shorter side has at least ``short_side`` pixels, and sides are multiples of 14 that keep the aspect as
    well as possible.
    """
    scale = max(short_side / height, short_side / width)

    def fitted(pixels: int) -> int:
        tokens = round(pixels * scale / PATCH)
        if tokens * PATCH < short_side:
            tokens = math.ceil(pixels * scale / PATCH)
        return tokens * PATCH

    return fitted(height), fitted(width)


def _prepared(image_rgb: NDArray[np.uint8], rows: int, columns: int, device: str) -> torch.Tensor:
    """The network's input ``(1, 3, rows, columns)``: resized bicubically in floating point, as the official
    code does, and normalised."""
    import cv2

    image = image_rgb.astype(np.float32) / np.float32(255.0)
    if image.shape[:2] != (rows, columns):
        resized = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_CUBIC)
        image = np.asarray(resized, dtype=np.float32)
    image = (image - np.asarray(IMAGENET_MEAN, np.float32)) / np.asarray(IMAGENET_STD, np.float32)
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))[None]).to(device)


def _check_name(path: Path, model: str, stem: str, scene: str | None) -> None:
    """Check that the file's name fits the model: nothing else tells relative from metric weights.

    Raises:
        WeightsError: it does not.
    """
    name = path.name.lower()
    if scene is None:
        if any(word in name for word in _METRIC_WORDS):
            raise WeightsError(f"{path}: named as a metric model; '{model}' is the relative one ({stem}.pth)")
        return
    word = _METRIC[scene].word
    others = [other.word for key, other in _METRIC.items() if key != scene]
    if "metric" not in name or word not in name or any(other in name for other in others):
        raise WeightsError(
            f"{path}: relative and metric files differ in nothing but their names, and this name does not "
            f"say '{word}' metric; '{model}' takes {stem}.pth"
        )


def _create(
    size: str, scene: str | None, *, device: str = "cpu", seed: int = 0, weights: Path | None = None
) -> DepthAnythingV2:
    del seed
    return DepthAnythingV2.load(size, scene, weights=weights, device=device)


for _size in _SIZES:
    for _scene in (None, *_METRIC):
        register(model_card(_size, _scene)[0].name)(partial(_create, _size, _scene))
