# SPDX-License-Identifier: Apache-2.0
"""The dissertation's training: the loss against a direct computation, and convergence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from training_places import make_place

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.evaluation.depth_maps import depth_ssim
from slamdepth.training.data import open_place
from slamdepth.training.mlp import (
    MlpPairs,
    MlpSettings,
    cached_tokens,
    mse_loss,
    mse_ssim_loss,
    shrink,
    train_mlp,
)
from slamdepth.training.progress import TrainStep


def test_the_loss_is_mse_times_exp_of_one_less_ssim() -> None:
    rng = np.random.default_rng(0)
    predicted, target = rng.uniform(1, 3, (2, 2, 32, 32)).astype(np.float32)
    target[rng.random(target.shape) < 0.3] = 0.0
    by_hand, squared = [], []
    for p, t in zip(predicted, target, strict=True):
        known = t > 0
        mse = np.mean((p[known] - t[known]) ** 2)
        squared.append(mse)
        by_hand.append(mse * math.exp(1 - depth_ssim(p, t, known)))
    loss = mse_ssim_loss(torch.from_numpy(predicted), torch.from_numpy(target))
    assert float(loss) == pytest.approx(np.mean(by_hand), rel=1e-4)
    alone = mse_loss(torch.from_numpy(predicted), torch.from_numpy(target))
    assert float(alone) == pytest.approx(np.mean(squared), rel=1e-5)
    assert float(mse_ssim_loss(torch.from_numpy(target), torch.from_numpy(target))) == 0.0


def test_unknown_pixels_have_no_gradient() -> None:
    target = torch.zeros(2, 32, 32)
    target[0, :16] = 2.0  # the second image is unknown altogether
    predicted = torch.full((2, 32, 32), 3.0, requires_grad=True)
    loss = mse_ssim_loss(predicted, target)
    torch.autograd.backward(loss)
    assert predicted.grad is not None
    assert torch.isfinite(loss)
    assert (predicted.grad[0, :16] != 0).all()
    assert (predicted.grad[0, 16:] == 0).all()
    assert (predicted.grad[1] == 0).all()


def test_depth_shrinks_over_known_pixels() -> None:
    depth = torch.zeros(1, 224, 224)
    depth[0, :7, :7] = 3.0
    depth[0, 0, 7:14] = 2.0
    small = shrink(depth, 32)
    assert small.shape == (1, 32, 32)
    assert small[0, 0, :3].tolist() == pytest.approx([3.0, 2.0, 0.0])
    assert shrink(depth, 224) is depth


def test_training_converges_and_is_reproducible() -> None:
    rng = np.random.default_rng(0)
    features = rng.uniform(0, 1, (64, 8)).astype(np.float16)
    depth = np.zeros((64, 224, 224), np.float32)
    depth[:] = (1.0 + 2.0 * features[:, :1, None]).astype(np.float32)
    settings = MlpSettings(epochs=40, batch=16, hidden=32, learning_rate=2e-2)
    head, losses = train_mlp(features, depth, settings)
    assert losses[-1] < 0.05 * losses[0]
    with torch.inference_mode():
        predicted = head(torch.from_numpy(features).float())[:, 16, 16].numpy()
    assert np.abs(predicted - depth[:, 0, 0]).mean() < 0.2
    assert np.corrcoef(predicted, depth[:, 0, 0])[0, 1] > 0.95
    assert train_mlp(features, depth, replace(settings, epochs=5))[1] == losses[:5]
    rounded = train_mlp(features, depth, replace(settings, epochs=5, bfloat16=True))[1]
    assert rounded == pytest.approx(losses[:5], rel=0.05)
    assert torch.get_float32_matmul_precision() == "highest"


def test_without_ssim_the_loss_is_the_squared_error() -> None:
    features = np.linspace(0, 1, 8, dtype=np.float32).reshape(8, 1)
    depth = np.full((8, 224, 224), 2.0, np.float32)
    settings = MlpSettings(epochs=1, batch=8, hidden=4, ssim=False)
    _, (loss,) = train_mlp(features, depth, settings)
    _, (with_ssim,) = train_mlp(features, depth, replace(settings, ssim=True))
    assert 0 < loss < with_ssim


def test_depth_is_normalised_to_one_focal_length() -> None:
    pairs = MlpPairs(
        np.zeros((2, 224, 224, 3), np.uint8), np.ones((2, 224, 224), np.float32), np.array([100.0, 200.0])
    )
    assert pairs.depth_at(200.0)[:, 0, 0].tolist() == [2.0, 1.0]


def test_tokens_are_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    place = open_place(make_place(tmp_path / "room"))
    torch.manual_seed(0)
    backbone = DinoV2(dim=6, depth=1, heads=3, grid=5).eval()
    steps: list[TrainStep] = []
    tokens = cached_tokens(place, backbone, "sha", progress=steps.append)
    assert tokens.shape == (len(place), 257 * 6)
    assert steps[-1] == TrainStep("tokens of room", len(place), len(place))
    again = cached_tokens(place, backbone, "sha", progress=lambda step: pytest.fail("computed again"))
    np.testing.assert_array_equal(again, tokens)
    assert len(list((store.cache_dir() / "features").iterdir())) == 1
