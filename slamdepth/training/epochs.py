# SPDX-License-Identifier: Apache-2.0
"""Epochs of a training with a checkpoint after each, from which a killed one goes on to the same bytes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

import torch
from torch import nn

from slamdepth.training.checkpoint import load_checkpoint, save_checkpoint
from slamdepth.training.results import EpochFigures

logger = logging.getLogger(__name__)


def run_epochs(
    run: Callable[[int], EpochFigures],
    count: int,
    parts: Mapping[str, nn.Module | torch.optim.Optimizer],
    path: Path,
    key: str,
    device: str,
    seed: int,
) -> list[EpochFigures]:
    """Run the epochs that the checkpoint does not have.

    Args:
        run: trains the epoch of this number.
        count: number of epochs.
        parts: what a checkpoint holds, by name; changed in place.
        path: of the checkpoint.
        key: identifies settings and data; a checkpoint with another key is not used.
        device: where the parts are.
        seed: of the training.

    Returns:
        The figures of all epochs.

    Raises:
        OutputError: a checkpoint cannot be written.
    """
    history: list[EpochFigures] = []
    if (state := load_checkpoint(path, key, device)) is not None:
        for name, part in parts.items():
            part.load_state_dict(state[name])
        history = [EpochFigures(**figures) for figures in state["history"]]
        logger.info("resuming from epoch %d of %s", len(history), path)
    for epoch in range(len(history), count):
        torch.manual_seed(seed + 1_000_003 * (epoch + 1))  # a resumed epoch has the same dropout
        history.append(run(epoch))
        states = {name: part.state_dict() for name, part in parts.items()}
        save_checkpoint(path, key, {**states, "history": [asdict(figures) for figures in history]})
    return history
