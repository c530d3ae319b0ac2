# SPDX-License-Identifier: Apache-2.0
"""The network of Depth Anything V2 (Yang et al. 2024): a DINOv2 ViT and a DPT decoder.

DPT: Ranftl et al., "Vision Transformers for Dense Prediction", ICCV 2021. Parameter names are those of the
official files.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.dinov2 import DinoV2


@dataclass(frozen=True)
class DptShape:
    """Sizes of encoder and decoder.

    Attributes:
        dim: width of the ViT.
        depth: number of its blocks.
        heads: number of its attention heads.
        taps: blocks whose tokens the decoder reads.
        features: channels of the decoder.
        stages: channels of its four inputs, finest resolution first.
        grid: tokens of the stored position embedding, along a side.
    """

    dim: int
    depth: int
    heads: int
    taps: tuple[int, int, int, int]
    features: int
    stages: tuple[int, int, int, int]
    grid: int = 37


SMALL = DptShape(384, 12, 6, (2, 5, 8, 11), 64, (48, 96, 192, 384))
BASE = DptShape(768, 12, 12, (2, 5, 8, 11), 128, (96, 192, 384, 768))
LARGE = DptShape(1024, 24, 16, (4, 11, 17, 23), 256, (256, 512, 1024, 1024))


class ResidualUnit(nn.Module):
    """A residual unit of two convolutions (Ranftl et al. 2021), named as in the official files."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        residual: Tensor = self.conv2(F.relu(self.conv1(F.relu(x))))
        return x + residual


class _Fusion(nn.Module):
    """Add a finer stage, refine, upsample.

    The coarsest fusion has no stage to add, though the official files have a first residual unit for it too.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.resConfUnit1 = ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)
        self.out_conv = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor, finer: Tensor | None, size: tuple[int, int]) -> Tensor:
        if finer is not None:
            x = x + self.resConfUnit1(finer)
        x = F.interpolate(self.resConfUnit2(x), size=size, mode="bilinear", align_corners=True)
        out: Tensor = self.out_conv(x)
        return out


class _Scratch(nn.Module):
    """The convolutions and fusions of the decoder; the name is that of MiDaS."""

    def __init__(self, features: int, stages: tuple[int, int, int, int]) -> None:
        super().__init__()
        for index, channels in enumerate(stages, start=1):
            self.add_module(f"layer{index}_rn", nn.Conv2d(channels, features, 3, padding=1, bias=False))
        for index in range(1, 5):
            self.add_module(f"refinenet{index}", _Fusion(features))
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 1, 1)
        )


class DptDecoder(nn.Module):
    """Tokens of four blocks to one value per pixel, before the last activation.

    Args:
        dim: width of the tokens.
        features: channels of the decoder.
        stages: channels of its four inputs, finest resolution first.
        patch: pixels of the image per token, along a side.
    """

    def __init__(self, dim: int, features: int, stages: tuple[int, int, int, int], patch: int = 14) -> None:
        super().__init__()
        self.patch = patch
        self.projects = nn.ModuleList(nn.Conv2d(dim, channels, 1) for channels in stages)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(stages[0], stages[0], 4, stride=4),
                nn.ConvTranspose2d(stages[1], stages[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(stages[3], stages[3], 3, stride=2, padding=1),
            ]
        )
        self.scratch = _Scratch(features, stages)

    def forward(self, grids: list[Tensor]) -> Tensor:
        """Values ``(B, h * patch, w * patch)`` from the tokens ``(B, dim, h, w)`` of each tapped block."""
        rows, columns = grids[0].shape[-2:]
        stages = []
        for index, grid in enumerate(grids):
            stage = self.resize_layers[index](self.projects[index](grid))
            stages.append(self.scratch.get_submodule(f"layer{index + 1}_rn")(stage))
        x = stages[3]
        for index in (3, 2, 1, 0):
            height, width = stages[max(index - 1, 0)].shape[-2:]
            size = (height, width) if index else (2 * height, 2 * width)
            fusion = self.scratch.get_submodule(f"refinenet{index + 1}")
            x = fusion(x, stages[index] if index < 3 else None, size)
        x = self.scratch.output_conv1(x)
        size = (rows * self.patch, columns * self.patch)
        x = F.interpolate(x, size=size, mode="bilinear", align_corners=True)
        out: Tensor = self.scratch.output_conv2(x)
        return out[:, 0]


class DepthAnything(nn.Module):
    """Encoder and decoder of Depth Anything V2; the weights decide what the output means.

    Args:
        shape: of encoder and decoder.
        max_depth_m: largest depth of a metric model; None for a relative one, whose output is inverse depth
            up to scale and shift.
    """

    def __init__(self, shape: DptShape, max_depth_m: float | None = None) -> None:
        super().__init__()
        self.taps = shape.taps
        self.max_depth_m = max_depth_m
        self.pretrained = DinoV2(shape.dim, shape.depth, shape.heads, grid=shape.grid)
        self.depth_head = DptDecoder(shape.dim, shape.features, shape.stages)

    def forward(self, image: Tensor) -> Tensor:
        """Depth in metres, or inverse depth up to scale and shift, ``(B, H, W)``, not negative.

        Args:
            image: ``(B, 3, H, W)``, ImageNet-normalised; H and W are multiples of 14.
        """
        out = self.depth_head([grid for grid, _ in self.pretrained(image, self.taps)])
        return torch.relu(out) if self.max_depth_m is None else torch.sigmoid(out) * self.max_depth_m
