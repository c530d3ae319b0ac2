# SPDX-License-Identifier: Apache-2.0
"""Training of low-rank changes of a tiny backbone, from heads that were trained before."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from killed_training import tiny_backbone
from training_places import interrupted_at, make_place

from slamdepth.depth.head import load_head
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.io import sha256_of
from slamdepth.training import adaptation, gravity_direction, loop
from slamdepth.training.config import TrainConfig
from slamdepth.training.plan import plan_training
from slamdepth.training.results import TrainResult

HEAD = {"taps": [0, 1], "dim": 16, "guide_dim": 8, "scale_dim": 4, "gravity": True}


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Settings of a training that adapts the second block, and the heads that it starts from."""
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(gravity_direction, "STEPS", 3)
    data = str(tmp_path / "data")
    for name in ("room", "other", "third"):
        make_place(tmp_path / "data" / name, 2)
        (tmp_path / "data" / name / "gravity.txt").write_text("00000 0.0 1.0 0.0\n00001 0.0 1.0 0.0\n")
    common = {
        "members": 2,
        "coarse_epochs": 1,
        "batch": 4,
        "view": {"rows": 28, "columns": 42, "upright": True},
        "head": HEAD,
    }
    start = {
        **common,
        "output": str(tmp_path / "start.safetensors"),
        "head": {**HEAD, "gravity_dim": 4},
        "sources": [{"folder": data, "places": [{"name": "room", "samples": 16}]}],
    }
    train(start)
    return {
        **common,
        "output": str(tmp_path / "head.safetensors"),
        "fine_epochs": 0,
        "coarse_epochs": 2,
        "adapters": {"start": start["output"], "first": 1, "rank": 2, "runs": 2, "learning_rate": 0.01},
        "sources": [
            {"folder": data, "places": [{"name": "room", "samples": 4}], "supervision": "scale"},
            {"folder": data, "places": [{"name": "third", "samples": 4}], "held_out": ["other"]},
        ],
    }


def train(settings: dict[str, Any]) -> TrainResult:
    return loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())


def test_heads_and_backbone_are_changed_by_a_share(settings: dict[str, Any]) -> None:
    start, _ = load_head(Path(settings["adapters"]["start"]))
    changes = {}
    for share in (0.5, 1.0):
        result = train({**settings, "adapters": {**settings["adapters"], "share": share}})
        head, about = load_head(result.output)
        changes[share] = head
        assert about["adapted_from"] == sha256_of(Path(settings["adapters"]["start"]))
        assert about["trained_on"] == "room, third"
        assert json.loads(about["settings"])["adapters"]["share"] == share
        assert (head.shape.adapted_blocks, head.shape.adapter_rank) == (1, 4)
        assert set(result.held_out) == {"other"}
        assert result.losses.shape == (2, 2)  # two runs of two epochs
        assert result.samples
        assert all(sample.is_held_out for sample in result.samples)
        assert not list(result.output.parent.glob("*.checkpoint"))
    assert changes[1.0].gravity is not None
    assert start.gravity is not None
    for name, value in start.gravity.state_dict().items():
        torch.testing.assert_close(changes[1.0].gravity.state_dict()[name], value)
    for name, value in start.members.state_dict().items():
        half, whole = (changes[share].members.state_dict()[name] - value for share in (0.5, 1.0))
        torch.testing.assert_close(2 * half, whole, rtol=0.05, atol=3e-3)  # of numbers in half precision
    name = "members.0.scale_branch.out.bias"
    assert float((changes[1.0].state_dict()[name] - start.state_dict()[name]).abs()) > 1e-4
    backbones = {share: tiny_backbone() for share in changes}
    for share, head in changes.items():
        assert head.adapters is not None
        head.adapters.merge_into(backbones[share])
    for name, value in tiny_backbone().state_dict().items():
        half, whole = (backbones[share].state_dict()[name] - value for share in (0.5, 1.0))
        torch.testing.assert_close(2 * half, whole, rtol=0.05, atol=1e-4)
        is_adapted = name.startswith("blocks.1.") and name.endswith("weight") and value.ndim == 2
        assert bool(whole.abs().max() > 1e-4) is is_adapted


def test_training_adapters_lowers_the_loss(settings: dict[str, Any]) -> None:
    without = dict.fromkeys(("flip", "rolled", "colour", "blur", "noise", "jpeg", "max_tilt_deg"), 0.0)
    view = {**settings["view"], "augment": {**without, "upright_roll_deg": 0.0, "max_zoom": 1.0}}
    result = train({**settings, "coarse_epochs": 30, "view": view, "head": {**HEAD, "dropout": 0.0}})
    assert result.losses[0, -1] < result.losses[0, 0] - 0.1


def test_a_killed_training_resumes_to_the_same_result(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train(settings)
    expected = whole.output.read_bytes()
    whole.output.unlink()
    # in the second run's second epoch
    calls = interrupted_at(monkeypatch, adaptation, "_run_epoch", 4)
    with pytest.raises(KeyboardInterrupt):
        train(settings)
    assert train(settings).output.read_bytes() == expected
    assert len(calls) == 4 + 1  # no finished epoch is repeated


def test_the_plan_counts_steps_and_views(settings: dict[str, Any]) -> None:
    plan = plan_training(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert plan.steps == 2 * 2 * (8 // 4)  # runs, epochs, batches
    assert plan.training_s is not None
    assert plan.training_s > 0
    assert [source.samples for source in plan.sources] == [4, 4, 2]


def test_heads_to_start_from_must_fit(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"'head': describes other heads than those of 'adapters\.start'"):
        train({**settings, "head": {**HEAD, "dim": 8}})
    start = {**settings["adapters"], "start": "absent.safetensors"}
    with pytest.raises(WeightsError, match=r"absent\.safetensors: no such depth head"):
        train({**settings, "adapters": start})
    adapted = str(train(settings).output)
    again = {**settings, "output": adapted.replace("head.", "again."), "adapters": {**settings["adapters"]}}
    again["adapters"]["start"] = adapted
    with pytest.raises(ConfigError, match="has adapters already"):
        train(again)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fine_epochs": 1}, "needs 'fine_epochs: 0'"),
        ({"uncertainty": "out_of_fold"}, "needs 'uncertainty: own'"),
        ({"adapters": {"start": "x", "first": 2}}, r"no tap of 'head\.taps' reads block 2 or a later one"),
        ({"adapters": {"start": "x", "first": 0}}, "adapters.first"),
    ],
)
def test_settings_that_do_not_go_together_are_named(
    settings: dict[str, Any], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        TrainConfig.from_dict({**settings, **change})


def test_sources_train_all_heads_and_their_depth(settings: dict[str, Any]) -> None:
    for change in ({"supervision": "gravity"}, {"members": [0]}):
        sources = [{**settings["sources"][0], **change}, settings["sources"][1]]
        with pytest.raises(ConfigError, match="not single 'members' or gravity"):
            TrainConfig.from_dict({**settings, "sources": sources})
