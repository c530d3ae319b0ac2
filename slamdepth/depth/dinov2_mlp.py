# SPDX-License-Identifier: Apache-2.0
"""A baseline head: three fully connected layers over all DINOv2 tokens of an image.

The image is squeezed to 224x224. The class token and the 256 patch tokens of a frozen ViT-S/14 (257x384
values) are min-max scaled with the ranges of the training set and go through layers of 1024, 1024 and 224x224
or 32x32, with a Softplus after each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.checkpoints import check_device, find_checkpoint, load_strictly, read_checkpoint
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.layout import pack_about, unpack_about
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import normalised, resize_rgb
from slamdepth.depth.registry import register
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, WeightsInfo

NAME = "dinov2-mlp"
FORMAT = "slamdepth-dinov2-mlp-1"
SIDE = 224
TOKENS = 257
HIDDEN = 1024
OUTPUTS = (224, 32)
FILES = tuple(f"dinov2_mlp_{side}.safetensors" for side in OUTPUTS)


class _Scaler(nn.Module):
    """Min-max scaling of every feature to 0..1 over the training set; other values may fall outside."""

    minimum: Tensor
    maximum: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("minimum", torch.zeros(features))
        self.register_buffer("maximum", torch.ones(features))

    def forward(self, x: Tensor) -> Tensor:
        span = self.maximum - self.minimum
        return (x - self.minimum) / torch.where(span > 0, span, torch.ones_like(span))


class MlpHead(nn.Module):
    """Maps all features of an image to a square depth map.

    Args:
        output: side of the depth map.
        features: values per image; by default the tokens of a ViT-S/14 at 224x224.
        hidden: width of the two hidden layers.
    """

    def __init__(self, output: int, features: int = TOKENS * 384, hidden: int = HIDDEN) -> None:
        super().__init__()
        self.output = output
        self.scaler = _Scaler(features)
        self.layers = nn.ModuleList(
            [nn.Linear(features, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, output * output)]
        )

    def fit_scaler(self, features: Tensor) -> None:
        """Set the ranges to those of the training set's ``features`` ``(N, F)``."""
        self.scaler.minimum.copy_(features.amin(dim=0))
        self.scaler.maximum.copy_(features.amax(dim=0))

    def forward(self, features: Tensor) -> Tensor:
        """Depth ``(B, output, output)`` in metres, positive, from features ``(B, F)``."""
        x: Tensor = self.scaler(features)
        for layer in self.layers:
            x = F.softplus(layer(x))
        return x.view(len(x), self.output, self.output)


def token_features(backbone: DinoV2, images: Tensor) -> Tensor:
    """The class token, then the patch tokens row by row, of the last block after the final norm.

    Args:
        backbone: a ViT.
        images: ``(B, 3, 224, 224)``, ImageNet-normalised.

    Returns:
        ``(B, 257 * dim)``.
    """
    ((grid, token),) = backbone(images, (len(backbone.blocks) - 1,))
    tokens = torch.cat([token[:, None], grid.flatten(2).transpose(1, 2)], dim=1)
    return tokens.flatten(1)


def at_size(depth_m: Tensor, height: int, width: int) -> NDArray[np.float32]:
    """The first map of ``depth_m (B, S, S)``, resized bilinearly to ``(height, width)``."""
    full = F.interpolate(depth_m[:1, None], size=(height, width), mode="bilinear", align_corners=False)
    return np.asarray(full[0, 0].cpu().numpy(), dtype=np.float32)


