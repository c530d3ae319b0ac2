# SPDX-License-Identifier: Apache-2.0
"""The run folder: nothing is written too early, other files stay, every file is explained."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

import pytest

from slamdepth.errors import OutputError
from slamdepth.io import writable_file
from slamdepth.pipeline.asked import arguments_of
from slamdepth.pipeline.folder import FILES, MAPS, RunFolder, run_log, write_log_to
from slamdepth.pipeline.options import RunOptions


def test_a_default_run_folder_is_always_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = set()
    for _ in range(3):
        folder = RunFolder.plan(None, "desk", overwrite=False)
        folder.create()
        assert folder.path.parts[0] == "runs"
        assert folder.path.name.startswith("desk-")
        paths.add(folder.path)
    assert len(paths) == 3


def test_planning_makes_nothing(tmp_path: Path) -> None:
    RunFolder.plan(tmp_path / "a" / "b", "desk", overwrite=False)
    assert not any(tmp_path.iterdir())


def test_a_run_never_removes_what_it_reads(tmp_path: Path) -> None:
    place = tmp_path / "run"
    RunFolder.plan(place, "desk", overwrite=False).create()
    folder = RunFolder.plan(place, "desk", overwrite=True)
    for inner in ("map", "maps/2/map", "export/colmap", "export/nerfstudio/transforms.json"):
        with pytest.raises(OutputError, match="name another folder"):
            folder.check_keeps([place / inner])
    folder.check_keeps([place / "walk.mp4", tmp_path / "other" / "map", Path("camera:0")])
    RunFolder.plan(tmp_path / "new", "desk", overwrite=False).check_keeps([tmp_path / "new" / "map"])


def test_an_earlier_run_is_replaced_only_when_asked(tmp_path: Path) -> None:
    place = tmp_path / "run"
    RunFolder.plan(place, "desk", overwrite=False).create()
    (place / "trajectory.txt").write_text("old")
    (place / "mine.txt").write_text("notes")
    with pytest.raises(OutputError, match="--overwrite"):
        RunFolder.plan(place, "desk", overwrite=False)
    RunFolder.plan(place, "desk", overwrite=True).create()
    assert not (place / "trajectory.txt").exists()
    assert (place / "mine.txt").read_text() == "notes"


def test_a_folder_of_something_else_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text("another program's")
    with pytest.raises(OutputError, match="holds no earlier run"):
        RunFolder.plan(tmp_path, "desk", overwrite=True)


def test_a_file_is_no_run_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="file"):
            RunFolder.plan(path, "desk", overwrite=True)


def test_a_file_of_an_earlier_call_may_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "figures.json"
    assert writable_file(path, ".json") == path
    path.write_text("{}")
    assert writable_file(path, ".json") == path
    monkeypatch.chdir(tmp_path)
    assert writable_file(Path("figures.json"), ".json") == Path("figures.json")
    monkeypatch.setattr("os.access", lambda place, mode: Path(place).name != "figures.json")
    with pytest.raises(OutputError, match="no permission to replace it"):
        writable_file(path, ".json")


def test_a_file_of_another_kind_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "photo.png").write_text("")
    for path, said in (
        (tmp_path / "photo.png", "no .json file"),
        (tmp_path, "is a folder"),
        (tmp_path / "absent" / "figures.json", "no such folder"),
        (tmp_path / "photo.png" / "figures.json", "is a file"),
    ):
        with pytest.raises(OutputError, match=said):
            writable_file(path, ".json")


def test_discarding_leaves_what_is_not_ours(tmp_path: Path) -> None:
    for name in ("alone", "shared"):
        folder = RunFolder.plan(tmp_path / name, "desk", overwrite=False)
        folder.create()
        if name == "shared":
            (folder / "mine.txt").write_text("")
        folder.discard()
    assert not (tmp_path / "alone").exists()
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["mine.txt"]


def test_files_of_earlier_maps_are_removed_and_no_others(tmp_path: Path) -> None:
    place, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    folder = RunFolder.plan(place, "desk", overwrite=False)
    folder.create()
    assert folder.make_map_folder(1) == place
    for number in (2, 3):
        (folder.make_map_folder(number) / "trajectory.txt").write_text("old")
    (place / "maps" / "3" / "mine.txt").write_text("notes")
    for path in (place / "maps" / "mine", elsewhere):
        path.mkdir()
        (path / "trajectory.txt").write_text("mine")
    (place / "maps" / "4").symlink_to(elsewhere)
    RunFolder.plan(place, "desk", overwrite=True).create()
    left = sorted(path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file())
    assert left == ["README.txt", "maps/3/mine.txt", "maps/mine/trajectory.txt"]
    assert (elsewhere / "trajectory.txt").read_text() == "mine"


def test_discarding_removes_the_folders_of_maps(tmp_path: Path) -> None:
    folder = RunFolder.plan(tmp_path / "run", "desk", overwrite=False)
    folder.create()
    (folder.make_map_folder(2) / "keyframes.txt").write_text("")
    folder.discard()
    assert not (tmp_path / "run").exists()


def test_the_readme_lists_every_file(tmp_path: Path) -> None:
    folder = RunFolder.plan(tmp_path / "run", "desk", overwrite=False)
    folder.create()
    text = (folder / "README.txt").read_text()
    assert all(name in text for name in (*FILES, MAPS))


def test_the_readme_has_the_command_for_the_same_run_again(tmp_path: Path) -> None:
    arguments = arguments_of(RunOptions(Path("my desk"), None, Path("c.yaml"), 60, 2, mesh=False))
    folder = RunFolder.plan(tmp_path / "run", "desk", overwrite=False)
    folder.create(arguments)
    assert (folder / "README.txt").read_text().splitlines()[-1] == (
        "  slamdepth run 'my desk' --camera c.yaml --max-frames 60 --stride 2 --no-mesh "
        f"--config {shlex.quote(str(folder / 'config.yaml'))}"
    )
    assert RunFolder.plan(tmp_path / "run", "desk", overwrite=True).replaces
    assert arguments_of(RunOptions(Path("desk"))) == ["desk"]


def test_the_log_has_what_was_said_before_there_was_a_folder(tmp_path: Path) -> None:
    package = logging.getLogger("slamdepth")
    level, handlers = package.level, list(package.handlers)
    with run_log() as buffer:
        logging.getLogger("slamdepth.somewhere").debug("before")
        write_log_to(buffer, tmp_path / "log.txt")
        logging.getLogger("slamdepth.somewhere").debug("after")
        assert "after" in (tmp_path / "log.txt").read_text()  # at once: a killed run keeps it
    assert "before" in (tmp_path / "log.txt").read_text()
    assert (package.level, package.handlers) == (level, handlers)
