# SPDX-License-Identifier: Apache-2.0
"""DINOv2 ViT (Oquab et al. 2023) without registers, in PyTorch, for inference.

Parameter names are those of the official files.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.checkpoints import read_checkpoint
from slamdepth.depth.layout import check_layout, dinov2_layout
from slamdepth.processor import has_bfloat16

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class _Attention(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        batch, tokens, dim = x.shape
        qkv = self.qkv(x).reshape(batch, tokens, 3, self.heads, dim // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)
        if x.dtype is torch.bfloat16 and x.device.type == "cpu":
            # PyTorch's fused kernel computes in float32 there; separate products are a third faster.
            share = (query * query.shape[-1] ** -0.5 @ key.transpose(-1, -2)).softmax(dim=-1)
            out = share @ value
        else:
            out = F.scaled_dot_product_attention(query, key, value)
        projected: Tensor = self.proj(out.transpose(1, 2).reshape(batch, tokens, dim))
        return projected


class _Mlp(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, 4 * dim)
        self.fc2 = nn.Linear(4 * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return out


class LayerScale(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Block(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = _Attention(dim, heads)
        self.ls1: nn.Module = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        self.mlp = _Mlp(dim)
        self.ls2: nn.Module = LayerScale(dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        x = x + self.ls2(self.mlp(self.norm2(x)))
        return x


class _PatchEmbed(nn.Module):
    def __init__(self, dim: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch, stride=patch)

    def forward(self, x: Tensor) -> Tensor:
        patches: Tensor = self.proj(x)
        return patches.flatten(2).transpose(1, 2)


def to_grid(tokens: Tensor, cells: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Patch tokens ``(B, dim, *cells)`` and class token ``(B, dim)`` of tokens ``(B, 1 + cells, dim)``."""
    return tokens[:, 1:].transpose(1, 2).reshape(len(tokens), tokens.shape[2], *cells), tokens[:, 0]


def from_grid(grid: Tensor, class_token: Tensor) -> Tensor:
    """The inverse of :func:`to_grid`."""
    return torch.cat([class_token[:, None], grid.flatten(2).transpose(1, 2)], dim=1)


class DinoV2(nn.Module):
    """The ViT encoder; ``forward`` returns the tokens after chosen blocks.

    Args:
        dim: width of the tokens; the defaults are those of a ViT-S/14.
        depth: number of blocks.
        heads: number of attention heads.
        patch: pixels of the image per token, along a side.
        grid: tokens of the stored position embedding, along a side.

    Attributes:
        adapted_by: the :class:`~slamdepth.depth.adapters.Adapters` that were added to its weights, if any.
    """

    def __init__(
        self, dim: int = 384, depth: int = 12, heads: int = 6, patch: int = 14, grid: int = 37
    ) -> None:
        super().__init__()
        self.dim, self.patch, self.grid = dim, patch, grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid * grid, dim))
        self.patch_embed = _PatchEmbed(dim, patch)
        self.blocks = nn.ModuleList(Block(dim, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(dim, eps=1e-6)
        self.adapted_by: tuple[object, ...] = ()
        self._resized: dict[tuple[int, int], Tensor] = {}

    def position_embedding(self, rows: int, columns: int) -> Tensor:
        """Position embedding ``(1, 1 + rows * columns, dim)`` for a grid of ``rows`` x ``columns`` tokens.

        Resized bicubically with an offset of 0.1 in the scale factor, as the official code does.
        """
        if (rows, columns) == (self.grid, self.grid):
            return self.pos_embed
        square = self.pos_embed[:, 1:].reshape(1, self.grid, self.grid, self.dim).permute(0, 3, 1, 2)
        resized = F.interpolate(
            square, scale_factor=((rows + 0.1) / self.grid, (columns + 0.1) / self.grid), mode="bicubic"
        )
        if resized.shape[-2:] != (rows, columns):
            raise ValueError(f"position embedding came out {tuple(resized.shape[-2:])}, not {rows, columns}")
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)

    def forward(self, image: Tensor, taps: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
        """Tokens after some of the blocks, through the final norm.

        Args:
            image: ``(B, 3, H, W)`` normalised with the ImageNet mean and deviation; H and W are multiples of
                the patch size.
            taps: numbers of the blocks, ascending, from 0.

        Returns:
            For each tap the patch tokens ``(B, dim, H/patch, W/patch)`` and the class token ``(B, dim)``.

        Raises:
            ValueError: the image does not fit the patch size, or a tap does not exist.
        """
        if not taps or min(taps) < 0 or max(taps) >= len(self.blocks):
            raise ValueError(f"taps {list(taps)} are not blocks 0 to {len(self.blocks) - 1}")
        x = self.embedded(image)
        return self.run(x, range(max(taps) + 1), taps, self.cells(image))[1]

    def embedded(self, image: Tensor) -> Tensor:
        """Tokens ``(B, 1 + cells, dim)`` that enter the first block, the class token first.

        Args:
            image: as for :meth:`forward`.

        Raises:
            ValueError: the image does not fit the patch size.
        """
        if (
            image.ndim != 4
            or image.shape[1] != 3
            or image.shape[2] % self.patch
            or image.shape[3] % self.patch
        ):
            raise ValueError(
                f"the image must be (B, 3, H, W) with H and W multiples of {self.patch}, "
                f"got {tuple(image.shape)}"
            )
        x = torch.cat([self.cls_token.expand(len(image), -1, -1), self.patch_embed(image)], dim=1)
        return x + self._cached_position_embedding(*self.cells(image))

    def run(
        self, x: Tensor, blocks: range, taps: Sequence[int], cells: tuple[int, int]
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Some of the blocks.

        Args:
            x: ``(B, 1 + cells, dim)`` tokens that enter the first of them.
            blocks: their numbers.
            taps: numbers of blocks, as for :meth:`forward`; those that are not run are skipped.
            cells: rows and columns of tokens.

        Returns:
            The tokens after the last one, and those of the taps as from :meth:`forward`.
        """
        out = []
        for index in blocks:
            x = self.blocks[index](x)
            if index in taps:
                out.append(to_grid(self.norm(x), cells))
        return x, out

    def cells(self, image: Tensor) -> tuple[int, int]:
        """Rows and columns of the tokens of ``image (B, 3, H, W)``."""
        return image.shape[2] // self.patch, image.shape[3] // self.patch

    def _cached_position_embedding(self, rows: int, columns: int) -> Tensor:
        if torch.is_grad_enabled():
            return self.position_embedding(rows, columns)
        cached = self._resized.get((rows, columns))
        if cached is None or cached.device != self.pos_embed.device:
            cached = self._resized[(rows, columns)] = self.position_embedding(rows, columns)
        return cached


def working_type(device: str) -> torch.dtype:
    """Type that the backbone computes in: bfloat16 on a CPU with native bfloat16 products, float32 elsewhere.

    bfloat16 nearly halves the time of a prediction. It changes depth by about half a per cent, where the head
    errs by ten.
    """
    return torch.bfloat16 if device == "cpu" and has_bfloat16() else torch.float32


def load_dinov2(path: Path, device: str = "cpu") -> DinoV2:
    """The ViT-S/14 of a safetensors or official ``.pth`` file, frozen, in eval mode.

    Raises:
        WeightsError: the file cannot be read, or a tensor is missing, extra or misshapen; names it.
    """
    tensors = read_checkpoint(path)
    check_layout(
        {name: tuple(value.shape) for name, value in tensors.items()},
        dinov2_layout(),
        str(path),
        ignored=("mask_token",),
    )
    tensors.pop("mask_token", None)
    model = DinoV2()
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    return model.eval().requires_grad_(False).to(device)
