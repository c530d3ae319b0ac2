# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a member after each epoch, from which a killed training resumes."""

from __future__ import annotations

import logging
import os
import pickle
from pathlib import Path
from typing import Any

import torch

from slamdepth.errors import OutputError
from slamdepth.training.config import TrainConfig
from slamdepth.training.output import output_path

logger = logging.getLogger(__name__)


def checkpoint_path(config: TrainConfig, member: int) -> Path:
    """The checkpoint file of ``member``, in the folder of the output."""
    output = output_path(config)
    return output.with_name(f"{output.name}.member{member}.checkpoint")


def save_checkpoint(path: Path, key: str, state: dict[str, Any]) -> None:
    """Write ``state`` whole or not at all; an earlier checkpoint stays until it is on disk.

    Raises:
        OutputError: the file cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            torch.save({"key": key, **state}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        sync_folder(path.parent)
    except (OSError, RuntimeError) as error:  # torch raises RuntimeError on a full disk
        raise OutputError(f"{path}: cannot be written: {error}") from error


def load_checkpoint(path: Path, key: str, device: str) -> dict[str, Any] | None:
    """The state saved under ``key``; None, with a warning, if it is damaged or has another key."""
    if not path.is_file():
        return None
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        logger.warning("%s: damaged, so this member starts again: %s", path, reason)
        return None
    if not isinstance(state, dict) or state.get("key") != key:
        logger.warning("%s: of a training with other settings or data; starting from the beginning", path)
        return None
    return state


def remove_checkpoints(config: TrainConfig, count: int) -> None:
    """Remove the checkpoints of ``count`` heads, which only a killed training needs."""
    for member in range(count):
        path = checkpoint_path(config, member)
        path.unlink(missing_ok=True)
        path.with_name(path.name + ".partial").unlink(missing_ok=True)


def sync_file(path: Path) -> None:
    """Wait until the file ``path`` and its directory entry are on disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Wait until the directory entries of ``folder`` are on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
