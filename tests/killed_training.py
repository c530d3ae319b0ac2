# SPDX-License-Identifier: Apache-2.0
"""Trainings that are killed by SIGKILL, for ``tests/test_depth_training_kill.py``.

``python killed_training.py PLAN.json`` forks a child for each entry of the plan. A child trains; the
first one to the end. If an entry has a ``share``, its child sends itself SIGKILL before it executes the
line of the training package at that share of all lines executed by the first child, so the moment is
reproducible. The outcome of each child is printed as JSON.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import torch
import torch._dynamo  # imported by the first optimiser step; otherwise each child spends seconds on it

from slamdepth.depth.dinov2 import DinoV2
from slamdepth.training import loop
from slamdepth.training.config import TrainConfig

PACKAGE = str(Path(loop.__file__).parent)


def tiny_backbone() -> DinoV2:
    """The same small random network in every process."""
    torch.manual_seed(0)
    model = DinoV2(dim=24, depth=2, heads=3, grid=5)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return model.eval().requires_grad_(False)


class Lines:
    """Counts the executed lines of the training package and kills the process at one of them."""

    def __init__(self, deadly: int | None) -> None:
        self.count, self.deadly, self.where = 0, deadly, ""

    def __call__(self, frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        if event == "line":
            self.count += 1
            if self.count == self.deadly:
                os.write(3, f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}".encode())
                os.kill(os.getpid(), signal.SIGKILL)
        return self


def train(entry: dict[str, Any], all_lines: int) -> None:
    """The work of a child process."""
    os.environ["SLAMDEPTH_CACHE"] = entry["cache"]
    lines = Lines(round(entry["share"] * all_lines) if "share" in entry else None)
    if entry.get("torn_checkpoint"):
        tear_checkpoint(entry["torn_checkpoint"])
    backbone = tiny_backbone()
    sys.settrace(lines)
    loop.train_depth(TrainConfig.from_dict(entry["settings"]), backbone=backbone)
    sys.settrace(None)
    os.write(3, str(lines.count).encode())


def tear_checkpoint(number: int) -> None:
    """Kill the process when the ``number``-th checkpoint is half written."""
    real, calls = torch.save, []

    def save(state: Any, file: Any) -> None:
        calls.append(1)
        if len(calls) == number:
            file.write(b"PK\x03\x04 half a checkpoint")
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        real(state, file)

    mock.patch.object(torch, "save", save).start()


def main() -> None:
    plan = json.loads(Path(sys.argv[1]).read_text())
    torch.set_num_threads(1)
    out: list[dict[str, Any]] = []
    for entry in plan:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.dup2(writing, 3)
                train(entry, int(out[0]["said"]) if out else 0)
                os._exit(0)
            finally:
                import traceback

                traceback.print_exc()
                os._exit(1)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            said = pipe.read()
        _, status = os.waitpid(child, 0)
        killed_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        out.append({"killed_by": killed_by, "code": status >> 8 if not killed_by else None, "said": said})
    print(json.dumps(out))


if __name__ == "__main__":
    main()
