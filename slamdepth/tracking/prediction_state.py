# SPDX-License-Identifier: Apache-2.0
"""A depth prediction as arrays and plain values, for checkpoints."""

from __future__ import annotations

from slamdepth.io.tree import Tree
from slamdepth.types import DepthKind, DepthPrediction


def prediction_state(prediction: DepthPrediction) -> Tree:
    """A prediction as it is."""
    return {
        "values": prediction.values,
        "kind": prediction.kind.value,
        "sigma_log": prediction.sigma_log,
        "is_sensor": prediction.is_sensor,
        "gravity": prediction.gravity,
        "gravity_share": prediction.gravity_share,
        "scale_sigma_log": prediction.scale_sigma_log,
    }


def prediction_of(state: Tree) -> DepthPrediction:
    """What :func:`prediction_state` was given."""
    return DepthPrediction(**{**state, "kind": DepthKind(state["kind"])})
