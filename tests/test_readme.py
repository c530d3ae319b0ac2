# SPDX-License-Identifier: Apache-2.0
"""The README says what is true: its example runs, its commands and files exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_python_example_runs(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "room").symlink_to(tiny_room)
    monkeypatch.chdir(tmp_path)
    (example,) = blocks("python")
    exec(compile(example, "README.md", "exec"), {"__name__": "example"})
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1].startswith("40 poses, ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo"]


def test_the_camera_file_can_be_read(tmp_path: Path) -> None:
    from slamdepth.datasets import read_camera

    (text,) = blocks("yaml")
    (tmp_path / "camera.yaml").write_text(text)
    assert read_camera(tmp_path / "camera.yaml").width == 640


def test_the_commands_exist() -> None:
    import typer.main

    from slamdepth.cli.app import app

    known = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    named = set(re.findall(r"^slamdepth ([a-z-]+)", "".join(blocks("sh")), re.MULTILINE))
    assert named
    assert named <= known


def test_the_run_folder_is_explained() -> None:
    from slamdepth.pipeline.folder import FILES

    section = README.split("### What a run leaves behind")[1].split("###")[0]
    assert set(re.findall(r"`(\w+\.(?:txt|ply|png|html|json|yaml))`", section)) == set(FILES)


def test_linked_files_exist() -> None:
    for document in ("README.md", "CONTRIBUTING.md", "docs/architecture.md"):
        folder = (ROOT / document).parent
        for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / document).read_text(encoding="utf-8")):
            assert (folder / link).exists(), f"{document}: {link}"


def test_named_modules_exist() -> None:
    for document in ("README.md", "CONTRIBUTING.md", "docs/architecture.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for path in re.findall(r"`((?:slamdepth|tests|data_scripts|benchmarks)/[\w/.-]*)`", text):
            assert (ROOT / path).exists(), f"{document}: {path}"
