# SPDX-License-Identifier: Apache-2.0
"""What a depth model that learns while it runs is, to the rest of the house.

After Tiwari et al., "Pseudo RGB-D for Self-Improving Monocular SLAM and Depth Prediction"
(ECCV 2020): the map's refined points teach the depth model, which in turn gives the map better
depth. There the whole network is trained between runs; here a few parameters, during one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from slamdepth.depth.base import DepthModel
from slamdepth.errors import ConfigError
from slamdepth.types import Adaptation, DepthPrediction, Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class TaughtView:
    """What the map knows of the depth of one keyframe.

    Attributes:
        frame: the keyframe's image; recognised by its index.
        px: ``(N, 2)`` raw pixels of well-triangulated points.
        log_depth: ``(N,)`` natural logarithm of their depth. Whatever is common to a view is
            ignored: the scale of the map teaches nothing.
        is_held_out: ``(N,)`` points to judge by, never to learn from.
    """

    frame: Frame
    px: NDArray[np.float64]
    log_depth: NDArray[np.float64]
    is_held_out: NDArray[np.bool_]


@runtime_checkable
class AdaptingDepthModel(DepthModel, Protocol):
    """A model that learns; what it predicts for a frame depends on what it was taught before."""

    def predict_as_trained(self, frame: Frame) -> DepthPrediction:
        """What :meth:`predict` would say had nothing been learnt."""
        ...

    def adapt(self, views: Sequence[TaughtView]) -> Adaptation:
        """Learn from all that the map knows by now, in order of time; says how it stands.

        The same calls of ``predict`` and ``adapt`` in the same order give the same bits. The scale
        of a prediction never changes, only its relief.
        """
        ...


@runtime_checkable
class AdaptableDepthModel(DepthModel, Protocol):
    """A model with a form that learns."""

    def adapting(self) -> AdaptingDepthModel:
        """This model as one that learns, starting from what it is; it itself stays as it is.

        Raises:
            ConfigError: it cannot in these circumstances; one line: why, and what to do.
        """
        ...


def adapting(model: DepthModel) -> AdaptingDepthModel:
    """The form of ``model`` that learns while it runs.

    Raises:
        ConfigError: it has none.
    """
    if not isinstance(model, AdaptableDepthModel):
        raise ConfigError(
            f"depth model '{model.name}' cannot adapt while it runs; leave out --adapt (depth.adapt) "
            "or take --depth dinov2"
        )
    return model.adapting()
