# SPDX-License-Identifier: Apache-2.0
"""What the published networks compute, by number.

The figures are of formula-made weights, taken once from these networks after they had been
compared, over random weights and four input sizes, with the ports of the same networks in
the transformers library 5.23: no difference for Depth Anything V2, 2e-5 relative for
DINOv2's DPT head (there with the position embedding resized the port's way).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from slamdepth.depth.dinov2_heads import DptHead
from slamdepth.depth.dpt import DepthAnything, DptShape

SHAPE = DptShape(24, 4, 3, (0, 1, 2, 3), 16, (4, 6, 8, 10), grid=5)


def wave(shape: tuple[int, ...], phase: float) -> Tensor:
    count = math.prod(shape)
    return torch.from_numpy(np.sin(0.7 * np.arange(count) + phase)).float().reshape(shape)


def fill(network: nn.Module) -> None:
    for index, (name, value) in enumerate(sorted(network.state_dict().items())):
        fan_in = math.prod(value.shape[1:]) if value.ndim > 1 else 16
        value.copy_(2 * wave(tuple(value.shape), float(index)) / math.sqrt(fan_in))
        if "norm" in name and name.endswith("weight"):
            value.add_(1.0)


def spots(out: Tensor) -> list[float]:
    rows, columns = out.shape[-2:]
    return [float(out[0, r * rows // 4, c * columns // 4]) for r, c in ((0, 0), (1, 2), (2, 1), (3, 3))]


def test_depth_anything_relative_and_metric() -> None:
    outs = []
    for max_depth_m in (None, 20.0):
        network = DepthAnything(SHAPE, max_depth_m).eval().requires_grad_(False)
        fill(network)
        last = network.get_submodule("depth_head.scratch.output_conv2.2")
        last.get_parameter("weight").mul_(0.2)
        last.get_parameter("bias").fill_(4.0)  # away from where the activations are flat
        outs.append(network(wave((1, 3, 42, 98), 0.3)))
    relative, metric = outs
    assert relative.shape == (1, 42, 98)
    np.testing.assert_allclose(spots(relative), [3.465828, 1.210708, 3.403812, 0.601499], rtol=1e-3)
    seen = relative > 0
    torch.testing.assert_close(metric[seen], 20 * torch.sigmoid(relative[seen]))


def test_official_dpt_head() -> None:
    head = DptHead(24, 10.0, channels=16).eval().requires_grad_(False)
    fill(head)
    tapped = [(wave((1, 24, 3, 7), float(tap)), wave((1, 24), 2.0 * tap)) for tap in range(4)]
    out = head(tapped)
    assert out.shape == (1, 64, 128)
    np.testing.assert_allclose(spots(out), [2.67426, 0.781143, 15.67047, 18.31520], rtol=1e-3)
