# SPDX-License-Identifier: Apache-2.0
"""Heads and losses compared on places left out, with a tiny backbone."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from killed_training import tiny_backbone
from training_places import make_place

from benchmarks.depth_trial_heads import DptLikeHead, LinearHead, mse_ssim, normals_too
from benchmarks.depth_trials import (
    FIGURES,
    TRIALS,
    Trial,
    groups_of,
    judge_head,
    main,
    mean_over_places,
    table,
    trial_config,
    try_out,
)
from slamdepth.depth.head import DepthHead, HeadShape
from slamdepth.training.caches import Encoder, fill_cache, plan_caches
from slamdepth.training.config import LossConfig, TrainConfig
from slamdepth.training.losses import total_loss

NAMES = ("a", "b", "c", "d")


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    for name in NAMES:
        make_place(tmp_path / "real" / name, 3)
    make_place(tmp_path / "rooms" / "r", 3)
    return TrainConfig.from_dict({
        "output": "head.safetensors",
        "sources": [
            {"folder": str(tmp_path / "real"), "places": [{"name": name, "samples": 9} for name in NAMES]},
            {"folder": str(tmp_path / "rooms"), "places": [{"name": "r", "samples": 9}]},
            {"folder": str(tmp_path / "real"), "augment": {"mixed": 1.0}, "places": [{"name": "a"}]},
        ],
        "batch": 4,
        "view": {"rows": 56, "columns": 70},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    })  # fmt: skip


def trained_and_held_out(config: TrainConfig) -> tuple[list[str], list[str]]:
    trained = [place.name for source in config.sources for place in source.places]
    return trained, [name for source in config.sources for name in source.held_out]


def test_a_head_learns_from_no_place_it_is_judged_on(base: TrainConfig) -> None:
    assert groups_of(base) == [("a", "d"), ("b",), ("c",)]
    config = trial_config(base, TRIALS["308 x 420 pixels"], ("a", "d"), samples=5)
    assert trained_and_held_out(config) == (["b", "c", "r"], ["a", "d"])
    assert {place.samples for source in config.sources for place in source.places} == {5}
    assert (config.view.rows, config.view.columns, config.batch) == (308, 420, 4)
    real = trial_config(base, TRIALS["real places only"], ("b",), samples=5)
    assert trained_and_held_out(real) == (["a", "c", "d"], ["b"])


def test_every_place_gets_its_figures_and_a_seed_decides_them(base: TrainConfig) -> None:
    encoder = Encoder(tiny_backbone())
    found = [try_out(base, Trial(), encoder, samples=4, steps=2, seed=seed) for seed in (0, 0, 1)]
    assert set(found[0]) == set(NAMES)
    assert found[0] == found[1]
    assert found[0] != found[2]
    lines = table({"one": found[:1], "two": [found[2]]}).splitlines()
    assert lines[2].startswith("| one | 1 | ")
    assert lines[2].endswith(" +0.0 |")
    more = 100 * (mean_over_places(found[2])[2] - mean_over_places(found[0])[2])
    assert lines[3].endswith(f" {more:+.1f} |")


class _Exact(torch.nn.Module):
    """Predicts the depth of :func:`make_place` from brightness, times a factor."""

    def coarse(self, *args: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        image = args[2]
        grey = (image[:, 0] * 0.229 + 0.485) * 255
        focal_factor = 60.0 * max(56 / 48, 70 / 64) / 280.0
        depth_m = (0.5 + 0.01 * grey) / focal_factor * 1.5
        log_depth = torch.nn.functional.avg_pool2d(depth_m[:, None], 7).log()
        return torch.cat([log_depth, log_depth], dim=1), log_depth


def test_the_figures_of_a_head_that_is_off_by_a_factor(base: TrainConfig) -> None:
    encoder = Encoder(tiny_backbone())
    config = trial_config(base, Trial(), ("a",), samples=4)
    planned = next(plan for plan in plan_caches(config, encoder.key) if plan.held_out == "a")
    figures = judge_head(_Exact(), fill_cache(planned, config, encoder.backbone))
    assert tuple(figures) == FIGURES
    assert figures["abs_rel"] == pytest.approx(0.5, abs=0.03)
    assert figures["scale_off"] == pytest.approx(math.log(1.5), abs=0.02)
    assert figures["one_median"] < 0.04
    assert figures["frame_median"] < 0.04
    assert figures["delta1_frame_median"] == 1.0
    assert figures["scale_spread"] < 0.02


@pytest.mark.parametrize("build", [LinearHead, DptLikeHead])
def test_other_heads_learn_to_tell_depth_from_tokens(build: type[torch.nn.Module]) -> None:
    torch.manual_seed(0)
    head = build(HeadShape((0, 1, 2), 8), 0.0)
    tokens, cls = torch.randn(4, 3, 8, 3, 5), torch.randn(4, 3, 8)
    target = (tokens[:, 2, 0].repeat_interleave(2, 1).repeat_interleave(2, 2) / 3).exp()
    first = DepthHead(HeadShape((0, 1, 2), 8)).coarse(tokens, cls, torch.zeros(4, 3, 42, 70))[0]
    optimiser = torch.optim.Adam(head.parameters(), 1e-2)
    losses = []
    for _ in range(60):
        prediction = head.coarse(tokens, cls, torch.zeros(4, 3, 42, 70))[0]
        assert prediction.shape == first.shape == (4, 2, 6, 10)
        loss = total_loss(prediction, target, LossConfig())
        losses.append(float(loss.detach()))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert losses[-1] < losses[0] - 0.3


def test_normals_of_the_true_map_cost_nothing_and_of_a_tilted_one_something() -> None:
    columns = (torch.arange(10) - 4.5) / 40.0
    plane = (2.0 / (1.0 + 0.5 * columns)).expand(1, 6, 10)  # z of the plane z + x / 2 = 2
    sigma = torch.zeros_like(plane)
    exact, flat = (torch.stack([z.log(), sigma], dim=1) for z in (plane, torch.full_like(plane, 2.0)))
    assert float(normals_too(exact, plane)) == pytest.approx(
        float(total_loss(exact, plane, LossConfig())), abs=1e-6
    )
    more = float(normals_too(flat, plane) - total_loss(flat, plane, LossConfig()))
    assert more == pytest.approx(1 - 1 / math.hypot(1, 0.5), rel=1e-3)
    assert float(mse_ssim(exact, plane)) == pytest.approx(0.0, abs=1e-9)
    assert float(mse_ssim(flat, plane)) > 0


def test_from_the_command_line_and_again(
    base: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text(json.dumps(base.model_dump(mode="json", exclude_none=True)))
    monkeypatch.setattr("benchmarks.depth_trials.open_encoder", lambda file: Encoder(tiny_backbone()))
    arguments = ["--config", str(settings), "--output", str(tmp_path / "out"), "--seeds", "2", "--steps", "1"]
    arguments += ["--samples", "3", "--trials", "as shipped", "real places only"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert [line.split(" | ")[0] for line in said.splitlines()[2:]] == ["| as shipped", "| real places only"]
    monkeypatch.setattr("benchmarks.depth_trials.try_out", lambda *args, **more: pytest.fail("made again"))
    assert main(arguments) == 0
    assert capsys.readouterr().out == said
    assert main(["--config", str(tmp_path / "absent.yaml")]) != 0
    assert "absent.yaml" in capsys.readouterr().err