class Dinov2Mlp(NetworkDepth):
    """A DINOv2 backbone and the fully connected head as a depth model.

    Args:
        backbone: a ViT-S/14 in eval mode.
        head: in eval mode.
        card: what the head was trained on and at which focal length.
        weights: the files the two were read from.
        device: where both run.
    """

    def __init__(
        self,
        backbone: DinoV2,
        head: MlpHead,
        card: ModelCard,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
    ) -> None:
        super().__init__(card, weights, device)
        self._backbone = backbone.to(device)
        self._head = head.to(device)

    @classmethod
    def load(
        cls, *, weights: Path | None = None, backbone: Path | None = None, device: str = "cpu"
    ) -> Dinov2Mlp:
        """Read a head that :func:`save_mlp` wrote, of either output size.

        Args:
            weights: the head's file; default: the one in the cache folder, 224 first.
            backbone: the ViT-S/14; default: the cached one.
            device: where both run.

        Raises:
            WeightsError: a file is missing or another one; says which and where to put it.
            ConfigError: the device is not available.
        """
        check_device(device)
        path = find_checkpoint(NAME, FILES, weights)
        head, about = load_mlp(path, device)
        backbone_file = store.find_backbone(backbone)
        card = model_card(about)
        infos = (
            store.backbone_info(backbone_file),
            WeightsInfo(path.stem, sha256_of(path), card.trained_on, card.licence),
        )
        return cls(load_dinov2(backbone_file, device), head, card, infos, device)

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        height, width = image_rgb.shape[:2]
        image = normalised(resize_rgb(image_rgb, SIDE, SIDE)[None], self.device)
        with torch.inference_mode():
            depth_m = self._head(token_features(self._backbone, image))
        return at_size(depth_m, height, width), (SIDE, SIDE)


def model_card(about: Mapping[str, str]) -> ModelCard:
    """The card of a head, from the header ``about`` of its file."""
    focal_px = float(about["focal_px"]) if "focal_px" in about else None
    return ModelCard(
        NAME,
        DepthKind.METRIC,
        (SIDE, SIDE),
        focal_px,
        about.get("licence", "unknown"),
        about.get("trained_on", "unknown"),
    )


def save_mlp(path: Path, head: MlpHead, about: Mapping[str, str]) -> None:
    """Write ``head`` in half precision, atomically.

    Args:
        path: a safetensors file; missing folders are made.
        head: the head.
        about: kept in the header: ``trained_on``, ``licence``, and ``focal_px``, the focal length of the
            training images squeezed to 224x224 (geometric mean over both axes).

    Raises:
        OSError: the file cannot be written.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().half().contiguous() for name, value in head.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(save(tensors, metadata=pack_about({**about, "format": FORMAT})))
    partial.replace(path)


def load_mlp(
    path: Path, device: str = "cpu", *, features: int = TOKENS * 384, hidden: int = HIDDEN
) -> tuple[MlpHead, dict[str, str]]:
    """Read a head file.

    Args:
        path: written by :func:`save_mlp`.
        device: where the head is put.
        features: values per image that the head must read.
        hidden: width that its hidden layers must have.

    Returns:
        The head, frozen and in eval mode, and the header.

    Raises:
        WeightsError: the file cannot be read, is of another format, or a tensor is missing, extra or
            misshapen; names it.
    """
    about = read_header(path)
    if about.get("format") != FORMAT:
        raise WeightsError(f"{path}: not a {NAME} head of this package (format {about.get('format')!r})")
    if "focal_px" in about and not _is_positive(about["focal_px"]):
        raise WeightsError(f"{path}: the header's focal_px {about['focal_px']!r} is no positive number")
    tensors = read_checkpoint(path)
    last = tensors.get("layers.2.bias")
    sides = [side for side in OUTPUTS if last is not None and len(last) == side * side]
    side = sides[0] if sides else OUTPUTS[0]
    head = load_strictly(lambda: MlpHead(side, features, hidden), tensors, str(path), device=device)
    return head, about


def read_header(path: Path) -> dict[str, str]:
    """The header of a head file; empty where the file is of another origin.

    Raises:
        WeightsError: the file cannot be read.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            return unpack_about(file.metadata())
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file: {error}") from error


def _is_positive(text: str) -> bool:
    try:
        return math.isfinite(float(text)) and float(text) > 0
    except ValueError:
        return False


@register(NAME)
def create(*, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> Dinov2Mlp:
    """The model with the cached backbone and the head in ``weights``, by default the cached one.

    Nothing in it is random: ``seed`` has no effect.
    """
    del seed
    return Dinov2Mlp.load(weights=weights, device=device)
