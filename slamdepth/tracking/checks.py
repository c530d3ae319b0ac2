# SPDX-License-Identifier: Apache-2.0
"""What every tracker asks of a frame and of a depth model."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import CameraError, ConfigError, TrackingError
from slamdepth.types import Camera, DepthKind, Frame


def model_for(depth_model: DepthModel | None, config: Config) -> DepthModel:
    """The model given, or else the one that ``config.depth.name`` names.

    Raises:
        ConfigError: no model has that name, or its predictions are relative.
        WeightsError: its weights are not there.
    """
    model = depth_model or create_depth_model(
        config.depth.name, device=config.device, seed=config.seed, weights=config.depth.weights
    )
    check_model(model)
    return model


def check_model(model: DepthModel) -> None:
    """Refuse a depth model whose numbers are not metres.

    Raises:
        ConfigError: its predictions are relative.
    """
    if model.kind is not DepthKind.METRIC:
        raise ConfigError(
            f"depth model '{model.name}' predicts {model.kind.value}; tracking needs metres: "
            "take a metric model, or fit scale and shift with 'slamdepth scale SEQ --shift --output FILE' "
            "and pass them (--depth-scale FILE)"
        )


def check_frame(frame: Frame, camera: Camera, last_time_s: float, finished: bool) -> None:
    """Refuse a frame that breaks the contract of ``Tracker.step``.

    Raises:
        TrackingError: the tracker has finished, or time does not increase.
        CameraError: the frame was taken by another camera.
    """
    if finished:
        raise TrackingError("this tracker has finished; make a new one for another sequence")
    if not frame.timestamp_s > last_time_s:
        raise TrackingError(
            f"frame {frame.index}: time must increase, got {frame.timestamp_s} s after {last_time_s} s"
        )
    if frame.camera != camera:
        raise CameraError(f"frame {frame.index} was taken by another camera than the tracker's")
