# SPDX-License-Identifier: Apache-2.0
"""Low-rank changes of a backbone's last blocks (LoRA, Hu et al., ICLR 2022), kept in the file of a head.

They are added to the weights when the model is loaded, so that a prediction takes no longer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.dinov2 import Block, DinoV2
from slamdepth.errors import WeightsError


class LowRank(nn.Module):
    """A change ``up @ down`` of the weights of a linear layer, 0 to begin with.

    Args:
        inputs, outputs: channels of the layer.
        rank: of the change.
    """

    def __init__(self, inputs: int, outputs: int, rank: int) -> None:
        super().__init__()
        self.down = nn.Parameter(torch.randn(rank, inputs) / math.sqrt(inputs))
        self.up = nn.Parameter(torch.zeros(outputs, rank))

    def forward(self, x: Tensor) -> Tensor:
        """What the change adds to the output of its layer for the input ``x (..., inputs)``."""
        return F.linear(F.linear(x, self.down.to(x.dtype)), self.up.to(x.dtype))


class Adapters(nn.Module):
    """A low-rank change of each linear layer of a backbone's last blocks.

    Args:
        dim: width of the backbone.
        blocks: how many of its last blocks are changed.
        rank: of each change.
    """

    def __init__(self, dim: int, blocks: int, rank: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            nn.ModuleDict({
                "qkv": LowRank(dim, 3 * dim, rank),
                "proj": LowRank(dim, dim, rank),
                "fc1": LowRank(dim, 4 * dim, rank),
                "fc2": LowRank(4 * dim, dim, rank),
            })
            for _ in range(blocks)
        )  # fmt: skip

    @contextmanager
    def beside(self, backbone: DinoV2) -> Iterator[None]:
        """Compute the changes next to the frozen weights of ``backbone``, to train them."""
        hooks = [
            layer.register_forward_hook(
                lambda module, inputs, output, change=change: output + change(inputs[0])
            )
            for layer, change in self._pairs(backbone)
        ]
        try:
            yield
        finally:
            for hook in hooks:
                hook.remove()

    def merge_into(self, backbone: DinoV2) -> None:
        """Add the changes to the weights of ``backbone``, in place; does nothing where they are in it.

        Raises:
            WeightsError: they do not fit it, or others are in it.
        """
        if backbone.adapted_by == (self,):
            return
        if backbone.adapted_by:
            raise WeightsError("this backbone has the adapters of another head; load it again")
        with torch.no_grad():
            for layer, change in self._pairs(backbone):
                layer.weight += (change.up @ change.down).to(layer.weight)
        backbone.adapted_by = (self,)

    def _pairs(self, backbone: DinoV2) -> list[tuple[nn.Linear, LowRank]]:
        """Each changed layer of ``backbone``, and its change."""
        first = len(backbone.blocks) - len(self.blocks)
        if first < 0:
            raise WeightsError(
                f"adapters of {len(self.blocks)} blocks do not fit a backbone of {len(backbone.blocks)}"
            )
        pairs = []
        for block, changes in zip(backbone.blocks[first:], self.blocks, strict=True):
            for name, layer in _layers(cast("Block", block)).items():
                change = cast("LowRank", cast("nn.ModuleDict", changes)[name])
                if (change.up.shape[0], change.down.shape[1]) != tuple(layer.weight.shape):
                    width = change.down.shape[1]
                    raise WeightsError(
                        f"adapters of width {width} do not fit a backbone of {layer.in_features}"
                    )
                pairs.append((layer, change))
        return pairs


def _layers(block: Block) -> dict[str, nn.Linear]:
    return {"qkv": block.attn.qkv, "proj": block.attn.proj, "fc1": block.mlp.fc1, "fc2": block.mlp.fc2}


def blended(runs: Sequence[Adapters], share: float) -> Adapters:
    """``share`` of the mean change of several trainings; its rank is the sum of theirs.

    Args:
        runs: changes of the same layers.
        share: 0 to leave the backbone as it is, 1 for the mean.
    """
    each = [_changes(run) for run in runs]
    dim, rank = each[0][0].down.shape[1], sum(changes[0].down.shape[0] for changes in each)
    result = Adapters(dim, len(runs[0].blocks), rank)
    with torch.no_grad():
        for change, parts in zip(_changes(result), zip(*each, strict=True), strict=True):
            change.down.copy_(torch.cat([part.down for part in parts]))
            change.up.copy_(torch.cat([part.up for part in parts], dim=1) * (share / len(runs)))
    return result


def _changes(adapters: Adapters) -> list[LowRank]:
    return [module for module in adapters.modules() if isinstance(module, LowRank)]
