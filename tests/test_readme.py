# SPDX-License-Identifier: Apache-2.0
"""The README's example runs, and the commands, files and links of all documents exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
RUNNING = (ROOT / "docs" / "running.md").read_text(encoding="utf-8")
CAMERA = (ROOT / "docs" / "camera.md").read_text(encoding="utf-8")
RECORD = ROOT / "docs" / "experiments"
"""Dated files, which name modules of their day."""
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *RECORD.glob("*.md")])
CURRENT = [document for document in DOCUMENTS if document.parent != RECORD]


def name_of(document: Path) -> str:
    return document.relative_to(ROOT).as_posix()


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def anchors(document: Path) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


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
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo", "room.ply"]


def test_the_camera_file_can_be_read(tmp_path: Path) -> None:
    import slamdepth

    (text,) = blocks("yaml", CAMERA)
    (tmp_path / "camera.yaml").write_text(text)
    assert slamdepth.Camera.from_file(tmp_path / "camera.yaml").width == 640


def test_the_commands_exist() -> None:
    import typer.main

    from slamdepth.cli.app import app

    known = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    named = set(
        re.findall(r"^slamdepth ([a-z-]+)", "".join(blocks("sh") + blocks("sh", RUNNING)), re.MULTILINE)
    )
    assert named
    assert named <= known


def test_the_run_folder_is_explained() -> None:
    from slamdepth.pipeline.folder import FILES

    section = RUNNING.split("## Output files")[1].split("\n## ")[0]
    assert set(re.findall(r"`(\w+\.(?:txt|ply|png|html|json|yaml|safetensors))`", section)) == set(FILES)


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_linked_files_and_headings_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for link, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", text):
        target = (document.parent / link) if link else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


@pytest.mark.parametrize("document", CURRENT, ids=name_of)
def test_named_files_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for path in re.findall(r"`((?:slamdepth|tests|data_scripts|benchmarks)/[\w/.-]*)`", text):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("document", CURRENT, ids=name_of)
def test_named_benchmarks_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for module in re.findall(r"python -m benchmarks\.(\w+)", text):
        assert (ROOT / "benchmarks" / f"{module}.py").exists(), module


def test_every_experiment_is_in_the_index() -> None:
    linked = set(re.findall(r"\]\((\d{4}-\d\d-\d\d-[\w-]+\.md)\)", (RECORD / "README.md").read_text("utf-8")))
    assert linked == {path.name for path in RECORD.glob("[0-9]*.md")}
