# SPDX-License-Identifier: Apache-2.0
"""Tiny networks with the inputs and outputs of ALIKED and LightGlue: what they find can be checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Shapes = Mapping[str, Sequence[int | str]]  # of named inputs or outputs; a word is a free size

SIDE = 640
CELL = 16


def write_aliked(path: Path, size: int = 128) -> Path:
    """Describes each square of 16 pixels by random filters; its keypoint is the square's middle."""
    count = SIDE // CELL
    filters = np.random.default_rng(0).normal(size=(size, 3, CELL, CELL)).astype(np.float32)
    filters = 0.02 * (filters - filters.mean(axis=(1, 2, 3), keepdims=True))
    middles = np.stack(np.meshgrid(np.arange(count), np.arange(count)), axis=-1).reshape(-1, 2)
    places = (middles * CELL + (CELL - 1) / 2) / (SIDE - 1) * 2 - 1
    nodes = [
        helper.make_node("Conv", ["image", "filters"], ["map"], strides=[CELL, CELL]),
        helper.make_node("Reshape", ["map", "shape"], ["flat"]),
        helper.make_node("Transpose", ["flat"], ["descriptors"], perm=[1, 0]),
        helper.make_node("ReduceL2", ["descriptors"], ["length"], axes=[1], keepdims=0),
        helper.make_node("Tanh", ["length"], ["scores"]),
        helper.make_node("Identity", ["places"], ["keypoints"]),
    ]
    constants = {
        "filters": filters,
        "shape": np.array([size, count * count]),
        "places": places.astype(np.float32),
    }
    return _save(
        path,
        nodes,
        {"image": [1, 3, SIDE, SIDE]},
        {"keypoints": [count**2, 2], "descriptors": [count**2, size], "scores": [count**2]},
        constants,
    )


def write_lightglue(path: Path) -> Path:
    """Gives each keypoint of the first image the nearest of the second, several the same one maybe."""
    nodes = [
        helper.make_node("Transpose", ["desc1"], ["turned"], perm=[0, 2, 1]),
        helper.make_node("MatMul", ["desc0", "turned"], ["alike"]),
        helper.make_node("ArgMax", ["alike"], ["best"], axis=2, keepdims=0),
        helper.make_node("Reshape", ["best", "column"], ["train"]),
        helper.make_node("Shape", ["train"], ["train_shape"]),
        helper.make_node("Gather", ["train_shape", "zero"], ["count"], axis=0),
        helper.make_node("Range", ["zero", "count", "one"], ["row"]),
        helper.make_node("Reshape", ["row", "column"], ["query"]),
        helper.make_node("Concat", ["query", "train"], ["matches0"], axis=1),
        helper.make_node("ReduceMax", ["alike"], ["most"], axes=[2], keepdims=0),
        helper.make_node("Reshape", ["most", "line"], ["mscores0"]),
    ]
    constants = {
        "column": np.array([-1, 1]),
        "line": np.array([-1]),
        "zero": np.array(0),
        "one": np.array(1),
    }
    inputs: Shapes = {
        "kpts0": [1, "N", 2],
        "kpts1": [1, "M", 2],
        "desc0": [1, "N", 128],
        "desc1": [1, "M", 128],
    }
    return _save(path, nodes, inputs, {"matches0": ["P", 2], "mscores0": ["P"]}, constants)


def _save(
    path: Path,
    nodes: list[onnx.NodeProto],
    inputs: Shapes,
    outputs: Shapes,
    constants: dict[str, np.ndarray],
) -> Path:
    def values(shapes: Shapes) -> list[onnx.ValueInfoProto]:
        return [
            helper.make_tensor_value_info(
                name, TensorProto.INT64 if name == "matches0" else TensorProto.FLOAT, shape
            )
            for name, shape in shapes.items()
        ]

    tensors = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, path.stem, values(inputs), values(outputs), tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, path)
    return path
