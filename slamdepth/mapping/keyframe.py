# SPDX-License-Identifier: Apache-2.0
"""A keyframe of a finished map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.types import DepthPrediction, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Keyframe:
    """A keyframe after optimisation, with what the map fusion needs.

    Images and predictions of a tracker's keyframes may be read when they are asked for, each
    time anew, because those of all keyframes together may be more than memory holds. Dense depth in
    metres of the map is made each time for the same reason.

    Attributes:
        id: number of the keyframe, from 0.
        frame: its image (and sensor depth where there is one).
        T_world_camera: ``(4, 4)`` optimised pose.
        keypoints_px: ``(N, 2)`` float64 raw pixels.
        depth_scale: factor that turned the prediction into metres of the map.
        prediction: the map before scaling, as the model gave it.
        in_metres: what makes :attr:`depth_m` of the prediction.
    """

    id: int
    frame: Frame
    T_world_camera: NDArray[np.float64]
    keypoints_px: NDArray[np.float64]
    depth_scale: float
    prediction: DepthPrediction
    in_metres: Callable[[DepthPrediction], NDArray[np.float32]]

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """``(H, W)`` metres of the map, 0 where unknown or dropped; in the raw (distorted) pixels of
        the frame."""
        return self.in_metres(replace(self.prediction))  # read once, should it lie on disk

    @property
    def sigma_log(self) -> NDArray[np.float32] | None:
        """``(H, W)`` or None; see :class:`DepthPrediction`."""
        return self.prediction.sigma_log

    def rescaled(self, factor: float) -> Keyframe:
        """The keyframe in a map whose lengths were multiplied by ``factor``.

        Prediction and sensor depth stay as they were given; what the map makes of them changes.
        """
        T = self.T_world_camera.copy()
        T[:3, 3] *= factor
        return replace(
            self,
            T_world_camera=T,
            depth_scale=self.depth_scale * factor,
            in_metres=lambda prediction: self.in_metres(prediction) * np.float32(factor),
        )
