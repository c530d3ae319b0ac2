# SPDX-License-Identifier: Apache-2.0
"""Calling the command line from tests, and copies of sequences to be damaged."""

from __future__ import annotations

import io
import logging
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from slamdepth.cli import main

ENVIRONMENT = {
    **os.environ,
    "OMP_NUM_THREADS": "1",
    "COLUMNS": "120",
    "NO_COLOR": "1",
    "PYTHONUNBUFFERED": "1",
}


class Finished(NamedTuple):
    """Exit code and output of a command."""

    returncode: int
    stdout: str
    stderr: str


def slamdepth(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``slamdepth`` in a process of its own."""
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, env={**ENVIRONMENT, **environment}, check=False
    )


def call(*arguments: object) -> Finished:
    """Run ``slamdepth`` in this process, which saves the seconds of its imports.

    Environment, logging and ``sys.argv`` are afterwards as they were.
    """
    package = logging.getLogger("slamdepth")
    before = sys.argv, dict(os.environ), package.level, list(package.handlers)
    stdout, stderr = io.StringIO(), io.StringIO()
    sys.argv = ["slamdepth", *map(str, arguments)]
    try:
        with redirect_stdout(stdout), redirect_stderr(stderr), pytest.raises(SystemExit) as leaving:
            main()
    finally:
        sys.argv, environment, package.level, package.handlers = before
        os.environ.clear()
        os.environ.update(environment)
    return Finished(int(leaving.value.code or 0), stdout.getvalue(), stderr.getvalue())


def leave_out_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no plots in reports of this process: they take most of a short run's time."""
    monkeypatch.setattr("slamdepth.report.html._charts", lambda data, summary: defaultdict(lambda: None))


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "slamdepth", *map(str, arguments)]


def copy_of(sequence: Path, folder: Path) -> Path:
    """A copy of a TUM folder whose images are the same files."""
    for path in sequence.rglob("*"):
        target = folder / path.relative_to(sequence)
        if path.is_dir():
            target.mkdir(parents=True, exist_ok=True)
        elif path.suffix == ".png":
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link(path, target)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
    return folder


def images(sequence: Path) -> list[Path]:
    return sorted((sequence / "rgb").iterdir())


def replace_image(path: Path, data: bytes) -> None:
    path.unlink()
    path.write_bytes(data)


def make_long(sequence: Path, folder: Path, repeats: int) -> Path:
    """The sequence played forward and back ``repeats`` times: long enough to be interrupted."""
    copy_of(sequence, folder)
    (folder / "groundtruth.txt").unlink()
    for kind in ("rgb", "depth"):
        names = [path.name for path in sorted((folder / kind).iterdir())]
        there_and_back = names + names[-2:0:-1]
        lines = [f"{i / 30:.6f} {kind}/{name}" for i, name in enumerate(there_and_back * repeats)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return folder
