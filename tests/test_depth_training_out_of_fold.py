# SPDX-License-Identifier: Apache-2.0
"""Uncertainty fitted to errors in places that the predicting head was not trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from killed_training import tiny_backbone
from training_places import make_place

from slamdepth.depth.head import load_head
from slamdepth.depth.uncertainty import FEATURES, UncertaintyNet, features, mean_log_spread
from slamdepth.errors import ConfigError
from slamdepth.training import loop, member, out_of_fold, timing
from slamdepth.training.caches import Encoder, plan_caches
from slamdepth.training.config import AugmentConfig, TrainConfig
from slamdepth.training.out_of_fold import (
    Errors,
    fit_uncertainty,
    network_inputs,
    plan_folds,
    sigma_scale,
    spread_of,
    surest_half,
)
from slamdepth.training.plan import plan_training
from slamdepth.training.progress import TrainStep


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(out_of_fold, "_STEPS", 15)
    data = str(tmp_path / "data")
    sources = []
    for count, name in enumerate(("hall", "loft"), start=2):
        make_place(tmp_path / "data" / name, count)
        sources.append({"folder": data, "places": [{"name": name, "samples": 4}]})
    mixed = {**sources[0], "augment": {"mixed": 1.0}}
    return {
        "output": str(tmp_path / "head.safetensors"),
        "uncertainty": "out_of_fold",
        "coarse_epochs": 2,
        "fine_epochs": 1,
        "batch": 4,
        "sources": [*sources, mixed],
        "view": {"rows": 42, "columns": 56},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }


def synthetic_errors(seed: int = 0, places: int = 3) -> Errors:
    """Errors six times as large where the first channel of the tokens is 1 as where it is -1."""
    torch.manual_seed(seed)
    count = 6000
    side = torch.where(torch.rand(count) < 0.5, -1.0, 1.0)
    tokens = torch.cat([side[:, None], 0.05 * torch.randn(count, 7)], dim=1)
    size = 0.1 * 6 ** ((side + 1) / 2)
    error = size * torch.distributions.Laplace(0.0, 1.0).sample((count,)).abs()
    view = torch.arange(count) // 100
    means = torch.stack([error[view == k].mean() for k in range(count // 100)])[view]
    own = torch.randn(count)
    return Errors(tokens.half(), torch.randn(count, FEATURES), error, error / means, own, view % places, view)


def test_the_fit_predicts_where_errors_are_large_and_how_large() -> None:
    network = fit_uncertainty(synthetic_errors(), seed=0)
    other = synthetic_errors(seed=1)
    judged = network.log_spread(network_inputs(network, other))
    assert surest_half(judged, other) < 0.4  # of 1 and 6 in equal parts: 1 / 3.5 = 0.29
    assert surest_half(other.own, other) == pytest.approx(1, abs=0.1)
    torch.testing.assert_close(spread_of(network, other), (other.own + judged) / 2)
    spread, is_large = judged.exp(), other.tokens[:, 0] > 0
    assert spread[is_large].median() / spread[~is_large].median() == pytest.approx(6, rel=0.25)
    assert spread[~is_large].median() == pytest.approx(0.1, rel=0.2)
    # 68 % of a Laplace distribution lie within 1.15 of its spread, 0.81 of its deviation
    assert sigma_scale(network, replace(other, own=judged)) == pytest.approx(0.81, rel=0.1)


def test_a_map_is_evaluated_like_its_pixels() -> None:
    torch.manual_seed(0)
    network = fit_uncertainty(synthetic_errors(), seed=0)
    tokens, log_depth = torch.randn(2, 8, 3, 4), torch.randn(2, 6, 8)
    own, sine = torch.randn(2, 2, 6, 8).unbind()
    whole = network(tokens, log_depth, own, sine)
    assert whole.shape == (2, 6, 8)
    seen = network.basis @ (tokens[1, :, 2, 1] - network.centre)
    one = torch.cat([seen, network.standardised(features(log_depth, own, sine))[1, 5, 2]])
    torch.testing.assert_close(whole[1, 5, 2], mean_log_spread(own[1, 5, 2], network.log_spread(one)))


def test_features_do_not_depend_on_the_scale_of_a_frame() -> None:
    log_depth, own, sine = torch.randn(3, 1, 6, 9).unbind()
    read = features(log_depth, own, sine)
    torch.testing.assert_close(features(log_depth + 0.7, own + 0.3, sine), read, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(read[..., 12], sine)
    ramp = torch.linspace(-1, 1, 9)[None, None].expand(1, 6, 9)
    read = features(ramp, ramp, sine)
    torch.testing.assert_close(read[0, 0, :, 0], ramp[0, 0])
    torch.testing.assert_close(read[..., 4], torch.full((1, 6, 9), 0.25))  # across
    torch.testing.assert_close(read[..., 3], torch.zeros(1, 6, 9))  # down
    torch.testing.assert_close(read[0, :, 2:-2, 11], ramp[0, :, 2:-2])  # a ramp is smooth


def test_folds_share_no_place_and_leave_out_no_mixed_view(settings: dict[str, Any]) -> None:
    planned = plan_caches(TrainConfig.from_dict(settings), Encoder(tiny_backbone()).key)
    everything: list[int] = [0, 1, 2, 3]
    nothing: list[int] = []
    found = [
        ([views.tolist() for views in fold.training], [views.tolist() for views in fold.left_out])
        for fold in plan_folds(planned)
    ]
    # hall, loft, and hall again with mixed views, which are trained on if hall is not left out
    assert found == [
        ([nothing, everything, nothing], [everything, nothing, nothing]),
        ([everything, nothing, everything], [nothing, everything, nothing]),
    ]
    of_gravity = replace(planned[1], supervision="gravity")
    mixed = replace(planned[1], view=planned[1].view.model_copy(update={"augment": AugmentConfig(mixed=0.1)}))
    for other in (of_gravity, mixed):
        with pytest.raises(ConfigError, match="two places whose views are not mixed"):
            plan_folds([planned[0], other])


def test_places_are_left_out_a_third_at_a_time(settings: dict[str, Any], tmp_path: Path) -> None:
    names = ("hall", "loft", "attic", "cellar")
    for count, name in enumerate(names[2:], start=4):
        make_place(tmp_path / "data" / name, count)
    source = {**settings["sources"][0], "places": [{"name": name, "samples": 2} for name in names]}
    planned = plan_caches(TrainConfig.from_dict({**settings, "sources": [source]}), "test")
    folds = plan_folds(planned)
    assert [{names[planned[0].keys[k].place] for k in fold.left_out[0]} for fold in folds] == [
        {"hall", "cellar"}, {"loft"}, {"attic"}
    ]  # fmt: skip
    for fold in folds:
        assert sorted([*fold.training[0], *fold.left_out[0]]) == list(range(8))


def test_too_few_places_are_an_error_before_any_work(settings: dict[str, Any], tmp_path: Path) -> None:
    config = TrainConfig.from_dict({**settings, "sources": settings["sources"][:1]})
    with pytest.raises(ConfigError, match="'uncertainty'"):
        loop.train_depth(config, backbone=tiny_backbone())
    assert not (tmp_path / "cache").exists()


def test_a_head_with_fitted_uncertainty_is_trained_evaluated_and_planned(settings: dict[str, Any]) -> None:
    config = TrainConfig.from_dict(settings)
    plan = plan_training(config, backbone=tiny_backbone())
    assert plan.steps == 3 * 3 + 2 * (1 + 2)  # 12 views; one fold has the 4 of loft, one the 8 of hall
    result = loop.train_depth(config, backbone=tiny_backbone())
    head, _ = load_head(result.output)
    assert isinstance(head.uncertainty, UncertaintyNet)
    assert head.sigma_scale == result.sigma_scale > 0
    assert set(result.unseen_surest_half) == {"hall", "loft"}
    assert set(result.unseen_surest_half["loft"]) == {"out_of_fold", "own", "depth_contrast"}
    own = loop.train_depth(config.model_copy(update={"uncertainty": "own"}), backbone=tiny_backbone())
    without, _ = load_head(own.output)
    depth, sigma = (a - b for a, b in zip(outputs(head), outputs(without), strict=True))
    assert float(depth.abs().max()) == 0  # depth is the members'
    assert float(sigma.abs().max()) > 0


def test_a_plan_counts_the_time_of_every_fit(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = plan_caches(TrainConfig.from_dict(settings), "test")
    steps: list[int | None] = []
    real = out_of_fold.fit_uncertainty

    def fit(errors: Errors, seed: int, **more: Any) -> UncertaintyNet:
        steps.append(more.get("steps"))
        return real(errors, seed, **more)

    monkeypatch.setattr(timing, "fit_uncertainty", fit)
    seconds = iter((0.5, 2.0))
    monkeypatch.setattr(timing, "second_time", lambda work: (work(), next(seconds))[1])
    views = 4 + 4  # of hall and of loft, each left out once; mixed views are not left out
    setup_s = 0.5 * views * out_of_fold.PIXELS / timing._SYNTHETIC_PIXELS
    assert timing.uncertainty_s(planned, plan_folds(planned), 24) == pytest.approx(3 * (setup_s + 1.5))
    assert steps == [0, None]


def outputs(head: Any) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    with torch.inference_mode():
        inputs = torch.randn(1, 2, 24, 3, 4), torch.randn(1, 2, 24), torch.randn(1, 3, 42, 56)
        log_depth, sigma, _ = head(*inputs)
    return log_depth, sigma


@pytest.mark.parametrize(
    "stage", ["member 1 of 1", "without places, 2", "uncertainty", "uncertainty without"]
)
def test_an_interrupted_fit_resumes_to_the_same_bytes(
    settings: dict[str, Any], stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig.from_dict(settings)
    whole = loop.train_depth(config, backbone=tiny_backbone()).output.read_bytes()

    def interrupt(step: TrainStep) -> None:
        if step.stage.startswith(stage):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop.train_depth(config, progress=interrupt, backbone=tiny_backbone())
    epochs: list[int] = []
    real = member.run_epoch

    def listed(*args: Any) -> float:
        epochs.append(args[6])
        return real(*args)

    monkeypatch.setattr(member, "run_epoch", listed)
    again = loop.train_depth(config, backbone=tiny_backbone())
    assert again.output.read_bytes() == whole
    assert epochs == {"member 1 of 1": [0, 0, 0, 1, 1, 2, 2], "without places, 2": [2, 2]}.get(stage, [])
    assert not list(again.output.parent.glob("*.checkpoint"))
