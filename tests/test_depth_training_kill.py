# SPDX-License-Identifier: Apache-2.0
"""A training that is killed, at any moment and repeatedly, ends in the same bytes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from training_places import make_place

HELPER = Path(__file__).with_name("killed_training.py")
MOMENTS = (0.04, 0.12, 0.2, 0.35, 0.62, 0.78, 0.97)
PATIENCE, TRIES = 0.5, 5


def entry(folder: Path, name: str, **more: Any) -> dict[str, Any]:
    """A training of two members and two epochs with its own cache."""
    settings = {
        "output": str(folder / name / "head.safetensors"),
        "members": 2,
        "coarse_epochs": 1,
        "fine_epochs": 1,
        "batch": 4,
        "sources": [
            {
                "folder": str(folder / "data"),
                "places": [{"name": "room", "samples": 9}],
                "held_out": ["other"],
            },
        ],
        "view": {"rows": 28, "columns": 42},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }
    return {"settings": settings, "cache": str(folder / name / "cache"), "name": name, **more}


class Trainings:
    """The outcome of every training, and the heads."""

    def __init__(self, folder: Path, plan: list[dict[str, Any]]) -> None:
        self.folder = folder
        file = folder / "plan.json"
        file.write_text(json.dumps(plan))
        command = [sys.executable, str(HELPER), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        results = json.loads(done.stdout.splitlines()[-1])
        assert all(result["code"] in (0, None) for result in results), done.stderr
        self.by_name: dict[str, list[dict[str, Any]]] = {}
        for planned, result in zip(plan, results, strict=True):
            self.by_name.setdefault(planned["name"], []).append(result)
        self.lines = int(results[0]["said"])

    def head(self, name: str) -> bytes:
        """The head file without the path in its header; all names have the same length."""
        data = (self.folder / name / "head.safetensors").read_bytes()
        return data.replace(str(self.folder / name).encode(), b"")


@pytest.fixture(scope="module")
def trainings(tmp_path_factory: pytest.TempPathFactory) -> Trainings:
    folder = tmp_path_factory.mktemp("killed")
    make_place(folder / "data" / "room")
    make_place(folder / "data" / "other", 2)
    plan = [entry(folder, "whole")]
    for k, share in enumerate(MOMENTS):
        plan += [entry(folder, f"mom_{k}", share=share), entry(folder, f"mom_{k}")]
    plan += [entry(folder, "often", share=PATIENCE)] * TRIES
    plan += [entry(folder, "torn_", torn_checkpoint=3), entry(folder, "torn_")]
    return Trainings(folder, plan)


@pytest.mark.parametrize("k", range(len(MOMENTS)))
def test_killed_at_moments_spread_over_the_training(trainings: Trainings, k: int) -> None:
    killed, finished = trainings.by_name[f"mom_{k}"]
    assert killed["killed_by"] == signal.SIGKILL
    assert finished["killed_by"] == 0
    assert trainings.head(f"mom_{k}") == trainings.head("whole"), killed["said"]


def test_the_moments_hit_the_cache_and_the_epochs(trainings: Trainings) -> None:
    where = [trainings.by_name[f"mom_{k}"][0]["said"].partition(":")[0] for k in range(len(MOMENTS))]
    assert {"features.py", "store.py", "augment.py"} & set(where[:3])
    assert {"member.py", "losses.py"} & set(where[3:]), where


def test_finished_work_is_not_repeated(trainings: Trainings) -> None:
    """The later the kill, the less is left."""
    left = [int(trainings.by_name[f"mom_{k}"][1]["said"]) for k in range(len(MOMENTS))]
    assert left[0] > left[3] > left[4] > left[-1]
    assert left[-1] < 0.5 * trainings.lines


def test_a_training_killed_repeatedly_still_finishes(trainings: Trainings) -> None:
    killed = [result["killed_by"] == signal.SIGKILL for result in trainings.by_name["often"]]
    assert killed[:2] == [True, True]
    assert False in killed
    assert trainings.head("often") == trainings.head("whole")


def test_killed_while_a_checkpoint_is_written(trainings: Trainings) -> None:
    assert [result["killed_by"] for result in trainings.by_name["torn_"]] == [signal.SIGKILL, 0]
    assert trainings.head("torn_") == trainings.head("whole")
    assert {path.name for path in (trainings.folder / "torn_").iterdir()} == {"head.safetensors", "cache"}
