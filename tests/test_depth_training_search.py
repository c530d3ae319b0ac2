# SPDX-License-Identifier: Apache-2.0
"""Hyper-parameter search: reproducible, resumable, scored on held-out places only."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from killed_training import tiny_backbone
from training_places import tiny_settings

from slamdepth.errors import ConfigError, OutputError
from slamdepth.pipeline.training import run_search
from slamdepth.training import search
from slamdepth.training.config import TrainConfig
from slamdepth.training.progress import TrainStep

RANGES = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "head.dim": {"choices": [8, 16]},
    "loss.gradient": {"low": 0.0, "high": 1.0},
    "coarse_epochs": {"low": 1, "high": 2},
}


@pytest.fixture
def searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    return {**tiny_settings(tmp_path, monkeypatch), "fine_epochs": 0, "search": RANGES}


def with_optuna() -> None:
    pytest.importorskip("optuna", reason="Optuna is not installed: pip install 'slamdepth[search]'")


def test_a_resumed_search_makes_the_same_trials(searched: dict[str, Any], tmp_path: Path) -> None:
    with_optuna()
    whole = run_search(TrainConfig.from_dict(searched), 4, backbone=tiny_backbone())
    assert len(whole.trials) == 4
    assert whole.best.score == min(trial.score for trial in whole.trials)
    assert len({trial.settings["learning_rate"] for trial in whole.trials}) == 4
    for trial in whole.trials:
        assert 1e-4 <= trial.settings["learning_rate"] <= 1e-2
        assert trial.settings["head.dim"] in (8, 16)
        assert trial.settings["coarse_epochs"] in (1, 2)

    elsewhere = TrainConfig.from_dict({**searched, "output": str(tmp_path / "b" / "head.safetensors")})
    first = run_search(elsewhere, 1, backbone=tiny_backbone())
    die_in_trial(elsewhere)
    again = run_search(elsewhere, 4, backbone=tiny_backbone())
    assert first.trials == again.trials[:1]
    assert again.trials == whole.trials
    assert {path.name for path in (tmp_path / "b").iterdir()} == {
        "head_search", "head_search.sqlite3", "head_best.yaml"
    }  # fmt: skip


def die_in_trial(config: TrainConfig) -> None:
    """A search that is interrupted in its second trial."""

    def interrupt(step: TrainStep) -> None:
        if step.stage.startswith("trial 2 of 4: member"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_search(config, 4, progress=interrupt, backbone=tiny_backbone())


def test_the_best_settings_are_a_ready_config(searched: dict[str, Any]) -> None:
    with_optuna()
    found = run_search(TrainConfig.from_dict(searched), 2, backbone=tiny_backbone())
    best = TrainConfig.from_yaml(found.best_config)
    assert best.learning_rate == found.best.settings["learning_rate"]
    assert best.head.dim == found.best.settings["head.dim"]
    assert best.members == 2
    assert best.output == searched["output"]
    assert best.search == {}
    assert "no longer a test" in found.best_config.read_text()


def test_a_file_that_is_no_study_is_one_error(searched: dict[str, Any]) -> None:
    with_optuna()
    Path(searched["output"]).with_name("head_search.sqlite3").write_bytes(b"not a database" * 100)
    with pytest.raises(OutputError, match=r"head_search\.sqlite3: cannot be used as a study"):
        run_search(TrainConfig.from_dict(searched), 1, backbone=tiny_backbone())


def test_a_diverged_trial_gets_the_worst_score() -> None:
    assert search._score({"a": {search.FIGURE: float("nan")}}) == search._score({"a": {}}) == 1e3
    assert search._score({"a": {search.FIGURE: 0.2}, "b": {search.FIGURE: 0.4}}) == pytest.approx(0.3)


def test_without_optuna_it_says_what_to_install(
    searched: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"needs Optuna: install it with pip install 'slamdepth\[search\]'"):
        run_search(TrainConfig.from_dict(searched), 1, backbone=tiny_backbone())


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        ({}, "names no setting to tune"),
        ({"head.dmi": {"choices": [8]}}, "'head.dmi' cannot be searched; choose from: .*head.dim"),
        ({"members": {"low": 1, "high": 2}}, "'members' cannot be searched"),
        ({"learning_rate": {"low": 1.0}}, "needs low and a higher high, or choices"),
        ({"learning_rate": {"low": 1.0, "high": 0.1}}, "needs low and a higher high"),
        ({"learning_rate": {"low": 0.0, "high": 0.1, "log": True}}, "log needs a low above 0"),
        ({"learning_rate": {"choices": [0.1], "log": True}}, "either choices or low and high"),
        ({"head.dropout": {"low": 0.0, "high": 1.5}}, "setting 'head.dropout'"),
        ({"head.dim": {"choices": [16.5]}}, "setting 'search.head.dim': must be whole numbers"),
    ],
)
def test_bad_ranges_are_named(searched: dict[str, Any], ranges: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        run_search(TrainConfig.from_dict({**searched, "search": ranges}), 1, backbone=tiny_backbone())


def test_a_search_needs_a_held_out_place(searched: dict[str, Any]) -> None:
    source = {**searched["sources"][0], "held_out": []}
    with pytest.raises(ConfigError, match="needs a place under 'held_out' to score by"):
        run_search(TrainConfig.from_dict({**searched, "sources": [source]}), 1, backbone=tiny_backbone())
