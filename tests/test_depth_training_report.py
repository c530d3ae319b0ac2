# SPDX-License-Identifier: Apache-2.0
"""The report of a training, the output of --dry-run, and failures of the disk."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import call
from killed_training import tiny_backbone
from sequences import imread
from training_places import tiny_settings

from slamdepth.depth import weights
from slamdepth.errors import OutputError
from slamdepth.pipeline.training import plan_run, report_folder, run_training
from slamdepth.training import loop
from slamdepth.training.config import TrainConfig
from slamdepth.training.progress import TrainStep


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    return tiny_settings(tmp_path, monkeypatch)


def test_a_training_writes_a_report(settings: dict[str, Any]) -> None:
    steps: list[TrainStep] = []
    result = run_training(TrainConfig.from_dict(settings), progress=steps.append, backbone=tiny_backbone())
    folder = report_folder(result.output)
    assert folder.name == "head_training"
    assert {path.name for path in folder.iterdir()} == {
        "losses.png", "samples.png", "history.json", "README.txt"
    }  # fmt: skip
    for name in ("losses.png", "samples.png"):
        image = imread(folder / name)
        assert image is not None
        assert image.std() > 10
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
    # Each stage has a unique name and is reported from start to end.
    stages = list(dict.fromkeys(step.stage for step in steps))
    assert stages[2:] == ["member 1 of 2", "member 2 of 2"]
    for stage in stages:
        reported = [step for step in steps if step.stage == stage]
        assert [step.done for step in reported] == sorted(step.done for step in reported)
        assert reported[-1].done == reported[-1].total
    assert steps[-1].detail.startswith("epoch 3 of 3, loss ")


def test_samples_are_held_out_ones_first_and_metric(settings: dict[str, Any]) -> None:
    result = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert [sample.is_held_out for sample in result.samples] == [True, True, False, False, False, False]
    sample = result.samples[0]
    known = sample.sensor_m[sample.sensor_m > 0]
    assert 0.8 < known.min() < known.max() < 2.8  # as made
    assert sample.predicted_m.shape == sample.sigma_log.shape == (28, 42)
    assert (sample.predicted_m > 0).all()


def test_a_training_without_held_out_places_has_plots_too(settings: dict[str, Any]) -> None:
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
    monkeypatch.setattr(loop, "remove_checkpoints", lambda *_: None)
    loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    files = sorted(expected.output.parent.glob("*.checkpoint"))
    files[0].write_bytes(files[0].read_bytes()[:-200])
    files[1].write_bytes(b"")
    again = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    assert again.output.read_bytes() == data


def test_a_full_disk_is_an_error_before_any_work(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    with pytest.raises(OutputError, match=r"the features need 0\.00 GB and 0\.00 GB are free; set SLAMDEPTH"):
        loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())


def test_a_truncated_cache_is_computed_again(settings: dict[str, Any], tmp_path: Path) -> None:
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


def test_a_dry_run_without_a_backbone_names_what_is_missing(settings: dict[str, Any], tmp_path: Path) -> None:
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


def test_plots_are_the_same_for_the_same_training(settings: dict[str, Any]) -> None:
    from slamdepth.report.training import draw_samples

    result = loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())
    paths = [result.output.with_name(f"{k}.png") for k in range(2)]
    for path in paths:
        draw_samples(path, result.samples[:1])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert np.unique(imread(paths[0]).reshape(-1, 3), axis=0).shape[0] > 50
