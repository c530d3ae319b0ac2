# SPDX-License-Identifier: Apache-2.0
"""The output of a training is checked before anything is computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import call
from killed_training import tiny_backbone
from safetensors.numpy import save_file
from training_places import tiny_settings

from slamdepth.errors import OutputError
from slamdepth.pipeline.training import plan_run, run_search, run_training
from slamdepth.training.checkpoint import checkpoint_path
from slamdepth.training.config import TrainConfig
from slamdepth.training.output import check_output


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    return {**tiny_settings(tmp_path, monkeypatch), "members": 1, "search": {"batch": {"low": 2, "high": 4}}}


def make_others(folder: Path) -> None:
    (folder / "a_folder.safetensors").mkdir()
    (folder / "precious.txt").write_text("precious")
    (folder / "precious.safetensors").write_text("precious")
    save_file({}, str(folder / "backbone.safetensors"), {"format": "pt"})


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (".", "is a folder; name a .safetensors file"),
        ("a_folder.safetensors", "is a folder"),
        ("precious.txt", "a head's file ends in .safetensors"),
        ("new", "a head's file ends in .safetensors"),
        ("precious.safetensors", "is there already and no depth head"),
        ("backbone.safetensors", "is there already and no depth head"),
        ("precious.txt/head.safetensors", "precious.txt is a file"),
        ("precious.txt/below/head.safetensors", "precious.txt"),
        ("n" * 300 + ".safetensors", "cannot be written"),
    ],
)
def test_a_bad_output_is_an_error_before_any_work(
    settings: dict[str, Any], name: str, says: str, tmp_path: Path
) -> None:
    make_others(tmp_path)
    config = TrainConfig.from_dict({**settings, "output": str(tmp_path / name)})
    before = sorted(path.name for path in tmp_path.iterdir())
    for work in (run_training, plan_run, lambda *a, **b: run_search(a[0], 1, **b)):
        with pytest.raises(OutputError, match=says) as error:
            work(config, backbone=tiny_backbone())
        assert "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / "precious.safetensors").read_text() == "precious"


def test_a_folder_without_permission_is_an_error(
    settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Path] = []
    monkeypatch.setattr("os.access", lambda path, mode: asked.append(path))
    config = TrainConfig.from_dict({**settings, "output": str(tmp_path / "new" / "head.safetensors")})
    with pytest.raises(OutputError, match="no permission to write to"):
        check_output(config)
    assert asked == [tmp_path]


def test_a_home_folder_is_expanded(
    settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    config = TrainConfig.from_dict({**settings, "output": "~/heads/head.safetensors"})
    assert checkpoint_path(config, 0).parent == tmp_path / "home" / "heads"
    assert run_training(config, backbone=tiny_backbone()).output == tmp_path / "home/heads/head.safetensors"
    assert not (tmp_path / "~").exists()
    assert check_output(config).is_file()  # a head may be replaced
    with pytest.raises(OutputError, match="is a folder"):
        check_output(config.model_copy(update={"output": "~"}))
    with pytest.raises(OutputError, match="name the folder in full"):
        check_output(config.model_copy(update={"output": "~nobody-of-this-name/head.safetensors"}))


def test_the_command_prints_one_line(settings: dict[str, Any], tmp_path: Path) -> None:
    make_others(tmp_path)
    file = tmp_path / "train.yaml"
    for more in ([], ["--dry-run"], ["--search", "1"]):
        file.write_text(yaml.safe_dump({**settings, "output": str(tmp_path / "precious.txt")}))
        done = call("train-depth", file, *more)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert "precious.txt: a head's file ends in .safetensors" in done.stderr
    (tmp_path / "head_training").write_text("a file where the report should be")
    file.write_text(yaml.safe_dump(settings))
    done = call("train-depth", file, "--dry-run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "head_training is a file" in done.stderr
