# SPDX-License-Identifier: Apache-2.0
"""Heads that learn from different sources, and fine epochs that leave the coarse map alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from killed_training import tiny_backbone
from training_places import make_place

from slamdepth.depth.head import UPSAMPLING, load_head
from slamdepth.errors import ConfigError
from slamdepth.training import loop, member
from slamdepth.training.caches import Encoder, plan_caches
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.training.member import MemberTraining
from slamdepth.training.plan import plan_training
from slamdepth.training.results import TrainResult


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    data = str(tmp_path / "data")
    sources = []
    for name, members in (("hall", [0]), ("loft", [1]), ("yard", None)):
        make_place(tmp_path / "data" / name, 2)
        sources.append({"folder": data, "members": members, "places": [{"name": name, "samples": 4}]})
    return {
        "output": str(tmp_path / "head.safetensors"),
        "members": 2,
        "coarse_epochs": 1,
        "fine_epochs": 1,
        "batch": 4,
        "sources": sources,
        "view": {"rows": 28, "columns": 42},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }


def train(settings: dict[str, Any]) -> TrainResult:
    return loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())


def test_a_member_is_trained_on_its_own_sources_only(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    real = member.run_epoch

    def spy(training: MemberTraining, caches: list[FeatureCache], *rest: Any) -> float:
        seen.append((rest[4], sum(map(len, rest[0]))))  # rest: views, head, optimiser, epoch, member
        return real(training, caches, *rest)

    monkeypatch.setattr(member, "run_epoch", spy)
    train(settings)
    assert seen == [(0, 8), (0, 8), (1, 8), (1, 8)]  # its own place and the common one


def test_a_checkpoint_of_another_head_format_is_not_resumed(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as at_the_end:
        at_the_end.setattr(loop, "save_head", kill)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    epochs: list[int] = []
    real = member.run_epoch

    def listed(*args: Any) -> float:
        epochs.append(args[5])
        return real(*args)

    monkeypatch.setattr(member, "run_epoch", listed)
    monkeypatch.setattr(loop, "FORMAT", "another")
    train(settings)
    assert epochs == [0, 1, 0, 1]  # of both members, from the start


def test_a_member_without_a_place_is_an_error(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="no place to train on for member 1"):
        train({**settings, "sources": settings["sources"][:1]})


def test_a_member_that_does_not_exist_is_an_error(settings: dict[str, Any]) -> None:
    sources = [{**settings["sources"][0], "members": [7]}, *settings["sources"][1:]]
    with pytest.raises(ConfigError, match="names member 7, and there are members 0 to 1"):
        TrainConfig.from_dict({**settings, "sources": sources})


def test_features_that_train_no_member_are_not_computed(settings: dict[str, Any]) -> None:
    config = TrainConfig.from_dict(settings).model_copy(update={"members": 1})  # as a search does
    planned = plan_caches(config, Encoder(tiny_backbone()).key)
    assert [plan.places[0].name for plan in planned] == ["hall", "yard"]


def test_features_of_another_precision_are_other_features(settings: dict[str, Any]) -> None:
    config, backbone = TrainConfig.from_dict(settings), tiny_backbone()
    single = plan_caches(config, Encoder(backbone).key)
    half = plan_caches(config, Encoder(backbone.to(torch.bfloat16)).key)
    assert not {plan.folder for plan in single} & {plan.folder for plan in half}


def test_fine_epochs_train_the_upsampling_alone(settings: dict[str, Any]) -> None:
    coarse, _ = load_head(train({**settings, "fine_epochs": 0}).output)
    fine, _ = load_head(train(settings).output)
    changed = {
        name
        for (name, before), after in zip(coarse.state_dict().items(), fine.state_dict().values(), strict=True)
        if not torch.equal(before, after)
    }
    assert changed
    assert all(name.split(".", 2)[2].startswith(UPSAMPLING) for name in changed)


def test_a_plan_counts_the_steps_of_each_member(settings: dict[str, Any]) -> None:
    config = TrainConfig.from_dict({**settings, "sources": settings["sources"][:2]})
    plan = plan_training(config, backbone=tiny_backbone())
    assert plan.steps == 2 * (1 + 1)  # two epochs; 4 views of its own are one batch of each member
