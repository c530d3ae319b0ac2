# SPDX-License-Identifier: Apache-2.0
"""Tiny random depth models of every family, saved in the hub's layout by transformers itself.

Import it after ``pytest.importorskip("transformers")``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import transformers

VIT = {"hidden_size": 24, "num_hidden_layers": 4, "num_attention_heads": 3}
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HALF = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}


def dinov2(**values: Any) -> Any:
    return transformers.Dinov2Config(
        **VIT, image_size=70, patch_size=14, out_indices=[1, 2, 3, 4], apply_layernorm=True,
        reshape_hidden_states=False, **values,
    )  # fmt: skip


def depth_anything(kind: str, max_depth: int) -> Any:
    return transformers.DepthAnythingConfig(
        backbone_config=dinov2(), patch_size=14, reassemble_hidden_size=24, neck_hidden_sizes=[4, 6, 8, 10],
        fusion_hidden_size=16, head_hidden_size=8, depth_estimation_type=kind, max_depth=max_depth,
    )  # fmt: skip


def dpt(**values: Any) -> Any:
    return transformers.DPTConfig(
        **VIT, intermediate_size=48, image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[4, 6, 8, 10], fusion_hidden_size=256, is_hybrid=False, **values,
    )  # fmt: skip


def dpt_dinov2() -> Any:
    return transformers.DPTConfig(
        backbone_config=dinov2(), neck_hidden_sizes=[4, 6, 8, 10], fusion_hidden_size=256,
        add_projection=True, is_hybrid=False, readout_type="project",
    )  # fmt: skip


def zoedepth(*bins: tuple[str, float]) -> Any:
    backbone = transformers.BeitConfig(
        **VIT, intermediate_size=48, image_size=64, patch_size=16, out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False, use_relative_position_bias=True,
    )  # fmt: skip
    return transformers.ZoeDepthConfig(
        backbone_config=backbone, backbone_hidden_size=24, neck_hidden_sizes=[4, 6, 8, 10],
        fusion_hidden_size=16, bottleneck_features=16, bin_embedding_dim=8, num_attractors=[4, 2, 2, 1],
        patch_transformer_hidden_size=8, patch_transformer_intermediate_size=16, num_relative_features=32,
        patch_transformer_num_attention_heads=2,
        bin_configurations=[
            {"n_bins": 8, "min_depth": 0.001, "max_depth": far, "name": name} for name, far in bins
        ],
    )  # fmt: skip


def glpn(max_depth: int) -> Any:
    return transformers.GLPNConfig(
        hidden_sizes=[8, 8, 16, 16], depths=[1, 1, 1, 1], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16, max_depth=max_depth,
    )  # fmt: skip


def depth_pro() -> Any:
    vit = {"model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
           "image_size": 32, "patch_size": 8}  # fmt: skip
    return transformers.DepthProConfig(
        patch_size=32, fusion_hidden_size=16, intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[16, 16], scaled_images_ratios=[0.25, 0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.5, 0.25], scaled_images_feature_dims=[16, 16, 16],
        merge_padding_value=0, use_fov_model=True, num_fov_head_layers=0,
        image_model_config=dict(vit), patch_model_config=dict(vit), fov_model_config=dict(vit),
    )  # fmt: skip


def tipsv2() -> Any:
    vit = {"model_type": "tipsv2_vision_model", "hidden_size": 24, "num_hidden_layers": 4,
           "num_attention_heads": 3, "intermediate_size": 48, "image_size": 56, "patch_size": 14,
           "out_indices": [1, 2, 3, 4], "apply_layernorm": True, "reshape_hidden_states": False}  # fmt: skip
    return transformers.AutoConfig.for_model(
        "tipsv2_dpt", backbone_config=vit, neck_hidden_sizes=[4, 6, 8, 10], fusion_hidden_size=16,
        num_depth_bins=16,
    )  # fmt: skip


def side(pixels: int, across: int | None = None) -> dict[str, int]:
    return {"height": pixels, "width": across or pixels}


FAMILIES: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "relative": (
        lambda: depth_anything("relative", 1),
        {**IMAGENET, "size": side(70), "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3},
    ),
    "metric": (
        lambda: depth_anything("metric", 20),
        {**IMAGENET, "size": side(70), "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3},
    ),
    "outdoor": (
        lambda: depth_anything("metric", 80),
        {**IMAGENET, "size": side(70), "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3},
    ),
    "dpt": (dpt, {**HALF, "size": 64, "resample": 2}),
    "dpt_dinov2": (
        dpt_dinov2,
        {
            "do_resize": False, "do_rescale": False, "do_pad": True, "size_divisor": 14,
            "image_mean": [123.675, 116.28, 103.53], "image_std": [58.395, 57.12, 57.375],
        },
    ),
    "zoedepth": (
        lambda: zoedepth(("nyu", 10.0)),
        {**HALF, "size": side(64, 96), "keep_aspect_ratio": True, "ensure_multiple_of": 32, "do_pad": True,
         "resample": 2},
    ),
    "glpn": (lambda: glpn(10), {"size_divisor": 32, "do_normalize": False, "resample": 2}),
    "depth_pro": (depth_pro, {**HALF, "size": side(128), "resample": 2}),
    "tipsv2_dpt": (tipsv2, {"do_normalize": False, "size": side(56), "resample": 2}),
}  # fmt: skip
"""Configuration and image processor of each family."""


def save_tiny(folder: Path, family: str) -> torch.nn.Module:
    """Save a random model of ``family`` into ``folder`` and return its network."""
    make, preprocessor = FAMILIES[family]
    torch.manual_seed(0)
    config = make()
    network: torch.nn.Module = transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING[type(config)](config).eval()
    for name, value in network.named_parameters():
        if value.ndim > 1:  # larger than transformers' own, so that depth differs from pixel to pixel
            torch.nn.init.normal_(value, std=value[0].numel() ** -0.5)
        if name.endswith(("head.conv3.bias", "head.head.4.bias", "head.layers.4.bias")):
            torch.nn.init.constant_(value, 1.0)  # away from where activations are flat
    network.save_pretrained(folder)  # type: ignore[operator]
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor))
    return network
