# SPDX-License-Identifier: Apache-2.0
"""Training of the gravity network, and depth of images that are rotated upright by gravity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from killed_training import tiny_backbone
from training_places import make_place

from slamdepth.depth.gravity_direction import GravityEstimate, token_fields
from slamdepth.depth.head import HeadEnsemble, HeadShape, load_head
from slamdepth.depth.model import Dinov2Depth
from slamdepth.errors import ConfigError
from slamdepth.training import gravity_direction as training_gravity
from slamdepth.training import loop, plan, timing
from slamdepth.training.caches import of_gravity, of_member, plan_caches
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.training.gravity_direction import candidate_directions, learn_gravity
from slamdepth.training.progress import silent
from slamdepth.types import Camera, Frame

SHAPE = HeadShape(taps=(0,), token_dim=8, scale_dim=4, gravity=True, gravity_dim=16)


def views_that_show_gravity(count: int, seed: int) -> FeatureCache:
    """Views whose first token channel encodes the angle below the horizon."""
    rng = np.random.default_rng(seed)
    gravity = rng.normal(size=(count, 3))
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    tokens = rng.normal(0, 0.1, (count, 1, 8, 4, 5))
    x, y = np.meshgrid(np.arange(5) - 2.0, np.arange(4) - 1.5)
    rays = np.stack([x * 14 / 60, y * 14 / 60, np.ones_like(x)])
    rays /= np.linalg.norm(rays, axis=0)
    tokens[:, 0, 0] += 3 * np.einsum("chw,nc->nhw", rays, gravity)
    return FeatureCache(
        tokens=tokens.astype(np.float16),
        class_tokens=np.zeros((count, 1, 8), np.float16),
        image_rgb=np.zeros((count, 56, 70, 3), np.uint8),
        canonical_m=np.ones((count, 56, 70), np.float16),
        focal_factor=np.full(count, 60 / 280, np.float32),
        gravity=gravity.astype(np.float32),
        place=np.zeros(count, np.int64),
    )


def test_candidates_are_gravity_first_then_others() -> None:
    rng = np.random.default_rng(0)
    gravity = np.array([0.6, 0.0, 0.8])
    candidates = candidate_directions(gravity, rng)
    np.testing.assert_allclose(np.linalg.norm(candidates, axis=1), 1.0)
    np.testing.assert_allclose(candidates[0], gravity)
    np.testing.assert_allclose(candidates[2], -gravity)
    np.testing.assert_allclose(candidates[3:7] @ gravity, 0.0, atol=1e-12)
    assert candidates[1] @ gravity > 0.95


def test_the_network_learns_to_recognise_gravity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_gravity, "STEPS", 150)
    scorer = learn_gravity([views_that_show_gravity(64, 0)], SHAPE, 0, "cpu", silent)
    other, rng, right = views_that_show_gravity(30, 1), np.random.default_rng(2), 0
    for k in range(len(other)):
        candidates = candidate_directions(other.gravity[k].astype(float), rng)
        fields = token_fields(torch.from_numpy(candidates).float(), 60.0, 56, 70)
        tokens = torch.from_numpy(other.tokens[k : k + 1]).float()
        with torch.inference_mode():
            best = candidates[int(scorer(tokens, fields[None])[0].argmax())]
        right += bool(best @ other.gravity[k] > np.cos(np.radians(25)))
    assert right >= 24  # 3 of 20 directions are that near, so chance has 4 or 5


def test_views_of_unknown_gravity_are_not_trained_on() -> None:
    cache = views_that_show_gravity(20, 0)
    cache.gravity[5:] = 0.0
    with pytest.raises(ConfigError, match="too few views of known gravity"):
        learn_gravity([cache], SHAPE, 0, "cpu", silent)


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(training_gravity, "STEPS", 3)
    make_place(tmp_path / "data" / "hall", 4)
    (tmp_path / "data" / "hall" / "gravity.txt").write_text(
        "".join(f"{k:05d} 0.6 0.8 0.0\n" for k in range(4))
    )
    source = {"folder": str(tmp_path / "data"), "places": [{"name": "hall", "samples": 8}]}
    turned = {"rolled": 1.0, "max_roll_deg": 180.0}
    return {
        "output": str(tmp_path / "head.safetensors"),
        "coarse_epochs": 1,
        "fine_epochs": 1,
        "members": 1,
        "batch": 4,
        "sources": [
            source,
            {**source, "augment": {"mixed": 1.0}},
            {**source, "augment": turned, "supervision": "gravity"},
        ],
        "view": {"rows": 42, "columns": 56, "upright": True},
        "head": {
            "taps": [0, 1],
            "dim": 16,
            "guide_dim": 8,
            "scale_dim": 4,
            "gravity": True,
            "gravity_dim": 8,
        },
    }


def test_sources_train_depth_or_gravity(settings: dict[str, Any]) -> None:
    planned = plan_caches(TrainConfig.from_dict(settings), "test")
    numbers = list(range(len(planned)))
    assert of_member(planned, numbers, 0) == [0, 1]
    assert of_gravity(planned, numbers) == [0, 2]
    assert [partner.place.name for partner in planned[1].partners] == ["hall", "hall"]


def test_a_source_for_depth_is_required(settings: dict[str, Any]) -> None:
    settings["sources"] = settings["sources"][2:]
    with pytest.raises(ConfigError, match="there is no place to train on for member 0"):
        plan_caches(TrainConfig.from_dict(settings), "test")


def test_gravity_requires_upright_views(settings: dict[str, Any]) -> None:
    settings["view"]["upright"] = False
    with pytest.raises(ConfigError, match=r"setting 'head'.*upright"):
        TrainConfig.from_dict(settings)


def test_a_plan_counts_the_time_it_takes(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "second_time", lambda work: 0.01)
    monkeypatch.setattr(timing, "second_time", lambda work: (work(), 0.25)[1])
    config = TrainConfig.from_dict(settings)
    head = config.head.model_copy(update={"gravity_dim": 0})
    with_it, without = (
        plan.plan_training(one, backbone=tiny_backbone()).training_s
        for one in (config, config.model_copy(update={"head": head}))
    )
    assert with_it is not None
    assert without is not None
    assert with_it - without == pytest.approx(3 * 0.25)


def test_a_trained_head_has_a_trained_gravity_network(settings: dict[str, Any], tmp_path: Path) -> None:
    written = []
    for run in ("a", "b"):
        output = tmp_path / f"{run}.safetensors"
        config = TrainConfig.from_dict({**settings, "output": str(output)})
        loop.train_depth(config, backbone=tiny_backbone())
        head, _ = load_head(output)
        assert head.gravity is not None
        written.append(head.state_dict())
    assert all(torch.equal(value, written[1][name]) for name, value in written[0].items())
    untrained = HeadEnsemble(head.shape)
    assert untrained.gravity is not None
    assert not torch.equal(untrained.gravity.out.weight, written[0]["gravity.out.weight"])


class WithGravity(Dinov2Depth):
    """A model with a given direction of gravity."""

    given: GravityEstimate | None = None

    def _gravity(self, frame: Frame, rotations: Any) -> GravityEstimate | None:
        del frame, rotations
        return self.given


def model() -> WithGravity:
    torch.manual_seed(3)
    shape = HeadShape(
        taps=(0, 1), token_dim=24, dim=16, guide_dim=8, scale_dim=4, gravity=True, input_px=5000
    )
    head = HeadEnsemble(shape)
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return WithGravity(tiny_backbone(), head.eval(), ())


def frame() -> Frame:
    image = np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    return Frame(0, 0.0, image, Camera(128, 96, 100.0, 100.0, 63.5, 47.5))


def test_depth_depends_on_gravity() -> None:
    unknown, level = model(), model()
    level.given = GravityEstimate(np.array([0.0, 1.0, 0.0]), 1.0)
    pitched = model()
    pitched.given = GravityEstimate(np.array([0.0, 0.6, 0.8]), 1.0)
    depths = [each.predict(frame()).values for each in (unknown, level, pitched)]
    assert not np.allclose(depths[0], depths[1])
    assert not np.allclose(depths[1], depths[2])


def test_a_rolled_image_is_predicted_upright() -> None:
    """A rotation by 180 degrees is exact: the prediction is that of the upright image, rotated."""
    upright, rolled = model(), model()
    upright.given = GravityEstimate(np.array([0.0, 0.8, 0.6]), 1.0)
    rolled.given = GravityEstimate(np.array([0.0, -0.8, 0.6]), 1.0)
    as_taken = frame()
    turned = replace(as_taken, image_rgb=np.ascontiguousarray(as_taken.image_rgb[::-1, ::-1]))
    wanted = upright.predict(as_taken)
    got = rolled.predict(turned)
    np.testing.assert_allclose(got.values[::-1, ::-1], wanted.values, rtol=1e-3)
    assert got.sigma_log is not None
    assert wanted.sigma_log is not None
    np.testing.assert_allclose(got.sigma_log[::-1, ::-1], wanted.sigma_log, rtol=1e-2)


def test_a_blank_image_has_no_gravity() -> None:
    torch.manual_seed(3)
    shape = HeadShape(
        taps=(0, 1),
        token_dim=24,
        dim=16,
        guide_dim=8,
        scale_dim=4,
        gravity=True,
        gravity_dim=8,
        input_px=5000,
    )
    blank = replace(frame(), image_rgb=np.full((96, 128, 3), 128, np.uint8))
    blind = Dinov2Depth(tiny_backbone(), HeadEnsemble(shape).eval(), ())
    prediction = blind.predict(blank)
    assert prediction.gravity is None
    assert np.isfinite(prediction.values).all()
