# SPDX-License-Identifier: Apache-2.0
"""The ``.pth`` files of Depth Anything V2: their layout key by key, and what comes out, by number.

The figures are of formula-made weights. They were taken from a decoder of our own, which agreed with the
ports of transformers 5.23, before these ports took its place.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from depth_frames import frame_of
from torch import Tensor

from slamdepth.depth.card import card_of
from slamdepth.depth.checkpoints import read_checkpoint
from slamdepth.depth.hub_official import depth_anything_config, depth_anything_tensors
from slamdepth.depth.layout import dinov2_layout
from slamdepth.errors import WeightsError
from slamdepth.types import DepthKind

Layout = dict[str, tuple[int, ...]]
INDOOR, RELATIVE = "depth-anything-v2-small-metric-indoor", "depth-anything-v2-small"


def conv(name: str, out: int, into: int, kernel: int, bias: bool = True) -> Layout:
    shapes: Layout = {f"{name}.weight": (out, into, kernel, kernel)}
    return {**shapes, f"{name}.bias": (out,)} if bias else shapes


def layout(dim: int, depth: int, features: int, stages: tuple[int, ...], grid: int = 37) -> Layout:
    """Copied from a listing of the published files."""
    vit = {**dinov2_layout(dim, depth, grid=grid), "mask_token": (1, dim)}
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


SIZES = {
    "small": (384, 12, 64, (48, 96, 192, 384), 24.785),
    "base": (768, 12, 128, (96, 192, 384, 768), 97.471),
    "large": (1024, 24, 256, (256, 512, 1024, 1024), 335.316),
}


def wave(shape: tuple[int, ...], phase: float) -> Tensor:
    count = math.prod(shape)
    return torch.from_numpy(np.sin(0.7 * np.arange(count) + phase)).float().reshape(shape)


def formula_made(shapes: Layout) -> dict[str, Tensor]:
    tensors = {}
    names = sorted(name for name in shapes if not name.endswith("mask_token"))
    for index, name in enumerate(names):
        shape = shapes[name]
        fan_in = math.prod(shape[1:]) if len(shape) > 1 else 16
        value = 2 * wave(shape, float(index)) / math.sqrt(fan_in)
        tensors[name] = value + 1.0 if "norm" in name and name.endswith("weight") else value
    last = "depth_head.scratch.output_conv2.2"
    tensors[f"{last}.weight"] *= 0.2
    tensors[f"{last}.bias"] = torch.full((1,), 4.0)  # away from where the activations are flat
    return tensors


@pytest.mark.parametrize("size", SIZES)
def test_the_shapes_of_an_official_file_give_its_network(size: str) -> None:
    dim, depth, features, stages, million = SIZES[size]
    shapes = layout(dim, depth, features, stages)
    assert sum(math.prod(shape) for shape in shapes.values()) / 1e6 == pytest.approx(million, abs=1e-3)
    theirs = {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
    config = depth_anything_config(theirs, "x", None)
    backbone = config["backbone_config"]
    assert (backbone["hidden_size"], backbone["num_hidden_layers"]) == (dim, depth)
    assert (backbone["num_attention_heads"], backbone["image_size"]) == (dim // 64, 518)
    assert backbone["out_indices"] == ([5, 12, 18, 24] if size == "large" else [3, 6, 9, 12])
    assert (config["neck_hidden_sizes"], config["fusion_hidden_size"]) == (list(stages), features)
    assert sum(value.numel() for value in depth_anything_tensors(theirs, "x").values()) == sum(
        math.prod(shape) for shape in shapes.values()
    )


def test_the_numbers_are_those_of_the_authors_network(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("transformers", reason="needs pip install 'slamdepth[hub]'")
    from slamdepth.depth.hub import build_network

    theirs = formula_made(layout(24, 4, 16, (4, 6, 8, 10), grid=5))
    outs = []
    for max_depth_m in (None, 20.0):
        config = depth_anything_config(theirs, "x", max_depth_m)
        config["backbone_config"]["num_attention_heads"] = 3
        network = build_network(config, depth_anything_tensors(theirs, "x"), "x")
        with torch.inference_mode():
            outs.append(network(wave((1, 3, 70, 70), 0.3)).predicted_depth)
    assert not caplog.records  # no tensor is left over
    relative, metric = outs
    assert relative.shape == (1, 70, 70)
    spots = [float(relative[0, 70 * r // 4, 70 * c // 4]) for r, c in ((0, 0), (1, 2), (2, 1), (3, 3))]
    np.testing.assert_allclose(spots, [3.545363, 3.585024, 3.470793, 2.610439], rtol=1e-3)
    seen = relative > 0
    torch.testing.assert_close(metric[seen], 20 * torch.sigmoid(relative[seen]))


def test_a_file_in_the_cache_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("transformers", reason="needs pip install 'slamdepth[hub]'")
    from slamdepth.depth.hub import HubDepth
    from slamdepth.depth.registry import create_depth_model

    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path))
    tensors = formula_made(layout(64, 4, 16, (4, 6, 8, 10), grid=5))
    torch.save(
        {**tensors, "pretrained.mask_token": torch.zeros(1, 64)}, tmp_path / "depth_anything_v2_vits.pth"
    )
    metric_file = tmp_path / "depth_anything_v2_metric_hypersim_vits.pth"
    torch.save(tensors, metric_file)
    for name, kind in ((RELATIVE, DepthKind.AFFINE_INVERSE_DEPTH), (INDOOR, DepthKind.METRIC)):
        model = create_depth_model(name)
        assert isinstance(model, HubDepth)
        assert (model.name, model.kind) == (name, kind)
        assert model.predict(frame_of()).values.shape == (48, 64)
    card = card_of(model)
    assert card is not None
    assert card.range_m == (0.0, 20.0)
    with pytest.raises(WeightsError, match="named as a metric model"):
        create_depth_model(RELATIVE, weights=metric_file)
    with pytest.raises(WeightsError, match="takes a folder with"):
        create_depth_model("zoedepth-nyu", weights=metric_file)
    del tensors["depth_head.scratch.output_conv1.bias"]
    torch.save(tensors, metric_file)
    with pytest.raises(WeightsError, match=r"1 missing \(first: head\.conv1\.bias\)"):
        create_depth_model(INDOOR)


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
def test_unreadable_files_are_one_line(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"depth_anything_v2_vits.{ending}"
    for content in (b"", b"hello", b"PK\x03\x04" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(WeightsError, match=r"not a readable weights file: [A-Z]") as error:
            read_checkpoint(path)
        assert "\n" not in str(error.value)
    torch.save({"epoch": 3}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match="'epoch' is none"):
        read_checkpoint(tmp_path / "other.pth")


def test_another_layout_is_refused() -> None:
    tensors = formula_made(layout(24, 4, 16, (4, 6, 8, 10), grid=5))
    with pytest.raises(WeightsError, match=r"1 unexpected tensors \(first: depth_head\.extra\)"):
        depth_anything_tensors({**tensors, "depth_head.extra": torch.zeros(2)}, "x.pth")
    key = "pretrained.norm.bias"
    with pytest.raises(WeightsError, match=rf"x\.pth: tensor {key} is torch\.int32"):
        depth_anything_tensors({**tensors, key: torch.zeros(24, dtype=torch.int32)}, "x.pth")
    with pytest.raises(WeightsError, match=r"layer1_rn\.weight' is missing"):
        depth_anything_config({n: v for n, v in tensors.items() if "layer1_rn" not in n}, "x.pth", None)
