# SPDX-License-Identifier: Apache-2.0
"""Extract the DINOv2 ViT-S/14 from an ONNX export, under its official tensor names.

The export names biases, norms and layer scales after the Hugging Face port. Its Linear weights are anonymous
and transposed, so they are found through the MatMul node that uses them. Query, key and value are stacked to
the official ``attn.qkv``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.layout import check_layout, dinov2_layout
from slamdepth.errors import WeightsError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Tensors = dict[str, NDArray[np.float32]]

_BLOCK_NAMES = {
    "norm1.weight": "norm1.weight",
    "norm1.bias": "norm1.bias",
    "norm2.weight": "norm2.weight",
    "norm2.bias": "norm2.bias",
    "layer_scale1.lambda1": "ls1.gamma",
    "layer_scale2.lambda1": "ls2.gamma",
    "attention.output.dense.bias": "attn.proj.bias",
    "mlp.fc1.bias": "mlp.fc1.bias",
    "mlp.fc2.bias": "mlp.fc2.bias",
}
_BLOCK_MATMULS = {
    "attention/output/dense": "attn.proj.weight",
    "mlp/fc1": "mlp.fc1.weight",
    "mlp/fc2": "mlp.fc2.weight",
}
_QKV = ("query", "key", "value")


def dinov2_from_onnx(path: Path) -> Tensors:
    """The tensors of the backbone in the ONNX file at ``path``, by official name, float32.

    Raises:
        WeightsError: the file is no ONNX model, or a tensor of the backbone is missing or misshapen; names
            it.
    """
    import onnx
    from onnx import numpy_helper

    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # protobuf raises its own types
        raise WeightsError(f"{path}: not a readable ONNX file: {error}") from error
    initialisers: Tensors = {
        tensor.name: numpy_helper.to_array(tensor).astype(np.float32) for tensor in graph.initializer
    }
    matmuls = {
        node.name: name
        for node in graph.node
        if node.op_type == "MatMul"
        for name in node.input
        if name in initialisers
    }
    tensors = _renamed(initialisers, matmuls, str(path))
    check_layout({name: value.shape for name, value in tensors.items()}, dinov2_layout(), str(path))
    return tensors


def _renamed(initialisers: Tensors, matmuls: dict[str, str], origin: str) -> Tensors:
    def named(name: str) -> NDArray[np.float32]:
        if name not in initialisers:
            raise WeightsError(f"{origin}: the tensor {name} is missing")
        return initialisers[name]

    def linear(node: str) -> NDArray[np.float32]:
        if node not in matmuls:
            raise WeightsError(f"{origin}: the weight of the node {node} is missing")
        transposed: NDArray[np.float32] = initialisers[matmuls[node]].T
        return transposed

    out: Tensors = {
        "cls_token": named("backbone.embeddings.cls_token"),
        "pos_embed": np.concatenate(
            [
                _only(initialisers, (1, 1, 384), "onnx::", origin),
                _only(initialisers, (1, 1369, 384), "onnx::", origin),
            ],
            axis=1,
        ),
        "patch_embed.proj.weight": named("backbone.embeddings.patch_embeddings.projection.weight"),
        "patch_embed.proj.bias": named("backbone.embeddings.patch_embeddings.projection.bias"),
        "norm.weight": named("backbone.layernorm.weight"),
        "norm.bias": named("backbone.layernorm.bias"),
    }
    for index in range(12):
        source, target = f"backbone.encoder.layer.{index}.", f"blocks.{index}."
        node = f"/backbone/encoder/layer.{index}/"
        for theirs, ours in _BLOCK_NAMES.items():
            out[target + ours] = named(source + theirs)
        for theirs, ours in _BLOCK_MATMULS.items():
            out[target + ours] = linear(f"{node}{theirs}/MatMul")
        out[target + "attn.qkv.weight"] = np.concatenate(
            [linear(f"{node}attention/attention/{part}/MatMul") for part in _QKV]
        )
        out[target + "attn.qkv.bias"] = np.concatenate(
            [named(f"{source}attention.attention.{part}.bias") for part in _QKV]
        )
    return {name: np.ascontiguousarray(value) for name, value in out.items()}


def _only(initialisers: Tensors, shape: tuple[int, ...], prefix: str, origin: str) -> NDArray[np.float32]:
    matches = [v for n, v in initialisers.items() if v.shape == shape and n.startswith(prefix)]
    if len(matches) != 1:
        raise WeightsError(
            f"{origin}: expected one anonymous tensor of shape {shape} (position embedding), "
            f"found {len(matches)}"
        )
    return matches[0]
