# SPDX-License-Identifier: Apache-2.0
"""The built distributions hold what they should, and the workflow does what ``.ci/run`` does."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
CHECK = ROOT / ".ci" / "check_dist.py"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel and sdist of this checkout, built without a network."""
    pytest.importorskip("hatchling", reason="hatchling is not installed; make check-dist builds with it")
    folder = tmp_path_factory.mktemp("dist")
    for kind in ("wheel", "sdist"):
        code = f"from hatchling.build import build_{kind}; build_{kind}({str(folder)!r})"
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)
    return folder


def check(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(CHECK), str(folder)], capture_output=True, text=True, check=False
    )


def test_wheel_and_sdist_are_sound(built: Path) -> None:
    done = check(built)
    assert done.returncode == 0, done.stderr


def test_what_is_missing_or_unwanted_is_named(built: Path, tmp_path: Path) -> None:
    for path in built.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        kept = {
            name: archive.read(name) for name in archive.namelist() if not name.endswith("orb_vocabulary.npz")
        }
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, data in {**kept, "tests/data/room.ply": b""}.items():
            archive.writestr(name, data)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist, "w:gz") as tar:
        member = tarfile.TarInfo("slamdepth-0/big.bin")
        member.size = 5 * 2**20
        tar.addfile(member, io.BytesIO(bytes(member.size)))
    done = check(tmp_path)
    assert done.returncode == 1
    for says in ("lacks slamdepth/assets/orb_vocabulary.npz", "holds tests/data/room.ply", "lacks LICENSE"):
        assert says in done.stderr
    assert "big.bin has 5242880 bytes" in done.stderr


def test_two_wheels_are_refused(tmp_path: Path) -> None:
    done = check(tmp_path)
    assert done.returncode != 0
    assert "expected one" in done.stderr


def test_the_workflow_runs_what_ci_runs() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    jobs = workflow["jobs"]
    commands = {step.get("run") for job in jobs.values() for step in job["steps"]}
    assert {"bash .ci/run", "make check-dist", "make docs"} <= commands
    named = re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert jobs["install"]["strategy"]["matrix"]["python"] == named


def test_the_module_runs_as_the_command_does() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "slamdepth", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("slamdepth ")
