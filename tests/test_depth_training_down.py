# SPDX-License-Identifier: Apache-2.0
"""Learning which way is down, and depth of images that are turned upright by it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from killed_training import tiny_backbone
from training_places import make_place

from slamdepth.depth.gravity_direction import GravityEstimate
from slamdepth.depth.head import HeadEnsemble, HeadShape, load_head
from slamdepth.depth.model import Dinov2Depth
from slamdepth.errors import ConfigError
from slamdepth.training import gravity_direction as training_down
from slamdepth.training import loop, plan, timing
from slamdepth.training.caches import of_gravity, of_member, plan_caches
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.training.gravity_direction import learn_down, offered_directions
from slamdepth.training.progress import silent
from slamdepth.types import Camera, Frame

SHAPE = HeadShape(taps=(0,), token_dim=8, scale_dim=4, gravity=True, gravity_dim=16)


def seen_from_below_the_horizon(count: int, seed: int) -> FeatureCache:
    """Views whose tokens say, in their first channel, how far below the horizon they look."""
    rng = np.random.default_rng(seed)
    down = rng.normal(size=(count, 3))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    tokens = rng.normal(0, 0.1, (count, 1, 8, 4, 5))
    x, y = np.meshgrid(np.arange(5) - 2.0, np.arange(4) - 1.5)
    rays = np.stack([x * 14 / 60, y * 14 / 60, np.ones_like(x)])
    rays /= np.linalg.norm(rays, axis=0)
    tokens[:, 0, 0] += 3 * np.einsum("chw,nc->nhw", rays, down)
    return FeatureCache(
        tokens=tokens.astype(np.float16),
        class_tokens=np.zeros((count, 1, 8), np.float16),
        image_rgb=np.zeros((count, 56, 70, 3), np.uint8),
        canonical_m=np.ones((count, 56, 70), np.float16),
        focal_factor=np.full(count, 60 / 280, np.float32),
        down=down.astype(np.float32),
        place=np.zeros(count, np.int64),
    )


def test_directions_offered_are_gravity_first_and_others() -> None:
    rng = np.random.default_rng(0)
    down = np.array([0.6, 0.0, 0.8])
    offered = offered_directions(down, rng)
    np.testing.assert_allclose(np.linalg.norm(offered, axis=1), 1.0)
    np.testing.assert_allclose(offered[0], down)
    np.testing.assert_allclose(offered[2], -down)
    np.testing.assert_allclose(offered[3:7] @ down, 0.0, atol=1e-12)
    assert offered[1] @ down > 0.95


def test_it_learns_what_goes_with_being_below(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_down, "STEPS", 150)
    scorer = learn_down([seen_from_below_the_horizon(64, 0)], SHAPE, 0, "cpu", silent)
    other, rng, right = seen_from_below_the_horizon(30, 1), np.random.default_rng(2), 0
    for k in range(len(other)):
        offered = offered_directions(other.down[k].astype(float), rng)
        fields = training_down.token_fields(torch.from_numpy(offered).float(), 60.0, 56, 70)
        tokens = torch.from_numpy(other.tokens[k : k + 1]).float()
        with torch.inference_mode():
            best = offered[int(scorer(tokens, fields[None])[0].argmax())]
        right += bool(best @ other.down[k] > np.cos(np.radians(25)))
    assert right >= 24  # 3 of 20 directions are that near, so chance has 4 or 5


def test_views_of_unknown_gravity_teach_nothing() -> None:
    cache = seen_from_below_the_horizon(20, 0)
    cache.down[5:] = 0.0
    with pytest.raises(ConfigError, match="gravity is known of too few views"):
        learn_down([cache], SHAPE, 0, "cpu", silent)


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(training_down, "STEPS", 3)
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
            source, {**source, "augment": {"mixed": 1.0}}, {**source, "augment": turned, "teaches": "down"}
        ],
        "view": {"rows": 42, "columns": 56, "upright": True},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8, "level_dim": 4, "gravity": True, "down_dim": 8},
    }  # fmt: skip


def test_what_learns_from_what(settings: dict[str, Any]) -> None:
    planned = plan_caches(TrainConfig.from_dict(settings), "test")
    numbers = list(range(len(planned)))
    assert of_member(planned, numbers, 0) == [0, 1]
    assert of_gravity(planned, numbers) == [0, 2]
    assert [partner.place.name for partner in planned[1].partners] == ["hall", "hall"]


def test_somebody_has_to_teach_depth(settings: dict[str, Any]) -> None:
    settings["sources"] = settings["sources"][2:]
    with pytest.raises(ConfigError, match="there is no place to train on for member 0"):
        plan_caches(TrainConfig.from_dict(settings), "test")


def test_gravity_has_to_be_found_out(settings: dict[str, Any]) -> None:
    settings["view"]["upright"] = False
    with pytest.raises(ConfigError, match=r"setting 'head'.*upright"):
        TrainConfig.from_dict(settings)


def test_a_plan_counts_the_time_it_takes(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "second_time", lambda work: 0.01)
    monkeypatch.setattr(timing, "second_time", lambda work: (work(), 0.25)[1])
    config = TrainConfig.from_dict(settings)
    head = config.head.model_copy(update={"down_dim": 0})
    with_it, without = (
        plan.plan_training(one, backbone=tiny_backbone()).training_s
        for one in (config, config.model_copy(update={"head": head}))
    )
    assert with_it is not None
    assert without is not None
    assert with_it - without == pytest.approx(3 * 0.25)


def test_a_trained_head_knows_which_way_is_down(settings: dict[str, Any], tmp_path: Path) -> None:
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


class Told(Dinov2Depth):
    """A model that is told where down is."""

    told: GravityEstimate | None = None

    def _gravity(self, frame: Frame, rotations: Any) -> GravityEstimate | None:
        del frame, rotations
        return self.told


def model() -> Told:
    torch.manual_seed(3)
    shape = HeadShape(
        taps=(0, 1), token_dim=24, dim=16, guide_dim=8, scale_dim=4, gravity=True, input_px=5000
    )
    head = HeadEnsemble(shape)
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return Told(tiny_backbone(), head.eval(), ())


def frame() -> Frame:
    image = np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    return Frame(0, 0.0, image, Camera(128, 96, 100.0, 100.0, 63.5, 47.5))


def test_depth_depends_on_where_down_is() -> None:
    unknown, level = model(), model()
    level.told = GravityEstimate(np.array([0.0, 1.0, 0.0]), 1.0)
    pitched = model()
    pitched.told = GravityEstimate(np.array([0.0, 0.6, 0.8]), 1.0)
    depths = [each.predict(frame()).values for each in (unknown, level, pitched)]
    assert not np.allclose(depths[0], depths[1])
    assert not np.allclose(depths[1], depths[2])


def test_a_rolled_image_is_predicted_upright() -> None:
    """Half a turn is exact: what is predicted is that of the image turned back, the other way round."""
    upright, rolled = model(), model()
    upright.told = GravityEstimate(np.array([0.0, 0.8, 0.6]), 1.0)
    rolled.told = GravityEstimate(np.array([0.0, -0.8, 0.6]), 1.0)
    as_taken = frame()
    turned = replace(as_taken, image_rgb=np.ascontiguousarray(as_taken.image_rgb[::-1, ::-1]))
    wanted = upright.predict(as_taken)
    got = rolled.predict(turned)
    np.testing.assert_allclose(got.values[::-1, ::-1], wanted.values, rtol=1e-3)
    assert got.sigma_log is not None
    assert wanted.sigma_log is not None
    np.testing.assert_allclose(got.sigma_log[::-1, ::-1], wanted.sigma_log, rtol=1e-2)


def test_a_blank_image_tells_no_direction() -> None:
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
    told = Dinov2Depth(tiny_backbone(), HeadEnsemble(shape).eval(), ())
    prediction = told.predict(blank)
    assert prediction.gravity is None
    assert np.isfinite(prediction.values).all()
