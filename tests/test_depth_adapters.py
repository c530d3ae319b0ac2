# SPDX-License-Identifier: Apache-2.0
"""Low-rank changes of a backbone: beside its weights, in them, blended, and in the file of a head."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from slamdepth.depth.adapters import Adapters, blended
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import HeadEnsemble, HeadShape, load_head, save_head
from slamdepth.depth.model import Dinov2Depth
from slamdepth.errors import WeightsError
from slamdepth.types import Camera, Frame

SHAPE = HeadShape((0, 2), 24, 16, 1, 8, members=2, adapted_blocks=2, adapter_rank=3)
IMAGE = torch.linspace(-1, 1, 3 * 28 * 42).reshape(1, 3, 28, 42)


def backbone() -> DinoV2:
    torch.manual_seed(0)
    return DinoV2(dim=24, depth=3, heads=3, grid=5).eval().requires_grad_(False)


def changed(seed: int, blocks: int = 2, dim: int = 24) -> Adapters:
    torch.manual_seed(seed)
    adapters = Adapters(dim, blocks, 3)
    for parameter in adapters.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return adapters.requires_grad_(False)


def tokens(model: DinoV2) -> list[torch.Tensor]:
    return [grid for grid, _ in model(IMAGE, (0, 1, 2))]


def test_untrained_adapters_change_nothing() -> None:
    model, merged = backbone(), backbone()
    Adapters(24, 2, 3).merge_into(merged)
    torch.testing.assert_close(tokens(merged), tokens(model), rtol=0, atol=0)


def test_beside_the_weights_and_in_them_adapters_do_the_same_to_the_last_blocks() -> None:
    model, adapters = backbone(), changed(1)
    before = tokens(model)
    with adapters.beside(model):
        beside = tokens(model)
    torch.testing.assert_close(tokens(model), before, rtol=0, atol=0)  # they are gone again
    adapters.merge_into(model)
    merged = tokens(model)
    torch.testing.assert_close(merged, beside, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(merged[0], before[0], rtol=0, atol=0)
    assert all(
        float((now - then).abs().max()) > 0.01 for now, then in zip(merged[1:], before[1:], strict=True)
    )


def test_a_blend_is_the_share_of_the_mean_of_the_changes() -> None:
    one, other, twice = changed(1), changed(2), backbone()
    plain = {name: value.clone() for name, value in twice.state_dict().items()}
    expected = copy.deepcopy(plain)
    for adapters in (one, other):
        model = backbone()
        adapters.merge_into(model)
        for name, value in model.state_dict().items():
            expected[name] = expected[name] + 0.3 * (value - plain[name])
    blended([one, other], 0.6).merge_into(twice)
    for name, value in twice.state_dict().items():
        torch.testing.assert_close(value, expected[name], rtol=1e-4, atol=1e-5)


def test_adapters_are_merged_once() -> None:
    model, adapters = backbone(), changed(1)
    adapters.merge_into(model)
    once = tokens(model)
    adapters.merge_into(model)
    torch.testing.assert_close(tokens(model), once, rtol=0, atol=0)
    with pytest.raises(WeightsError, match="adapters of another head"):
        changed(2).merge_into(model)


def test_adapters_of_another_backbone_are_refused() -> None:
    with pytest.raises(WeightsError, match="adapters of 4 blocks do not fit a backbone of 3"):
        changed(1, blocks=4).merge_into(backbone())
    with pytest.raises(WeightsError, match="adapters of width 12 do not fit a backbone of 24"):
        changed(1, dim=12).merge_into(backbone())


def head_with(adapters: Adapters | None) -> HeadEnsemble:
    torch.manual_seed(3)
    shape = SHAPE if adapters is not None else replace(SHAPE, adapted_blocks=0, adapter_rank=0)
    head = HeadEnsemble(shape).eval()
    torch.manual_seed(4)
    for member in head.members:
        torch.nn.init.normal_(member.get_parameter("out.weight"), std=0.3)
    if adapters is not None and head.adapters is not None:
        head.adapters.load_state_dict(adapters.state_dict())
    return head


def test_a_model_reads_the_adapted_backbone(tmp_path: Path) -> None:
    save_head(tmp_path / "h.safetensors", head_with(changed(1)), {"licence": "x"})
    head, _ = load_head(tmp_path / "h.safetensors")
    assert (head.shape.adapted_blocks, head.shape.adapter_rank) == (2, 3)
    noise = torch.randint(0, 255, (60, 80, 3), generator=torch.Generator().manual_seed(0)).byte().numpy()
    frame = Frame(0, 0.0, noise, Camera(80, 60, 70.0, 70.0, 40.0, 30.0))
    adapted = Dinov2Depth(backbone(), head, (), precision="float32", input_px=28 * 42).predict(frame)
    own = backbone()
    changed(1).merge_into(own)
    own.adapted_by = ()
    merged = Dinov2Depth(own, head_with(None), (), precision="float32", input_px=28 * 42).predict(frame)
    plain = Dinov2Depth(backbone(), head_with(None), (), precision="float32", input_px=28 * 42).predict(frame)
    assert abs(adapted.values / merged.values - 1).max() < 0.005  # the file is in half precision
    assert abs(adapted.values / plain.values - 1).max() > 0.02
