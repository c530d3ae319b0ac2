# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the scale that a predicted image has in common."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from killed_training import tiny_backbone

from slamdepth.depth.head import HeadEnsemble, HeadShape, load_head, save_head
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.scale_uncertainty import ScaleUncertainty, scale_tap
from slamdepth.training.scale_errors import (
    ScaleErrors,
    View,
    fit_scale_uncertainty,
    fit_subspace,
    fit_weights,
    look,
)
from slamdepth.types import Camera, Frame

LOG_FOCAL = math.log(220.0)


def views(seed: int, off: float = 0.0, count: int = 40) -> list[View]:
    """Views whose tokens are in a plane of dimension 2 of 8, and ``off`` away from it."""
    make = torch.Generator().manual_seed(seed)
    tokens = torch.zeros(count, 12, 8)
    tokens[:, :, :2] = torch.randn(count, 12, 2, generator=make)
    tokens[:, :, 5] = 1.0 + off
    return [View(0.1 * (-1) ** k, tokens[k].half(), 0.0, LOG_FOCAL, k // 4) for k in range(count)]


def synthetic(seed: int) -> ScaleErrors:
    """Errors whose deviation triples with each deviation of the distance above its mean."""
    make = torch.Generator().manual_seed(seed)
    distance = 20 + 2 * torch.randn(8000, generator=make, dtype=torch.float64)
    sigma = 0.1 * 3 ** ((distance - 20) / 2).clamp_min(0)
    error = sigma * torch.randn(8000, generator=make, dtype=torch.float64)
    log_spread = torch.randn(8000, generator=make, dtype=torch.float64)
    log_focal = torch.full((8000,), LOG_FOCAL, dtype=torch.float64)
    return ScaleErrors(error, distance, log_spread, log_focal, torch.arange(8000) % 5)


def test_distance_is_that_from_the_subspace_of_the_known_tokens() -> None:
    network = ScaleUncertainty(8, 2)
    fit_subspace(network, views(0))
    assert float(ScaleErrors.of(network, views(1)).distance.max()) < 0.01
    far = ScaleErrors.of(network, views(1, off=3.0)).distance
    torch.testing.assert_close(far, torch.full_like(far, 3.0), rtol=0.01, atol=0)


def test_sigma_holds_68_and_95_percent_of_the_errors_of_other_images() -> None:
    network = ScaleUncertainty(8, 2)
    fit_weights(network, synthetic(0))
    other = synthetic(1)
    sigma = other.sigma(network)
    known = torch.isfinite(sigma)
    ratio = (other.error.abs() / sigma)[known]
    assert float((ratio < 1).double().mean()) == pytest.approx(0.68, abs=0.04)
    assert float((ratio < 2).double().mean()) == pytest.approx(0.95, abs=0.03)
    far, near = other.distance > 22, other.distance < 20
    assert float(sigma[far & known].mean()) > 2.5 * float(sigma[near].mean())


def test_sigma_is_infinite_where_tokens_are_farther_than_unseen_ones() -> None:
    network = ScaleUncertainty(8, 2)
    errors = synthetic(0)
    fit_weights(network, errors)
    distance = torch.tensor([20.0, float(errors.distance.max()) + 1])
    sigma = network(distance, torch.zeros(2), torch.full((2,), LOG_FOCAL))
    assert torch.isfinite(sigma).tolist() == [True, False]


def test_a_focal_length_that_was_never_seen_widens_sigma_by_its_ratio() -> None:
    network = ScaleUncertainty(8, 2)
    fit_weights(network, synthetic(0))
    zero = torch.zeros(1)
    inside, beyond = (
        float(network(zero + 19, zero, torch.tensor([math.log(focal)]))) for focal in (220.0, 440.0)
    )
    assert beyond == pytest.approx(math.hypot(inside, math.log(2.0)), rel=1e-3)


@pytest.mark.parametrize(("taps", "tap"), [(1, 0), (2, 0), (3, 1)])
def test_the_last_block_but_one_is_read(taps: int, tap: int) -> None:
    assert scale_tap(taps) == tap


def test_fitting_the_same_views_gives_the_same_network() -> None:
    first, second = (fit_scale_uncertainty(views(0), views(1))[0].state_dict() for _ in range(2))
    for name, value in first.items():
        assert torch.equal(value, second[name])


def test_images_that_were_trained_on_widen_the_limit_and_leave_sigma_to_the_others() -> None:
    far = [replace(view, tokens=5 * view.tokens, error=9.0) for view in views(2)]
    alone, errors = fit_scale_uncertainty(views(0), views(1))
    wider, of_unseen = fit_scale_uncertainty(views(0), views(1), far)
    assert float(wider.limit) > 1.5 * float(alone.limit)
    assert torch.equal(of_unseen.error, errors.error)


@pytest.fixture
def frame() -> Frame:
    image = np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    depth_m = np.full((96, 128), 2.0, dtype=np.float32)
    return Frame(0, 0.0, image, Camera(128, 96, 100.0, 100.0, 63.5, 47.5), depth_m)


def test_a_head_states_the_uncertainty_that_was_fitted_to_its_errors(tmp_path: Path, frame: Frame) -> None:
    torch.manual_seed(0)
    backbone = tiny_backbone()
    shape = HeadShape((0, 1), 24, dim=16, guide_dim=8, subspace_dim=4)
    head = HeadEnsemble(shape).eval().requires_grad_(False)
    before = Dinov2Depth(backbone, head, ()).predict(frame).values
    (view,) = look(backbone, head, [(7, frame)])
    assert view.place == 7
    assert view.error == pytest.approx(float(np.median(np.log(before / 2.0))), abs=1e-5)
    head.scale = ScaleUncertainty(24, 4)
    fit_subspace(head.scale, [view])
    head.scale.weights.copy_(torch.tensor([math.log(0.25), 0.0, 0.0]))
    head.scale.limit.fill_(100.0)
    head.scale.focal.copy_(torch.tensor([0.0, 10.0]))
    save_head(tmp_path / "head.safetensors", head, {})
    loaded, _ = load_head(tmp_path / "head.safetensors")
    prediction = Dinov2Depth(backbone, loaded, ()).predict(frame)
    assert prediction.scale_sigma_log == pytest.approx(0.25, abs=1e-3)
    np.testing.assert_allclose(prediction.values, before, rtol=1e-2)
    assert loaded.scale is not None
    loaded.scale.limit.fill_(-1.0)
    assert Dinov2Depth(backbone, loaded, ()).predict(frame).scale_sigma_log == math.inf


def test_a_head_without_it_states_nothing(frame: Frame) -> None:
    torch.manual_seed(0)
    head = HeadEnsemble(HeadShape((0, 1), 24, dim=16, guide_dim=8)).eval().requires_grad_(False)
    assert Dinov2Depth(tiny_backbone(), head, ()).predict(frame).scale_sigma_log is None


def test_images_with_too_little_depth_are_left_out(frame: Frame) -> None:
    torch.manual_seed(0)
    head = HeadEnsemble(HeadShape((0, 1), 24, dim=16, guide_dim=8)).eval().requires_grad_(False)
    assert look(tiny_backbone(), head, [(0, Frame(0, 0.0, frame.image_rgb, frame.camera))]) == []
