# SPDX-License-Identifier: Apache-2.0
"""A keyframe of a finished map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.dense_depth import StoredDenseDepth
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.types import DepthPrediction

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Keyframe:
    """A keyframe after optimisation, with what the map fusion needs.

    The images of all keyframes may be more than memory holds. So a keyframe has handles, whose ``load()``
    may read from disk, and dense depth in metres of the map is computed by :meth:`load_depth_m`.

    Attributes:
        id: number of the keyframe, from 0.
        frame: handle of its image (and sensor depth where there is one).
        T_world_camera: ``(4, 4)`` optimised pose.
        keypoints_px: ``(N, 2)`` float64 raw pixels.
        depth_scale: factor that turned the prediction into metres of the map.
        prediction: handle of the depth prediction as the model gave it, before scaling.
        in_metres: turns the prediction into ``(H, W)`` float32 depth in metres of the map.
        point_rows: ``(N,)`` row of each keypoint's landmark in ``Reconstruction.points_m``, -1 for none;
            empty where the odometry has no landmarks.
        dense: handle of dense depth measured from many views, or None where there is none.
    """

    id: int
    frame: StoredFrame
    T_world_camera: NDArray[np.float64]
    keypoints_px: NDArray[np.float64]
    depth_scale: float
    prediction: StoredPrediction
    in_metres: Callable[[DepthPrediction], NDArray[np.float32]]
    point_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    dense: StoredDenseDepth | None = None

    def load_depth_m(self) -> NDArray[np.float32]:
        """Dense depth ``(H, W)`` float32 in metres of the map, 0 where unknown or rejected.

        Its pixels are the raw (distorted) ones of the frame. Computed on each call.
        """
        return self.in_metres(self.prediction.load())

    def rescaled(self, factor: float) -> Keyframe:
        """The keyframe in a map whose lengths are multiplied by ``factor``.

        Prediction and sensor depth stay as they were given; pose and depth in metres of the map change.
        """
        T = self.T_world_camera.copy()
        T[:3, 3] *= factor
        return replace(
            self,
            T_world_camera=T,
            depth_scale=self.depth_scale * factor,
            in_metres=lambda prediction: self.in_metres(prediction) * np.float32(factor),
            dense=None if self.dense is None else self.dense.rescaled(factor),
        )
