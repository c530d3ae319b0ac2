# SPDX-License-Identifier: Apache-2.0
"""Keyframes as they are handed over: dense depth is made when it is asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.depth.alignment import corrected_depth
from slamdepth.types import DepthPrediction, Frame, Keyframe

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class FinalKeyframe(Keyframe):
    """A keyframe whose depth follows from its prediction each time it is asked for.

    So the dense depth of one keyframe is in memory at a time, and not that of all.
    """

    _correction: NDArray[np.float32] | None
    _factor: float

    def __new__(cls, *args: Any, **fields: Any) -> Any:
        """A plain keyframe: what ``dataclasses.replace`` makes of one of these."""
        return Keyframe(*args, **fields)

    @classmethod
    def of(
        cls,
        id: int,
        frame: Frame,
        prediction: DepthPrediction,
        T_world_camera: Floats,
        keypoints_px: Floats,
        depth_scale: float = 1.0,
        correction: NDArray[np.float32] | None = None,
    ) -> FinalKeyframe:
        """A keyframe; for the arguments see :class:`slamdepth.types.Keyframe`.

        Args:
            correction: of the prediction, ``slamdepth.depth.alignment.coarse_correction``;
                None where its values are the depth.
        """
        keyframe: FinalKeyframe = object.__new__(cls)
        vars(keyframe).update(
            id=id, frame=frame, T_world_camera=T_world_camera, keypoints_px=keypoints_px,
            depth_scale=depth_scale, prediction=prediction, _correction=correction, _factor=1.0,
        )  # fmt: skip
        return keyframe

    @property
    def depth_m(self) -> NDArray[np.float32]:
        if self._correction is None:
            depth_m = self.prediction.values
        else:  # the prediction is read once, should it lie on disk
            depth_m = corrected_depth(self._correction, replace(self.prediction))
        return depth_m if self._factor == 1.0 else depth_m * np.float32(self._factor)

    @property
    def sigma_log(self) -> NDArray[np.float32] | None:
        return self.prediction.sigma_log

    def rescaled(self, factor: float) -> FinalKeyframe:
        T = self.T_world_camera.copy()
        T[:3, 3] *= factor
        keyframe: FinalKeyframe = object.__new__(type(self))
        vars(keyframe).update(vars(self))
        vars(keyframe).update(
            T_world_camera=T, depth_scale=self.depth_scale * factor, _factor=self._factor * factor
        )
        return keyframe
