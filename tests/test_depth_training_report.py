# SPDX-License-Identifier: Apache-2.0
"""What a training leaves beside the head, what --dry-run tells, and the search."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from command_line import call
from killed_training import tiny_backbone
from training_places import make_place

from slamdepth.depth import weights
from slamdepth.depth.training import loop, search
from slamdepth.depth.training.config import TrainConfig
from slamdepth.depth.training.progress import TrainStep
from slamdepth.errors import ConfigError, OutputError
from slamdepth.pipeline.training import plan_run, report_folder, run_search, run_training


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    make_place(tmp_path / "data" / "room")
    make_place(tmp_path / "data" / "other", 2)
    return {
        "output": str(tmp_path / "head.safetensors"),
        "members": 2,
        "coarse_epochs": 2,
        "fine_epochs": 1,
        "batch": 4,
        "sources": [
            {
                "folder": str(tmp_path / "data"),
                "places": [{"name": "room", "samples": 8}],
                "held_out": ["other"],
            },
        ],
        "view": {"rows": 28, "columns": 42},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }


def test_a_training_explains_itself(settings: dict[str, Any]) -> None:
    steps: list[TrainStep] = []
    result = run_training(TrainConfig.from_dict(settings), progress=steps.append, backbone=tiny_backbone())
    folder = report_folder(result.output)
    assert folder.name == "head_training"
    assert {path.name for path in folder.iterdir()} == {
        "losses.png", "samples.png", "history.json", "README.txt"
    }  # fmt: skip
    for name in ("losses.png", "samples.png"):
        picture = cv2.imread(str(folder / name))
        assert picture is not None
        assert picture.std() > 10
    history = json.loads((folder / "history.json").read_text())
    assert [(e["member"], e["epoch"], e["is_fine"]) for e in history["epochs"]] == [
        (m, e, e == 2) for m in (0, 1) for e in range(3)
    ]
    assert all(e["held_out_loss"] is not None and e["held_out_abs_rel"] > 0 for e in history["epochs"])
    assert history["held_out"]["other"] == pytest.approx(result.held_out["other"])
    assert history["settings"]["view"]["rows"] == 28
    assert {"commit", "torch"} <= set(history["versions"])
    assert history["hardware"]["cores"] >= 1
    assert [(p["name"], p["samples"], p["is_held_out"]) for p in history["places"]] == [
        ("room", 8, False), ("other", 2, True)
    ]  # fmt: skip
    assert "head.safetensors" in (folder / "README.txt").read_text()
    # Each stage is told from nothing to all, one name a stage.
    stages = list(dict.fromkeys(step.stage for step in steps))
    assert stages[2:] == ["member 1 of 2", "member 2 of 2"]
    for stage in stages:
        told = [step for step in steps if step.stage == stage]
        assert [step.done for step in told] == sorted(step.done for step in told)
        assert told[-1].done == told[-1].total
    assert steps[-1].detail.startswith("epoch 3 of 3, loss ")


def test_samples_are_held_out_ones_first_and_metric(settings: dict[str, Any]) -> None:
    result = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert [sample.is_held_out for sample in result.samples] == [True, True, False, False, False, False]
    sample = result.samples[0]
    known = sample.sensor_m[sample.sensor_m > 0]
    assert 0.8 < known.min() < known.max() < 2.8  # as made
    assert sample.predicted_m.shape == sample.sigma_log.shape == (28, 42)
    assert (sample.predicted_m > 0).all()


def test_without_held_out_places_there_are_pictures_too(settings: dict[str, Any]) -> None:
    source = {**settings["sources"][0], "held_out": []}
    config = TrainConfig.from_dict({**settings, "sources": [source], "members": 1, "fine_epochs": 0})
    result = run_training(config, backbone=tiny_backbone())
    assert (report_folder(result.output) / "losses.png").is_file()
    assert not any(sample.is_held_out for sample in result.samples)
    assert result.history[0].held_out_loss is None


def test_a_report_that_cannot_be_written_leaves_the_checkpoints(settings: dict[str, Any]) -> None:
    config = TrainConfig.from_dict(settings)
    blocked = report_folder(Path(config.output))
    blocked.write_text("a file where the folder should be")
    with pytest.raises(OutputError, match="head_training: cannot be made"):
        run_training(config, backbone=tiny_backbone())
    assert len(list(blocked.parent.glob("*.checkpoint"))) == 2
    blocked.unlink()
    steps: list[TrainStep] = []
    run_training(config, progress=steps.append, backbone=tiny_backbone())
    assert steps == []  # nothing was done again
    assert not list(blocked.parent.glob("*.checkpoint"))


def test_a_damaged_checkpoint_starts_its_member_again(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    data = expected.output.read_bytes()
    monkeypatch.setattr(loop, "remove_checkpoints", lambda config: None)
    loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    files = sorted(expected.output.parent.glob("*.checkpoint"))
    files[0].write_bytes(files[0].read_bytes()[:-200])
    files[1].write_bytes(b"")
    again = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert again.output.read_bytes() == data


def test_a_full_disk_is_told_before(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    from slamdepth.depth.training import store

    monkeypatch.setattr(store.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    with pytest.raises(OutputError, match=r"the features need 0\.00 GB and 0\.00 GB are free; set SLAMDEPTH"):
        loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())


def test_a_cut_cache_is_made_anew(settings: dict[str, Any], tmp_path: Path) -> None:
    data = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone()).output.read_bytes()
    for file in (tmp_path / "cache" / "features").glob("*/tokens.npy"):
        file.write_bytes(file.read_bytes()[:500])
    again = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert again.output.read_bytes() == data


def test_a_plan_counts_and_measures_and_writes_nothing(settings: dict[str, Any], tmp_path: Path) -> None:
    config = TrainConfig.from_dict(settings)
    plan = plan_run(config, backbone=tiny_backbone())
    assert [(s.places, s.samples, s.cached, s.is_held_out) for s in plan.sources] == [
        (("room",), 8, 0, False), (("other",), 2, 0, True)
    ]  # fmt: skip
    assert plan.steps == 2 * 3 * 2
    assert plan.features_s is not None
    assert plan.features_s > 0
    assert not (tmp_path / "cache").exists()
    run_training(config, backbone=tiny_backbone())
    after = plan_run(config, backbone=tiny_backbone())
    assert [source.cached for source in after.sources] == [8, 2]
    assert after.features_s == 0
    for source in after.sources:
        on_disk = sum(file.stat().st_size for file in source.folder.glob("*.npy"))
        assert source.size_bytes == pytest.approx(on_disk, abs=6 * 256)  # headers and marks


def test_dry_run_without_a_backbone_says_what_is_missing(settings: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "train.yaml"
    file.write_text(yaml.safe_dump(settings))
    done = call("train-depth", file, "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "room" in done.stdout
    assert "10 views, 10 to compute" in done.stdout
    assert f"estimated time: unknown, the {weights.BACKBONE[:6]}".lower() in done.stdout.lower()
    assert weights.PULL_COMMAND in " ".join(done.stdout.split())
    assert not Path(settings["output"]).exists()


def test_bad_input_is_one_line(settings: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "train.yaml"
    file.write_text(yaml.safe_dump({**settings, "sources": [{"folder": str(tmp_path), "reader": "tun",
                                                             "places": [{"name": "data"}]}]}))  # fmt: skip
    done = call("train-depth", file, "--dry-run")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "unknown reader 'tun' of training data; choose from:" in done.stderr


# --- search -------------------------------------------------------------------------------

RANGES = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "head.dim": {"choices": [8, 16]},
    "loss.gradient": {"low": 0.0, "high": 1.0},
    "coarse_epochs": {"low": 1, "high": 2},
}


@pytest.fixture
def searched(settings: dict[str, Any]) -> dict[str, Any]:
    return {**settings, "fine_epochs": 0, "search": RANGES}


def with_optuna() -> None:
    pytest.importorskip("optuna", reason="Optuna is not installed: pip install 'slamdepth[search]'")


def test_a_search_goes_on_to_the_same_trials(searched: dict[str, Any], tmp_path: Path) -> None:
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


def test_a_study_that_is_none_is_one_error(searched: dict[str, Any]) -> None:
    with_optuna()
    Path(searched["output"]).with_name("head_search.sqlite3").write_bytes(b"not a database" * 100)
    with pytest.raises(OutputError, match=r"head_search\.sqlite3: cannot be used as a study"):
        run_search(TrainConfig.from_dict(searched), 1, backbone=tiny_backbone())


def test_a_diverged_trial_counts_and_loses() -> None:
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


def test_a_search_needs_a_judge(searched: dict[str, Any]) -> None:
    source = {**searched["sources"][0], "held_out": []}
    with pytest.raises(ConfigError, match="needs a place under 'held_out' to judge by"):
        run_search(TrainConfig.from_dict({**searched, "sources": [source]}), 1, backbone=tiny_backbone())


def test_pictures_are_the_same_for_the_same_training(settings: dict[str, Any]) -> None:
    from slamdepth.report.training import draw_samples

    result = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    paths = [result.output.with_name(f"{k}.png") for k in range(2)]
    for path in paths:
        draw_samples(path, result.samples[:1])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert np.unique(cv2.imread(str(paths[0])).reshape(-1, 3), axis=0).shape[0] > 50
