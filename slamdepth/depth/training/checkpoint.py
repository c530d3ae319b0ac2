# SPDX-License-Identifier: Apache-2.0
"""The state of a member after each epoch, so that a killed training goes on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from slamdepth.depth.training.config import TrainConfig


def checkpoint_path(config: TrainConfig, member: int) -> Path:
    """The checkpoint of ``member``, beside the output."""
    output = Path(config.output)
    return output.with_name(f"{output.name}.member{member}.checkpoint")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write ``state`` whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    torch.save(state, partial)
    os.replace(partial, path)


def load_checkpoint(path: Path, key: str, device: str) -> dict[str, Any] | None:
    """The state written under ``key``, or None where there is none of it."""
    if not path.is_file():
        return None
    state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    return state if state["key"] == key else None
