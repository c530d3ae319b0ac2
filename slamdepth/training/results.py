# SPDX-License-Identifier: Apache-2.0
"""Results of a training, as needed for its report."""

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
        is_fine: loss at full resolution; else at 1/7. The two are not comparable.
        loss: mean training loss.
        held_out_loss: loss without dropout, mean over the held-out places; None if there are none.
        held_out_abs_rel: AbsRel after median scaling per view, mean over the held-out places.
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
    """A view with its measured depth and the prediction of the finished head.

    Attributes:
        image_rgb: ``(H, W, 3)`` uint8, as the network saw it.
        sensor_m, predicted_m: ``(H, W)`` float32 metres along z, 0 where unknown.
        sigma_log: ``(H, W)`` float32 standard deviation of the predicted log depth.
    """

    place: str
    is_held_out: bool
    image_rgb: NDArray[np.uint8]
    sensor_m: NDArray[np.float32]
    predicted_m: NDArray[np.float32]
    sigma_log: NDArray[np.float32]


@dataclass(frozen=True)
class TrainResult:
    """Result of a training.

    Attributes:
        output: the head file.
        history: every epoch of every member, in order.
        held_out: figures of each held-out place, see :func:`~slamdepth.training.judge.judge`.
        sigma_scale: factor on sigma, stored in the head.
        samples: a few views with their prediction, held-out ones first.
        places: every place trained on or held out, with its number of samples and its notes.
        about: the header of the head file.
        unseen_surest_half: error of the surest half of the pixels over that of all, by left-out place
            and by uncertainty measure, see
            :func:`~slamdepth.training.out_of_fold.learn_uncertainty`; empty without out_of_fold.
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
