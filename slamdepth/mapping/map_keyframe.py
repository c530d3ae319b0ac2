# SPDX-License-Identifier: Apache-2.0
"""A keyframe while the map grows, and poses that are stored relative to one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slamdepth.geometry import invert
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.typing import Floats, Ints

_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass
class KeyframeState:
    """What the map knows of a keyframe; only :class:`~slamdepth.mapping.map.Map` writes it.

    The attributes are those of :class:`MapKeyframe`.
    """

    id: int
    frame: StoredFrame
    features: Any
    T_camera_world: Floats
    landmark_ids: Ints
    log_depth: Floats
    sigma_log: Floats
    velocity: Floats
    prediction: StoredPrediction | None = None
    predicted_log_depth: Floats = field(default_factory=lambda: np.zeros(0))
    scale: float = 1.0
    unit: float = 1.0
    session: int = 0


class MapKeyframe:
    """A keyframe of a growing map, read-only: it shows what the map knows of it at any time.

    Attributes:
        id: number of the keyframe in its map, from 0.
        frame: handle of its image, and of sensor depth where there is one.
        features: its :class:`~slamdepth.frontend.features.Features`, ``N`` of them.
        T_camera_world: ``(4, 4)``.
        landmark_ids: ``(N,)`` landmark each feature sees, -1 for none.
        log_depth, sigma_log: ``(N,)`` prior of each feature: natural logarithm of its depth in metres of
            the map and the deviation of that; NaN where it has none.
        prediction: handle of the depth as the model gave it; None until it is there.
        predicted_log_depth: ``(N,)`` of a network's prediction at each feature, NaN where unknown; empty
            with a sensor.
        scale: factor from the metres of the prediction to those of the map.
        velocity: ``(6,)`` m/s and rad/s in the camera frame when the image was taken.
        unit: product of the scales of all corrections of this keyframe: what was one metre when the
            keyframe was made.
        session: number of the recording it comes from, 0 for the first one of its map.
    """

    __slots__ = ("_state",)

    def __init__(self, state: KeyframeState) -> None:
        self._state = state

    @property
    def id(self) -> int:
        return self._state.id

    @property
    def frame(self) -> StoredFrame:
        return self._state.frame

    @property
    def features(self) -> Any:
        return self._state.features

    @property
    def T_camera_world(self) -> Floats:
        return read_only(self._state.T_camera_world)

    @property
    def T_world_camera(self) -> Floats:
        return read_only(invert(self._state.T_camera_world))

    @property
    def center_w(self) -> Floats:
        """Camera centre ``(3,)`` in the world frame."""
        T = self._state.T_camera_world
        return read_only(-T[:3, :3].T @ T[:3, 3])

    @property
    def landmark_ids(self) -> Ints:
        return read_only(self._state.landmark_ids)

    @property
    def log_depth(self) -> Floats:
        return read_only(self._state.log_depth)

    @property
    def sigma_log(self) -> Floats:
        return read_only(self._state.sigma_log)

    @property
    def prediction(self) -> StoredPrediction | None:
        return self._state.prediction

    @property
    def predicted_log_depth(self) -> Floats:
        return read_only(self._state.predicted_log_depth)

    @property
    def scale(self) -> float:
        return self._state.scale

    @property
    def velocity(self) -> Floats:
        return read_only(self._state.velocity)

    @property
    def unit(self) -> float:
        return self._state.unit

    @property
    def session(self) -> int:
        return self._state.session


@dataclass(frozen=True)
class AnchoredPose:
    """A camera pose relative to a keyframe: whatever moves the keyframe moves the camera.

    Attributes:
        keyframe: the anchor.
        T_camera_keyframe: ``(4, 4)`` in the metres of the map when it was made.
        unit: of the keyframe at that time.
    """

    keyframe: MapKeyframe
    T_camera_keyframe: Floats
    unit: float

    @staticmethod
    def of(T_camera_world: Floats, keyframe: MapKeyframe) -> AnchoredPose:
        """Anchor a pose ``(4, 4)`` to ``keyframe``."""
        return AnchoredPose(keyframe, T_camera_world @ keyframe.T_world_camera, keyframe.unit)

    def state(self) -> dict[str, Any]:
        """The pose as plain values, for a checkpoint."""
        return {
            "keyframe": self.keyframe.id,
            "T_camera_keyframe": self.T_camera_keyframe,
            "unit": self.unit,
        }

    @staticmethod
    def restored(state: dict[str, Any], keyframes: Sequence[MapKeyframe]) -> AnchoredPose:
        """What :meth:`state` gave, relative to the keyframe of that id."""
        return AnchoredPose(keyframes[state["keyframe"]], np.array(state["T_camera_keyframe"]), state["unit"])

    @staticmethod
    def arrays(poses: Sequence[AnchoredPose]) -> dict[str, NDArray[Any]]:
        """Several poses as arrays."""
        return {
            "keyframe": np.array([pose.keyframe.id for pose in poses], dtype=np.int64),
            "T_camera_keyframe": np.array([pose.T_camera_keyframe for pose in poses]).reshape(-1, 4, 4),
            "unit": np.array([pose.unit for pose in poses], dtype=np.float64),
        }

    @staticmethod
    def of_arrays(arrays: Mapping[str, NDArray[Any]], keyframes: Sequence[MapKeyframe]) -> list[AnchoredPose]:
        """What :meth:`arrays` was given, relative to the keyframes of these ids."""
        return [
            AnchoredPose(keyframes[keyframe], np.array(T_camera_keyframe), unit)
            for keyframe, T_camera_keyframe, unit in zip(
                arrays["keyframe"].tolist(),
                arrays["T_camera_keyframe"],
                arrays["unit"].tolist(),
                strict=True,
            )
        ]

    @property
    def T_camera_world(self) -> Floats:
        """The pose ``(4, 4)`` in the map as it is now."""
        T_camera_keyframe = self.T_camera_keyframe
        if self.keyframe.unit != self.unit:
            T_camera_keyframe = T_camera_keyframe.copy()
            T_camera_keyframe[:3, 3] *= self.keyframe.unit / self.unit
        return T_camera_keyframe @ self.keyframe.T_camera_world


def read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """A view of ``array`` that cannot be written."""
    view: NDArray[_Scalar] = array.view()
    view.flags.writeable = False
    return view
