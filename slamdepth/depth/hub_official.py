# SPDX-License-Identifier: Apache-2.0
"""The files that the authors of Depth Anything V2 publish (``.pth``), under the tensor names of the hub.

Relative and metric files have the same tensors and differ in their names only, so a metric model refuses a
file whose name does not say what it was trained on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from slamdepth.depth.hub_models import METRIC, HubModel
from slamdepth.errors import WeightsError

_WORDS = ("metric", "hypersim", "vkitti", "indoor", "outdoor")
_RENAMED = (
    (r"pretrained\.cls_token", "backbone.embeddings.cls_token"),
    (r"pretrained\.mask_token", "backbone.embeddings.mask_token"),
    (r"pretrained\.pos_embed", "backbone.embeddings.position_embeddings"),
    (r"pretrained\.patch_embed\.proj\.", "backbone.embeddings.patch_embeddings.projection."),
    (r"pretrained\.norm\.", "backbone.layernorm."),
    (r"pretrained\.blocks\.(\d+)\.(norm[12]|mlp\.fc[12])\.", r"backbone.encoder.layer.\1.\2."),
    (r"pretrained\.blocks\.(\d+)\.ls([12])\.gamma", r"backbone.encoder.layer.\1.layer_scale\2.lambda1"),
    (r"pretrained\.blocks\.(\d+)\.attn\.proj\.", r"backbone.encoder.layer.\1.attention.output.dense."),
    (r"depth_head\.projects\.(\d)\.", r"neck.reassemble_stage.layers.\1.projection."),
    (r"depth_head\.resize_layers\.(\d)\.", r"neck.reassemble_stage.layers.\1.resize."),
    (r"depth_head\.scratch\.output_conv1\.", "head.conv1."),
    (r"depth_head\.scratch\.output_conv2\.0\.", "head.conv2."),
    (r"depth_head\.scratch\.output_conv2\.2\.", "head.conv3."),
)
_ATTENTION = re.compile(r"pretrained\.blocks\.(\d+)\.attn\.qkv\.(weight|bias)")
_REDUCED = re.compile(r"depth_head\.scratch\.layer([1-4])_rn\.(weight)")
_FUSION = re.compile(
    r"depth_head\.scratch\.refinenet([1-4])\.(out_conv|resConfUnit([12])\.conv([12]))\.(\w+)"
)


def depth_anything_tensors(theirs: Mapping[str, torch.Tensor], origin: str) -> dict[str, torch.Tensor]:
    """All tensors of an official file, renamed; query, key and value are taken apart.

    Args:
        theirs: by official name.
        origin: the file, named in errors.

    Raises:
        WeightsError: a name does not belong to the layout, or a tensor is no floating point; names the first.
    """
    ours: dict[str, torch.Tensor] = {}
    unknown = []
    for name, value in theirs.items():
        if not value.is_floating_point():
            raise WeightsError(f"{origin}: tensor {name} is {value.dtype}, not floating point")
        renamed = dict(_renamed(name, value))
        if not renamed:
            unknown.append(name)
        ours |= renamed
    if unknown:
        raise WeightsError(
            f"{origin}: not the layout of Depth Anything V2: {len(unknown)} unexpected tensors (first: "
            f"{unknown[0]})"
        )
    return ours


def depth_anything_config(
    theirs: Mapping[str, torch.Tensor], origin: str, max_depth_m: float | None
) -> dict[str, Any]:
    """The ``config.json`` of a network with the shapes of an official file.

    Args:
        theirs: by official name.
        origin: the file, named in errors.
        max_depth_m: largest depth of a metric model; None for a relative one.

    Raises:
        WeightsError: the tensors that give the shapes are missing.
    """
    try:
        patch = theirs["pretrained.patch_embed.proj.weight"]
        tokens = theirs["pretrained.pos_embed"].shape[1]
        reduced = [theirs[f"depth_head.scratch.layer{index}_rn.weight"].shape for index in (1, 2, 3, 4)]
        hidden = theirs["depth_head.scratch.output_conv2.0.weight"].shape[0]
    except (KeyError, IndexError) as error:
        raise WeightsError(f"{origin}: not the layout of Depth Anything V2: {error} is missing") from error
    dim = int(patch.shape[0])
    depth = 1 + max((int(found[1]) for name in theirs if (found := _ATTENTION.fullmatch(name))), default=-1)
    grid = round((tokens - 1) ** 0.5)
    # A ViT-L is read after blocks 4, 11, 17 and 23, the smaller ones after every quarter.
    taps = [5, 12, 18, 24] if depth == 24 else [depth * quarter // 4 for quarter in (1, 2, 3, 4)]
    return {
        "model_type": "depth_anything",
        "backbone_config": {
            "model_type": "dinov2",
            "hidden_size": dim,
            "num_hidden_layers": depth,
            "num_attention_heads": max(1, dim // 64),
            "image_size": grid * int(patch.shape[-1]),
            "patch_size": int(patch.shape[-1]),
            "out_indices": taps,
            "apply_layernorm": True,
            "reshape_hidden_states": False,
        },
        "patch_size": int(patch.shape[-1]),
        "reassemble_hidden_size": dim,
        "neck_hidden_sizes": [int(shape[1]) for shape in reduced],
        "fusion_hidden_size": int(reduced[0][0]),
        "head_hidden_size": int(hidden),
        "depth_estimation_type": "relative" if max_depth_m is None else "metric",
        "max_depth": 1 if max_depth_m is None else round(max_depth_m),
    }


def check_name(path: Path, model: str, known: HubModel) -> None:
    """Check that the name of an official file fits a model: nothing else tells relative from metric weights.

    Raises:
        WeightsError: it does not.
    """
    name, stem = path.name.lower(), str(known.official)
    if known.kind is not METRIC:
        if any(word in name for word in _WORDS):
            raise WeightsError(f"{path}: named as a metric model; '{model}' is the relative one ({stem}.pth)")
        return
    word = "hypersim" if "hypersim" in stem else "vkitti"
    other = "vkitti" if word == "hypersim" else "hypersim"
    if "metric" not in name or word not in name or other in name:
        raise WeightsError(
            f"{path}: relative and metric files differ in nothing but their names, and this name does not "
            f"say '{word}' metric; '{model}' takes {stem}.pth"
        )


def _renamed(name: str, value: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
    """The hub's names of a tensor with the official one ``name``, with their values; none where it is
    unknown."""
    if (found := _ATTENTION.fullmatch(name)) is not None:
        for part, rows in zip(("query", "key", "value"), value.chunk(3), strict=True):
            yield f"backbone.encoder.layer.{found[1]}.attention.attention.{part}.{found[2]}", rows
    elif (found := _REDUCED.fullmatch(name)) is not None:
        yield f"neck.convs.{int(found[1]) - 1}.{found[2]}", value
    elif (found := _FUSION.fullmatch(name)) is not None:
        part = f"residual_layer{found[3]}.convolution{found[4]}" if found[3] else "projection"
        yield f"neck.fusion_stage.layers.{4 - int(found[1])}.{part}.{found[5]}", value
    else:
        for theirs, ours in _RENAMED:
            # A pattern that ends in a dot goes up to a last part, such as "weight".
            tail = r"(?P<tail>weight|bias)" if theirs.endswith(r"\.") else r"(?P<tail>)"
            if (found := re.fullmatch(theirs + tail, name)) is not None:
                yield found.expand(ours) + found["tail"], value
