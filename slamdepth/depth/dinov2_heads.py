# SPDX-License-Identifier: Apache-2.0
"""The depth heads published with DINOv2 (Oquab et al. 2023): a linear one and a DPT (Ranftl et al. 2021).

Parameter names are those of the official files. Both heads read the tokens of their blocks before the final
norm, each patch token together with the class token.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.layout import Shape

BINS = 256
MIN_DEPTH_M = 1e-3
DPT_CHANNELS = 256

Tapped = list[tuple[Tensor, Tensor]]
"""Of each block the patch tokens ``(B, dim, h, w)`` and the class token ``(B, dim)``."""


class LinearHead(nn.Module):
    """A linear classifier over 256 depths, read out as their expectation.

    Args:
        dim: width of the tokens.
        layers: number of blocks read, 1 or 4.
        max_depth_m: the last of the depths, which start at 1 mm and are evenly spaced.
    """

    def __init__(self, dim: int, layers: int, max_depth_m: float) -> None:
        super().__init__()
        self.layers, self.max_depth_m = layers, max_depth_m
        self.conv_depth = nn.Conv2d(2 * dim * layers, BINS, 1)

    def forward(self, tapped: Tapped) -> Tensor:
        """Depth ``(B, 4h, 4w)`` in metres.

        The official code upsamples the tokens fourfold and then classifies. A pointwise layer and bilinear
        upsampling commute, so here it is the other way round, for a sixteenth of the work.
        """
        both = [torch.cat([x, token[:, :, None, None].expand_as(x)], dim=1) for x, token in tapped]
        logits: Tensor = self.conv_depth(torch.cat(both, dim=1))
        logits = F.interpolate(logits, scale_factor=4, mode="bilinear", align_corners=False)
        share = torch.relu(logits) + 0.1
        share = share / share.sum(dim=1, keepdim=True)
        depths_m = torch.linspace(MIN_DEPTH_M, self.max_depth_m, BINS, device=share.device)
        return torch.einsum("bkhw,k->bhw", share, depths_m)


class _Conv(nn.Module):
    """A convolution under the name ``conv``, as in the official files."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int, bias: bool = True) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, kernel, padding=kernel // 2, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.conv(x)
        return out


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = _Conv(channels, channels, 3, bias=False)
        self.conv2 = _Conv(channels, channels, 3, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        residual: Tensor = self.conv2(F.relu(self.conv1(F.relu(x))))
        return x + residual


class _Fusion(nn.Module):
    """Add a finer stage (the first fusion has none), refine, upsample twofold."""

    def __init__(self, channels: int, *, is_first: bool) -> None:
        super().__init__()
        self.project = _Conv(channels, channels, 1)
        self.res_conv_unit1 = None if is_first else _Residual(channels)
        self.res_conv_unit2 = _Residual(channels)

    def forward(self, x: Tensor, finer: Tensor | None = None) -> Tensor:
        if self.res_conv_unit1 is not None and finer is not None:
            if finer.shape[-2:] != x.shape[-2:]:
                finer = F.interpolate(finer, size=x.shape[-2:], mode="bilinear", align_corners=False)
            x = x + self.res_conv_unit1(finer)
        x = F.interpolate(self.res_conv_unit2(x), scale_factor=2, mode="bilinear", align_corners=True)
        out: Tensor = self.project(x)
        return out


class _Reassemble(nn.Module):
    """Tokens of four blocks to feature maps at 4, 2, 1 and 1/2 times the token grid."""

    def __init__(self, dim: int, stages: list[int]) -> None:
        super().__init__()
        self.projects = nn.ModuleList(_Conv(dim, channels, 1) for channels in stages)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(stages[0], stages[0], 4, stride=4),
                nn.ConvTranspose2d(stages[1], stages[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(stages[3], stages[3], 3, stride=2, padding=1),
            ]
        )
        self.readout_projects = nn.ModuleList(
            nn.Sequential(nn.Linear(2 * dim, dim), nn.GELU()) for _ in stages
        )

    def forward(self, tapped: Tapped) -> list[Tensor]:
        out = []
        for index, (x, token) in enumerate(tapped):
            both = torch.cat([x, token[:, :, None, None].expand_as(x)], dim=1).movedim(1, -1)
            mixed = self.readout_projects[index](both).movedim(-1, 1)
            out.append(self.resize_layers[index](self.projects[index](mixed)))
        return out


class _Output(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.head = nn.Sequential(
            nn.Conv2d(channels, channels // 2, 3, padding=1),
            nn.UpsamplingBilinear2d(scale_factor=2),  # with aligned corners, as in the official code
            nn.Conv2d(channels // 2, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 1, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.head(x)
        return out


class DptHead(nn.Module):
    """The DPT decoder with the class token mixed into every patch token.

    Args:
        dim: width of the tokens.
        max_depth_m: largest depth, to which :class:`OfficialHead` clamps.
        channels: of the decoder.
    """

    layers = 4

    def __init__(self, dim: int, max_depth_m: float, channels: int = DPT_CHANNELS) -> None:
        super().__init__()
        self.max_depth_m = max_depth_m
        stages = [dim // 8, dim // 4, dim // 2, dim]
        self.reassemble_blocks = _Reassemble(dim, stages)
        self.convs = nn.ModuleList(_Conv(stage, channels, 3, bias=False) for stage in stages)
        self.fusion_blocks = nn.ModuleList(_Fusion(channels, is_first=index == 0) for index in range(4))
        self.project = _Conv(channels, channels, 3)
        self.conv_depth = _Output(channels)

    def forward(self, tapped: Tapped) -> Tensor:
        """Depth ``(B, about 16h, about 16w)`` in metres."""
        stages = [conv(stage) for conv, stage in zip(self.convs, self.reassemble_blocks(tapped), strict=True)]
        x = self.fusion_blocks[0](stages[3])
        for fusion, stage in zip(
            list(self.fusion_blocks)[1:], (stages[2], stages[1], stages[0]), strict=True
        ):
            x = fusion(x, stage)
        out: Tensor = self.conv_depth(F.relu(self.project(x)))
        return torch.relu(out)[:, 0] + MIN_DEPTH_M


class OfficialHead(nn.Module):
    """A head under the name ``decode_head``, as in the official files."""

    def __init__(self, head: LinearHead | DptHead) -> None:
        super().__init__()
        self.decode_head = head

    @property
    def layers(self) -> int:
        return self.decode_head.layers

    def forward(self, tapped: Tapped) -> Tensor:
        """Depth in metres, clamped to 1 mm and the head's largest depth; the shape is that of the head."""
        depth_m: Tensor = self.decode_head(tapped)
        return depth_m.clamp(MIN_DEPTH_M, self.decode_head.max_depth_m)


def linear_layers(shapes: dict[str, Shape], dim: int) -> int:
    """Number of blocks that a linear head file reads: 4, unless its weight fits a single one.

    Args:
        shapes: of the file's tensors, by name.
        dim: width of the tokens.
    """
    weight = shapes.get("decode_head.conv_depth.weight", ())
    return 1 if len(weight) == 4 and weight[1] == 2 * dim else 4
