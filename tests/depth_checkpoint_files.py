# SPDX-License-Identifier: Apache-2.0
"""Tensor names and shapes of published depth checkpoints, and files of random tensors in these layouts.

The layouts are copied from listings of the published files, not derived from our networks.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from slamdepth.depth import weights as store
from slamdepth.depth.layout import dinov2_layout
from slamdepth.types import Camera, Frame

Layout = dict[str, tuple[int, ...]]


def conv(name: str, out: int, into: int, kernel: int, bias: bool = True) -> Layout:
    shapes: Layout = {f"{name}.weight": (out, into, kernel, kernel)}
    return {**shapes, f"{name}.bias": (out,)} if bias else shapes


def depth_anything_layout(dim: int, depth: int, features: int, stages: tuple[int, ...]) -> Layout:
    vit = {**dinov2_layout(dim, depth), "mask_token": (1, dim)}
    shapes: Layout = {f"pretrained.{name}": shape for name, shape in vit.items()}
    head = "depth_head."
    for i, stage in enumerate(stages):
        shapes |= conv(f"{head}projects.{i}", stage, dim, 1)
        shapes |= conv(f"{head}scratch.layer{i + 1}_rn", features, stage, 3, bias=False)
        fusion = f"{head}scratch.refinenet{i + 1}."
        shapes |= conv(f"{fusion}out_conv", features, features, 1)
        for unit in ("resConfUnit1.conv1", "resConfUnit1.conv2", "resConfUnit2.conv1", "resConfUnit2.conv2"):
            shapes |= conv(fusion + unit, features, features, 3)
    for i, kernel in ((0, 4), (1, 2), (3, 3)):
        shapes |= conv(f"{head}resize_layers.{i}", stages[i], stages[i], kernel)
    shapes |= conv(f"{head}scratch.output_conv1", features // 2, features, 3)
    shapes |= conv(f"{head}scratch.output_conv2.0", 32, features // 2, 3)
    return shapes | conv(f"{head}scratch.output_conv2.2", 1, 32, 1)


def official_dpt_layout() -> Layout:
    shapes: Layout = {}
    blocks = "decode_head.reassemble_blocks."
    for i, stage in enumerate((48, 96, 192, 384)):
        shapes |= conv(f"{blocks}projects.{i}.conv", stage, 384, 1)
        shapes |= {f"{blocks}readout_projects.{i}.0.weight": (384, 768)}
        shapes |= {f"{blocks}readout_projects.{i}.0.bias": (384,)}
        shapes |= conv(f"decode_head.convs.{i}.conv", 256, stage, 3, bias=False)
        fusion = f"decode_head.fusion_blocks.{i}."
        shapes |= conv(f"{fusion}project.conv", 256, 256, 1)
        for unit in (1, 2) if i else (2,):
            for k in (1, 2):
                shapes |= conv(f"{fusion}res_conv_unit{unit}.conv{k}.conv", 256, 256, 3, bias=False)
    for i, stage, kernel in ((0, 48, 4), (1, 96, 2), (3, 384, 3)):
        shapes |= conv(f"{blocks}resize_layers.{i}", stage, stage, kernel)
    shapes |= conv("decode_head.project.conv", 256, 256, 3)
    for i, out, into, kernel in ((0, 128, 256, 3), (2, 32, 128, 3), (4, 1, 32, 1)):
        shapes |= conv(f"decode_head.conv_depth.head.{i}", out, into, kernel)
    return shapes


def linear_layout(layers: int) -> Layout:
    return conv("decode_head.conv_depth", 256, 768 * layers, 1)


def random_tensors(layout: Layout, seed: int = 0) -> dict[str, Tensor]:
    """Small weights; layer scales and norms near one, so that tokens differ from place to place."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in layout.items():
        fan_in = math.prod(shape[1:]) if len(shape) > 1 else 400
        value = torch.randn(shape, generator=generator) / math.sqrt(fan_in)
        tensors[name] = value + 1 if "norm" in name and name.endswith("weight") else value
    return tensors


def frame_of(width: int = 64, height: int = 48, focal: float = 60.0) -> Frame:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Frame(3, 0.1, image, Camera(width, height, focal, focal, width / 2, height / 2))


def write_random_files(folder: Path, small: dict[str, Tensor]) -> None:
    """Random files in the official layouts; ``small`` is Depth Anything's small one."""
    torch.save(small, folder / "depth_anything_v2_vits.pth")
    halves = {name: value.half() for name, value in small.items()}
    save_file(halves, str(folder / "depth_anything_v2_metric_hypersim_vits.safetensors"))
    vit = {k.removeprefix("pretrained."): v for k, v in halves.items() if k.startswith("pretrained.")}
    torch.save(vit, folder / store.OFFICIAL_FILE)
    for name, layout in (
        ("nyu_linear4", linear_layout(4)),
        ("kitti_linear", linear_layout(1)),
        ("nyu_dpt", official_dpt_layout()),
    ):
        meta = {"meta": {"epoch": 1}, "state_dict": random_tensors(layout)}
        torch.save(meta, folder / f"dinov2_vits14_{name}_head.pth")
