# SPDX-License-Identifier: Apache-2.0
"""What a training tells whoever watches it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class TrainStep:
    """How far one stage of a training is.

    Attributes:
        stage: what is going on; each stage has a name of its own.
        done, total: in a unit that takes about the same time throughout the stage.
        detail: what is worth reading beside it, such as the epoch and the loss.
    """

    stage: str
    done: float
    total: float
    detail: str = ""


Progress = Callable[[TrainStep], None]


def silent(step: TrainStep) -> None:
    """A :data:`Progress` that tells nobody."""
