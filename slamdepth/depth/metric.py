# SPDX-License-Identifier: Apache-2.0
"""The depth model of a tracker, whose numbers have to be metres."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import AUTO, chosen_name, create_depth_model
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind


def configured_model(config: Config) -> DepthModel:
    """The depth model that ``config`` names, with its settings.

    Raises:
        ConfigError: no model has that name, or it lacks a setting that was chosen.
        WeightsError: its weights are not there.
    """
    return create_depth_model(
        config.depth.name,
        device=config.device,
        seed=config.seed,
        weights=config.depth.weights,
        precision=config.depth.precision,
        input_px=config.depth.input_px,
    )


def metric_model(model: DepthModel | None, config: Config) -> DepthModel:
    """``model``, or else the one that ``config.depth.name`` names.

    Raises:
        ConfigError: no model has that name, or its predictions are relative.
        WeightsError: its weights are not there.
    """
    model = model or configured_model(config)
    check_metric(model)
    return model


def with_chosen_model(config: Config) -> Config:
    """``config`` with the depth model that ``auto`` stands for, so that it names what a run used."""
    if config.depth.name != AUTO:
        return config
    name = chosen_name(has_weights=config.depth.weights is not None)
    return config.model_copy(update={"depth": config.depth.model_copy(update={"name": name})})


def check_metric(model: DepthModel) -> None:
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
