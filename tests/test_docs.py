# SPDX-License-Identifier: Apache-2.0
"""Every command of the documentation is known, those marked as tested run, and the site is built."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import call, leave_out_plots

import slamdepth

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
_BLOCK = r"^```{}\n(.*?)^```"
_TESTED = r"^<!-- tested: tests/test_docs\.py runs this -->\n```(sh|python)\n(.*?)^```"


def commands(text: str) -> Iterator[str]:
    """The lines of shell blocks that call slamdepth."""
    for block in re.findall(_BLOCK.format("sh"), text, re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("slamdepth "):
                yield line


def all_commands() -> list[tuple[str, str]]:
    return [
        (document.relative_to(ROOT).as_posix(), line)
        for document in DOCUMENTS
        for line in commands(document.read_text(encoding="utf-8"))
    ]


def parse(line: str) -> None:
    """Have the command line parsed, without running anything."""
    from slamdepth.cli.app import app

    words = shlex.split(line, comments=True)[1:]
    command: Any = typer.main.get_command(app)
    context = command.make_context("slamdepth", words, resilient_parsing=False)
    while hasattr(command, "commands"):
        name, command, rest = command.resolve_command(context, context._protected_args + context.args)
        context = command.make_context(name, rest, parent=context)


def test_commands_are_found() -> None:
    assert len(all_commands()) > 40


@pytest.mark.parametrize(("document", "line"), all_commands())
def test_the_command_and_its_options_exist(document: str, line: str) -> None:
    del document
    try:
        parse(line.replace("...", ""))
    except typer.Exit:
        return  # --help


def test_unknown_options_would_be_noticed() -> None:
    with pytest.raises(Exception, match="No such option"):
        parse("slamdepth run SEQ --no-such-option")


@pytest.mark.parametrize(
    "document",
    [one for one in DOCUMENTS if re.search(_TESTED, one.read_text("utf-8"), re.MULTILINE | re.DOTALL)],
    ids=lambda document: document.stem,
)
def test_the_tested_examples_run(
    document: Path, tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room").symlink_to(tiny_room)
    text = document.read_text(encoding="utf-8")
    for language, block in re.findall(_TESTED, text, re.MULTILINE | re.DOTALL):
        if language == "python":
            exec(compile(block, document.name, "exec"), {"__name__": "example"})
            continue
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            if words[:3] == ["slamdepth", "synth", "room"]:
                continue  # the room is there; tests/test_synth.py renders one
            done = call(*words[1:])
            assert done.returncode == 0, f"{line}: {done.stderr}"


def test_every_public_name_is_in_the_reference() -> None:
    named = re.findall(r"^::: slamdepth\.(\w+)$", (ROOT / "docs" / "api.md").read_text("utf-8"), re.MULTILINE)
    assert len(named) == len(set(named))
    assert set(named) == set(slamdepth.__all__) - {"__version__"}


def test_every_export_format_is_explained() -> None:
    from slamdepth.export import FORMATS

    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == set(FORMATS.names())


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="mkdocs-material is not installed: pip install '.[docs]'")
    pytest.importorskip("mkdocstrings", reason="mkdocstrings is not installed: pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    for name in set(slamdepth.__all__) - {"__version__"}:
        assert re.search(rf'id="slamdepth[\w.]*\.{name}"', page), name
    assert ":func:" not in page
    for path in (tmp_path / "site").glob("*.html"):
        loaded = re.findall(
            r'<(?:script|link|img)[^>]*(?:src|href)="(https?:[^"]*)"', path.read_text("utf-8")
        )
        assert not loaded, f"{path.name} loads {loaded}"
