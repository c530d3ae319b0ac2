# SPDX-License-Identifier: Apache-2.0
"""What the values of a published depth model mean: kind, range, input size and focal length.

They come from its own ``config.json``, from the table in :mod:`slamdepth.depth.hub_models`, or from a file
``slamdepth.json`` in its folder (:class:`~slamdepth.depth.card.StatedFacts`). None is guessed: without a kind
a model is refused.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from slamdepth.depth.card import ModelCard, StatedFacts
from slamdepth.depth.hub_input import InputRule
from slamdepth.depth.hub_models import METRIC, HubModel
from slamdepth.depth.hub_store import CONFIG, UNKNOWN
from slamdepth.errors import WeightsError
from slamdepth.types import DepthKind

_log = logging.getLogger(__name__)

STATED = "slamdepth.json"
DEPTH_PRO = "depth_pro"

_NO_DEPTH = {
    "prompt_depth_anything": "completes the depth map of a sensor instead of predicting one",
    "chmv2": "predicts the height of trees",
}


def card_of_config(
    name: str,
    config: Mapping[str, Any],
    rule: InputRule,
    origin: str,
    known: HubModel | None = None,
    stated: StatedFacts | None = None,
) -> ModelCard:
    """The card of a model.

    Args:
        name: that it goes by.
        config: the content of its ``config.json``.
        rule: how its images are prepared.
        origin: its folder, named in errors.
        known: its entry in the table.
        stated: what a ``slamdepth.json`` says of it.

    Raises:
        WeightsError: neither of them says what its values mean, or they contradict one another.
    """
    model_type = str(config.get("model_type"))
    if model_type in _NO_DEPTH:
        raise WeightsError(f"{origin}: a model of type '{model_type}' {_NO_DEPTH[model_type]}")
    kind, range_m = _kind_of(model_type, config, origin)
    for source, other in (("the table of models", known), (STATED, stated)):
        if other is not None and kind is not None and other.kind is not kind:
            raise WeightsError(
                f"{origin}: its {CONFIG} says {kind.value}, {source} says {other.kind.value} for '{name}'"
            )
    kind = kind or (stated.kind if stated else None) or (known.kind if known else None)
    if kind is None:
        raise WeightsError(
            f"{origin}: nothing says what the values of this '{model_type}' mean; write {STATED} there with "
            f'at least {{"kind": K}}, K being one of {", ".join(repr(kind.value) for kind in DepthKind)}'
        )
    if stated is not None:
        size, focal_px = stated.input_size or rule.size, stated.focal_px
        licence, data = stated.licence, stated.trained_on
    elif known is not None:
        _check_range(range_m, known, origin, name)
        size, focal_px = known.training.size, known.training.focal_px
        licence, data = known.licence, known.training.data
        far_m = known.training.far_m
        range_m = range_m or (None if far_m is None else (0.0, far_m))
    else:
        size, focal_px, licence, data = rule.size, None, UNKNOWN, UNKNOWN
    if model_type == DEPTH_PRO:
        size = rule.size
        focal_px = None if size is None else float(size[1])
    if size is None:
        raise WeightsError(f"{origin}: nothing says the size of its images; write {STATED} with 'input_size'")
    if kind is METRIC and focal_px is None:
        _log.warning(
            "%s: the focal length it was trained at is not known or not a single one; its depth is taken as "
            "predicted, whatever the camera",
            name,
        )
    return ModelCard(name, kind, size, focal_px if kind is METRIC else None, licence, data, range_m)


def _kind_of(
    model_type: str, config: Mapping[str, Any], origin: str
) -> tuple[DepthKind | None, tuple[float, float] | None]:
    """Kind and range in metres as far as a ``config.json`` says them."""
    try:
        if model_type == "depth_anything":
            if config.get("depth_estimation_type", "relative") != "metric":
                return DepthKind.AFFINE_INVERSE_DEPTH, None
            return METRIC, (0.0, float(config["max_depth"]))
        if model_type == "glpn":
            return METRIC, (0.0, float(config.get("max_depth", 10)))
        if model_type == "tipsv2_dpt":
            return METRIC, (float(config.get("min_depth", 1e-3)), float(config.get("max_depth", 10)))
        if model_type == "zoedepth":
            if config.get("bin_centers_type", "softplus") != "normed":  # not bounded
                return METRIC, None
            bins = config["bin_configurations"]
            return METRIC, (
                min(float(one["min_depth"]) for one in bins),
                max(float(one["max_depth"]) for one in bins),
            )
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{origin}: its {CONFIG} lacks the range of its depth: {error}") from error
    return (METRIC, None) if model_type == DEPTH_PRO else (None, None)


def _check_range(range_m: tuple[float, float] | None, known: HubModel, origin: str, name: str) -> None:
    far_m = known.training.far_m
    if range_m is not None and far_m is not None and abs(range_m[1] - far_m) > 0.01 * far_m:
        raise WeightsError(
            f"{origin}: its {CONFIG} says depth up to {range_m[1]:g} m, but '{name}' was trained up to "
            f"{far_m:g} m: another model, or a wrong file"
        )
