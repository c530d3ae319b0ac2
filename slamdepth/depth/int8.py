# SPDX-License-Identifier: Apache-2.0
"""The linear layers of a backbone in 8-bit integers, for processors without native products of bfloat16.

A weight has one scale per output channel (symmetric), an input one scale and zero point for the whole
tensor, taken from its own smallest and largest value. So nothing is calibrated, and no data is needed.
Attention, normalisation and GELU stay in float32. The kernels are oneDNN's, by way of PyTorch.
"""

from __future__ import annotations

from typing import cast

import cv2
import torch
from torch import Tensor, nn

from slamdepth.depth.dinov2 import Block, DinoV2, LayerScale
from slamdepth.errors import ConfigError
from slamdepth.processor import instructions

_WEIGHT_LEVELS = 127
_INPUT_LEVELS = 254
"""One less than a byte has, so that the largest value stays in it wherever the zero point is rounded to."""

_CHECKED_SHAPE = (5, 64, 16)
_CHECKED_ERROR = 0.05


class Int8Linear(nn.Module):
    """A linear layer in 8-bit integers; input and output are float32.

    Args:
        weight: ``(outputs, inputs)``.
        bias: ``(outputs,)``.
    """

    def __init__(self, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        weight = weight.detach().float()
        scale = _largest(weight).clamp_min(torch.finfo(torch.float32).tiny) / _WEIGHT_LEVELS
        rounded = (weight / scale[:, None]).round().to(torch.int8)
        self._outputs = len(weight)
        self._packed = torch.ops.onednn.qlinear_prepack(rounded, None)
        self._scale, self._zero_point = scale, torch.zeros(len(weight), dtype=torch.long)
        self._bias = bias.detach().float().clone()

    def forward(self, x: Tensor) -> Tensor:
        """``(..., inputs)`` to ``(..., outputs)``; what shares a call shares the scale of the input."""
        rows = x.reshape(-1, x.shape[-1])
        smallest, largest = torch.aminmax(rows)
        low, high = min(smallest.item(), 0.0), max(largest.item(), 0.0)
        scale = (high - low) / _INPUT_LEVELS or 1.0
        zero_point = round(-low / scale)
        # OpenCV's is one pass over the data; PyTorch needs three, one of which is not vectorised.
        bytes_ = torch.from_numpy(cv2.convertScaleAbs(rows.numpy(), alpha=1.0 / scale, beta=zero_point))
        out: Tensor = torch.ops.onednn.qlinear_pointwise(
            bytes_, scale, zero_point, self._packed, self._scale, self._zero_point, self._bias,
            1.0, 0, torch.float32, "none", [], "",
        )  # fmt: skip
        return out.reshape(*x.shape[:-1], self._outputs)


def _largest(weight: Tensor) -> Tensor:
    """Largest absolute value in each row, or sum of two neighbours of one sign, if that is larger.

    AVX2 adds the products of two neighbouring weights in 16 bits, which saturate. They cannot where the two
    weights together have at most 128 levels, because 128 * 255 < 2^15.
    """
    pairs = [part[:, :-1] + part[:, 1:] for part in (weight.clamp_min(0.0), -weight.clamp_max(0.0))]
    return torch.cat([weight.abs(), *pairs], dim=1).amax(dim=1)


def check_int8(device: str) -> None:
    """Check that :class:`Int8Linear` works here, where it is faster than float32.

    Raises:
        ConfigError: the device is no CPU, the processor lacks AVX2, or this PyTorch has no such kernels.
    """
    if device != "cpu":
        raise ConfigError(f"int8 runs on the CPU only, not on '{device}'")
    if "avx2" not in instructions():
        raise ConfigError("int8 needs a processor with AVX2")
    rows, inputs, outputs = _CHECKED_SHAPE
    x = torch.arange(float(rows * inputs)).sin().reshape(rows, inputs)
    weight = torch.arange(float(outputs * inputs)).cos().reshape(outputs, inputs)
    bias = torch.arange(float(outputs))
    expected = nn.functional.linear(x, weight, bias)
    try:
        error = (Int8Linear(weight, bias)(x) - expected).norm() / expected.norm()
    except (AttributeError, RuntimeError) as problem:
        reason = (str(problem).splitlines() or [type(problem).__name__])[0]
        raise ConfigError(f"PyTorch {torch.__version__} has no int8 kernels here: {reason}") from problem
    if not error < _CHECKED_ERROR:
        raise ConfigError(f"the int8 kernels of PyTorch {torch.__version__} are wrong here by {error:.3f}")


def to_int8(backbone: DinoV2) -> DinoV2:
    """``backbone`` with the linear layers of its blocks in int8, changed in place.

    The factors of LayerScale become part of the layers before them.
    """
    for block in cast("list[Block]", list(backbone.blocks)):
        for owner, name, factor in (
            (block.attn, "qkv", None),
            (block.attn, "proj", block.ls1),
            (block.mlp, "fc1", None),
            (block.mlp, "fc2", block.ls2),
        ):
            layer = cast(nn.Linear, getattr(owner, name))
            weight, bias = layer.weight.detach(), layer.bias.detach()
            if isinstance(factor, LayerScale):
                weight, bias = weight * factor.gamma[:, None], bias * factor.gamma
            setattr(owner, name, Int8Linear(weight, bias))
        block.ls1 = block.ls2 = nn.Identity()
    return backbone
