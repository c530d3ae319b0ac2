# SPDX-License-Identifier: Apache-2.0
"""The backbone, the head and their strict loaders, randomly initialised."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.head import (
    DepthHead,
    HeadEnsemble,
    HeadShape,
    load_head,
    save_head,
)
from slamdepth.depth.head_layers import convex_upsample
from slamdepth.depth.layout import check_layout, dinov2_layout, pack_about
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX, INPUT_PX, focal_px_at, input_size
from slamdepth.errors import WeightsError
from slamdepth.types import Camera

SMALL = HeadShape(taps=(0, 2), token_dim=24, dim=16, blocks=1, guide_dim=8, members=2)


def official_tensors() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {name: 0.02 * torch.randn(shape) for name, shape in dinov2_layout().items()}


def small_backbone() -> DinoV2:
    torch.manual_seed(0)
    return DinoV2(dim=24, depth=3, heads=3, grid=5).eval()


def test_layout_is_that_of_the_official_file() -> None:
    # 175 tensors with mask_token, 22.06 M parameters
    shapes = dinov2_layout()
    assert len(shapes) == 174
    assert sum(int(np.prod(s)) for s in shapes.values()) == 22_056_192
    assert {name: tuple(v.shape) for name, v in DinoV2().state_dict().items()} == shapes


@pytest.mark.parametrize("ending", ["safetensors", "pth"])
def test_loads_official_layout(tmp_path: Path, ending: str) -> None:
    tensors = official_tensors()
    path = tmp_path / f"dinov2.{ending}"
    if ending == "pth":
        torch.save({**tensors, "mask_token": torch.zeros(1, 384)}, path)
    else:
        save_file(tensors, path)
    model = load_dinov2(path)
    assert torch.equal(model.get_parameter("blocks.7.attn.qkv.weight"), tensors["blocks.7.attn.qkv.weight"])
    assert not model.training
    assert not any(p.requires_grad for p in model.parameters())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.pop("blocks.3.ls1.gamma"), "1 missing (first: blocks.3.ls1.gamma"),
        (lambda t: t.update(register_tokens=torch.zeros(1)), "1 unexpected (first: register_tokens"),
        (
            lambda t: t.update(pos_embed=torch.zeros(1, 257, 384)),
            "misshapen (first: pos_embed is (1, 257, 384)",
        ),
    ],
)
def test_strict_loader_names_the_tensor(
    tmp_path: Path, change: Callable[[dict[str, torch.Tensor]], object], says: str
) -> None:
    tensors = official_tensors()
    change(tensors)
    save_file(tensors, tmp_path / "x.safetensors")
    with pytest.raises(WeightsError) as error:
        load_dinov2(tmp_path / "x.safetensors")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_unreadable_weights_are_one_line(tmp_path: Path) -> None:
    for name in ("x.safetensors", "x.pth"):
        (tmp_path / name).write_bytes(b"not weights")
        with pytest.raises(WeightsError, match="not a readable weights file") as error:
            load_dinov2(tmp_path / name)
        assert "\n" not in str(error.value)


def test_check_layout_counts_every_kind() -> None:
    with pytest.raises(WeightsError, match=r"2 missing.*1 unexpected.*1 misshapen"):
        check_layout({"a": (2,), "z": (1,)}, {"a": (1,), "b": (1,), "c": (1,)}, "file")


def test_backbone_taps_and_shapes() -> None:
    model = small_backbone()
    with torch.inference_mode():
        out = model(torch.randn(2, 3, 42, 70), (0, 2))
    assert [tuple(g.shape) for g, _ in out] == [(2, 24, 3, 5)] * 2
    assert [tuple(c.shape) for _, c in out] == [(2, 24)] * 2


def test_backbone_refuses_what_does_not_fit() -> None:
    model = small_backbone()
    with pytest.raises(ValueError, match="multiples of 14"):
        model(torch.zeros(1, 3, 40, 70), (0,))
    with pytest.raises(ValueError, match="taps"):
        model(torch.zeros(1, 3, 42, 70), (3,))


def test_tokens_do_not_depend_on_the_batch() -> None:
    model = small_backbone()
    x = torch.randn(3, 3, 42, 56)
    with torch.inference_mode():
        together, alone = model(x, (2,))[0][0][1], model(x[1:2], (2,))[0][0][0]
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)


def test_position_embedding_keeps_its_grid_and_resizes_smoothly() -> None:
    model = small_backbone()
    with torch.no_grad():
        ramp = torch.linspace(0, 1, 5).repeat(5, 1).reshape(25, 1)  # grows to the right
        model.pos_embed[:, 1:] = ramp
    assert model.position_embedding(5, 5) is model.pos_embed
    resized = model.position_embedding(3, 10)
    assert resized.shape == (1, 31, 24)
    grid = resized[0, 1:, 0].reshape(3, 10)
    torch.testing.assert_close(grid[0], grid[2])
    assert bool((grid[0].diff() > -0.02).all())
    assert grid[0, 4] < 0.5 < grid[0, 5]


@settings(max_examples=15, deadline=None)
@given(rows=st.integers(2, 6), columns=st.integers(2, 9))
def test_head_shapes_for_any_aspect(rows: int, columns: int) -> None:
    torch.manual_seed(0)
    head = HeadEnsemble(SMALL).eval()
    tokens, cls = torch.randn(2, 2, 24, rows, columns), torch.randn(2, 2, 24)
    image = torch.randn(2, 3, 14 * rows, 14 * columns)
    with torch.inference_mode():
        log_depth, sigma, _ = head(tokens, cls, image)
    assert log_depth.shape == sigma.shape == (2, 14 * rows, 14 * columns)
    assert bool((sigma > 0).all())


def test_convex_upsampling_stays_between_its_neighbours() -> None:
    torch.manual_seed(0)
    coarse = torch.randn(1, 2, 4, 5)
    fine = convex_upsample(coarse, torch.randn(1, 9 * 49, 4, 5))
    assert fine.shape == (1, 2, 28, 35)
    assert fine.min() >= coarse.min()
    assert fine.max() <= coarse.max()
    # all weight on the middle neighbour (4 of 0..8) is nearest-neighbour upsampling
    logits = torch.full((1, 9, 49, 4, 5), -50.0)
    logits[:, 4] = 50.0
    repeated = coarse.repeat_interleave(7, 2).repeat_interleave(7, 3)
    torch.testing.assert_close(convex_upsample(coarse, logits.reshape(1, 441, 4, 5)), repeated)


def test_depth_is_the_mean_of_the_members_and_sigma_their_geometric_mean() -> None:
    torch.manual_seed(3)
    model = HeadEnsemble(SMALL, sigma_scale=2.0).eval()
    args = torch.randn(1, 2, 24, 3, 4), torch.randn(1, 2, 24), torch.randn(1, 3, 42, 56)
    with torch.inference_mode():
        outs = [member(*args) for member in model.members]
        log_depth, sigma, _ = model(*args)
    torch.testing.assert_close(log_depth, (outs[0][:, 0] + outs[1][:, 0]) / 2)
    # the deviation of a Laplace distribution is the root of 2 times its spread
    spread = (outs[0][:, 1].exp() * outs[1][:, 1].exp()).sqrt()
    torch.testing.assert_close(sigma, 2.0 * 2.0**0.5 * spread)


def test_head_file_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(1)
    model = HeadEnsemble(SMALL, sigma_scale=1.25)
    save_head(tmp_path / "h.safetensors", model, {"trained_on": "nothing"})
    loaded, about = load_head(tmp_path / "h.safetensors")
    assert loaded.shape == SMALL
    assert loaded.sigma_scale == 1.25
    assert about["trained_on"] == "nothing"
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, atol=2e-3, rtol=2e-3)
    first = (tmp_path / "h.safetensors").read_bytes()
    save_head(tmp_path / "h.safetensors", model, {"trained_on": "nothing"})
    assert (tmp_path / "h.safetensors").read_bytes() == first


def test_the_uncertainty_network_is_averaged_with_the_members_and_comes_back_from_the_file(
    tmp_path: Path,
) -> None:
    torch.manual_seed(1)
    model = HeadEnsemble(replace(SMALL, uncertainty_dim=4), sigma_scale=2.0).eval()
    assert model.uncertainty is not None
    torch.nn.init.zeros_(model.uncertainty.out.weight)
    torch.nn.init.constant_(model.uncertainty.out.bias, math.log(0.5) + 2)
    for k, own in enumerate((0.2, 0.05)):
        torch.nn.init.zeros_(model.get_parameter(f"members.{k}.out.weight"))
        model.get_parameter(f"members.{k}.out.bias").data = torch.tensor([0.0, math.log(own)])
    args = torch.randn(1, 2, 24, 3, 4), torch.randn(1, 2, 24), torch.randn(1, 3, 42, 56)
    save_head(tmp_path / "h.safetensors", model, {})
    loaded, _ = load_head(tmp_path / "h.safetensors")
    with torch.inference_mode():
        log_depth, sigma, _ = loaded(*args)
        outs = [member(*args) for member in loaded.members]
    torch.testing.assert_close(log_depth, (outs[0][:, 0] + outs[1][:, 0]) / 2)
    spread = math.sqrt(0.5 * math.sqrt(0.2 * 0.05))
    torch.testing.assert_close(sigma, torch.full_like(sigma, 2.0 * 2.0**0.5 * spread), rtol=2e-3, atol=0)


def scale_and_shape(head: DepthHead, tokens: torch.Tensor, cls: torch.Tensor) -> tuple[float, torch.Tensor]:
    """Mean log depth, and the deviation from it."""
    with torch.inference_mode():
        log_depth = head.coarse(tokens, cls, torch.zeros(1, 3, 42, 56))[0][0, 0]
    return float(log_depth.mean()), log_depth - log_depth.mean()


def test_what_all_tokens_have_in_common_changes_the_scale_and_not_the_shape() -> None:
    torch.manual_seed(4)
    head = DepthHead(replace(SMALL, scale_dim=4)).eval()
    tokens, cls, common = torch.randn(1, 2, 24, 3, 4), torch.randn(1, 2, 24), torch.randn(1, 2, 24, 1, 1)
    scale, shape = scale_and_shape(head, tokens, cls)
    assert scale == pytest.approx(math.log(1.8), abs=1e-5)  # untrained
    assert head.scale_branch is not None
    torch.nn.init.normal_(head.scale_branch.out.weight)
    other_scale, same_shape = scale_and_shape(head, tokens + common, cls)
    assert abs(other_scale - scale) > 0.01
    torch.testing.assert_close(same_shape, shape, atol=1e-5, rtol=1e-4)
    assert scale_and_shape(head, tokens, cls + 1)[0] == scale_and_shape(head, tokens, cls)[0]


def test_scales_of_members_are_averaged_and_come_back_from_the_file(tmp_path: Path) -> None:
    torch.manual_seed(5)
    model = HeadEnsemble(replace(SMALL, scale_dim=4, uncertainty_dim=4))
    for k, depth_m in enumerate((1.0, 4.0)):
        torch.nn.init.constant_(model.get_parameter(f"members.{k}.scale_branch.out.bias"), math.log(depth_m))
    save_head(tmp_path / "h.safetensors", model, {})
    loaded, _ = load_head(tmp_path / "h.safetensors")
    args = torch.randn(1, 2, 24, 3, 4), torch.randn(1, 2, 24), torch.randn(1, 3, 42, 56)
    with torch.inference_mode():
        outs = [member(*args) for member in loaded.members]
        log_depth, _, _ = loaded(*args)
    assert float(log_depth.mean()) == pytest.approx(math.log(2.0), abs=1e-3)
    torch.testing.assert_close(log_depth, (outs[0][:, 0] + outs[1][:, 0]) / 2)


@pytest.mark.parametrize("number", [1, 5, 9])
def test_heads_of_other_formats_are_refused(tmp_path: Path, number: int) -> None:
    tensors = {name: value.half().contiguous() for name, value in HeadEnsemble(SMALL).state_dict().items()}
    shape = json.dumps({"taps": [0, 2], "doubt": 4, "level_dim": 4})
    about = {"format": f"slamdepth-depth-head-{number}", "shape": shape, "sigma_scale": "1.0"}
    save_file(tensors, tmp_path / "other.safetensors", metadata=pack_about(about))
    with pytest.raises(WeightsError, match=rf"other\.safetensors: .* version .*-{number},.* train it again"):
        load_head(tmp_path / "other.safetensors")


def test_head_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "x.safetensors")
    with pytest.raises(WeightsError, match="not a depth head of this package"):
        load_head(tmp_path / "x.safetensors")
    with pytest.raises(WeightsError, match="no such depth head"):
        load_head(tmp_path / "absent.safetensors")
    model = HeadEnsemble(SMALL)
    model.members[0].extra = torch.nn.Linear(2, 2)
    save_head(tmp_path / "y.safetensors", model, {})
    with pytest.raises(WeightsError, match=r"unexpected \(first: members\.0\.extra"):
        load_head(tmp_path / "y.safetensors")


def test_shipped_shape_is_small() -> None:
    parameters = sum(p.numel() for p in DepthHead(HeadShape()).parameters())
    assert parameters < 1_000_000


@given(height=st.integers(100, 2000), width=st.integers(100, 2000))
def test_input_size_is_in_patches_and_keeps_the_area(height: int, width: int) -> None:
    rows, columns = input_size(height, width)
    assert rows % 14 == 0
    assert columns % 14 == 0
    if max(height, width) < 3 * min(height, width):
        assert 0.8 < rows * columns / INPUT_PX < 1.25


def test_usual_sizes() -> None:
    assert input_size(480, 640) == (196, 266)
    assert input_size(640, 480) == (266, 196)
    assert input_size(480, 640, 238 * 322) == (238, 322)


def test_the_focal_length_follows_the_resized_camera() -> None:
    camera = Camera(644, 476, 2 * CANONICAL_FOCAL_PX, 2 * CANONICAL_FOCAL_PX, 321.5, 237.5)
    assert focal_px_at(camera, 238, 322) == pytest.approx(CANONICAL_FOCAL_PX)
    assert focal_px_at(camera, 476, 644) == pytest.approx(2 * CANONICAL_FOCAL_PX)
