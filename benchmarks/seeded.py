# SPDX-License-Identifier: Apache-2.0
"""The depth model of a benchmark, seeded as :func:`slamdepth.run` seeds it."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.depth.metric import configured_model
from slamdepth.pipeline.seeds import seed_everything, seed_torch


def seeded_depth_model(name: str, config: Config) -> DepthModel:
    """The depth model ``name`` by the settings, with all random generators seeded.

    Raises:
        WeightsError: its weights are missing.
    """
    seed_everything(config.seed)
    depth = config.depth.model_copy(update={"name": name})
    model = configured_model(config.model_copy(update={"depth": depth}))
    seed_torch(config.seed)
    return model
