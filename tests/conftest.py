# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1]))  # benchmarks is not installed; slamdepth is
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before PyTorch loads


@pytest.fixture(scope="session", autouse=True)
def compiled_loops() -> None:
    """Where numba is installed, no test waits for it to compile."""
    from slamdepth.frontend import compiled

    compiled.load()


@pytest.fixture(autouse=True)
def own_log() -> Iterator[None]:
    """A command that a test calls in this process shows the package's log until the test ends."""
    package = logging.getLogger("slamdepth")
    handlers, level = package.handlers[:], package.level
    yield
    package.handlers[:] = handlers
    package.setLevel(level)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real sequences; skips where it is absent."""
    named = os.environ.get("SLAMDEPTH_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real sequences are absent: set SLAMDEPTH_DATA to the folder that holds them")
    return folder


@pytest.fixture(scope="session")
def tiny_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered sequence of 40 frames at 320x240 with exact depth and poses; not to be changed."""
    from slamdepth.synth.sequence import SynthSettings, render_sequence

    settings = SynthSettings(frames=40, width=320, height=240, seed=3)
    return render_sequence(tmp_path_factory.mktemp("tiny") / "room", settings)
