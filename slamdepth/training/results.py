# SPDX-License-Identifier: Apache-2.0
"""What a training made, for whoever draws and writes it down."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class EpochFigures:
    """One epoch of one member.

    Attributes:
        member, epoch: counted from 0.
        is_fine: judged at full resolution; else at 1/7, whose losses are other numbers.
        loss: mean training loss.
        held_out_loss: the same loss without dropout, mean over the held-out places; None
            where there are none.
        held_out_abs_rel: AbsRel after one median a view, mean over the held-out places.
        seconds: wall time of the epoch's steps.
    """

    member: int
    epoch: int
    is_fine: bool
    loss: float
    held_out_loss: float | None
    held_out_abs_rel: float | None
    seconds: float


@dataclass(frozen=True)
class SampleView:
    """A view, what was measured of it and what the finished head says.

    Attributes:
        image_rgb: ``(H, W, 3)`` uint8, as the network saw it.
        sensor_m, predicted_m: ``(H, W)`` float32 metres along z, 0 where unknown.
        sigma_log: ``(H, W)`` float32 deviation of the predicted log depth.
    """

    place: str
    is_held_out: bool
    image_rgb: NDArray[np.uint8]
    sensor_m: NDArray[np.float32]
    predicted_m: NDArray[np.float32]
    sigma_log: NDArray[np.float32]


@dataclass(frozen=True)
class TrainResult:
    """What a training made.

    Attributes:
        output: the head file.
        history: every epoch of every member, in order.
        held_out: for each held-out place, the figures of :func:`~slamdepth.training.judge.judge`.
        sigma_scale: factor on sigma stored in the head.
        samples: a few views with their prediction, held-out ones first.
        places: every place trained on or held out, with how many samples of it and what was
            noted while opening it.
        about: what the head file's header says.
        unseen_surest_half: by place and by what is taken for doubt, see
            :func:`~slamdepth.training.out_of_fold.learn_doubt`, error of the surest half of
            pixels over that of all; empty where members tell their own.
    """

    output: Path
    history: tuple[EpochFigures, ...]
    held_out: dict[str, dict[str, float]]
    sigma_scale: float
    samples: tuple[SampleView, ...]
    places: tuple[dict[str, Any], ...]
    about: dict[str, str]
    unseen_surest_half: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def losses(self) -> NDArray[np.float64]:
        """Mean training loss ``(members, epochs)``."""
        members = 1 + max(figures.member for figures in self.history) if self.history else 0
        return np.array([[f.loss for f in self.history if f.member == m] for m in range(members)])
