# SPDX-License-Identifier: Apache-2.0
"""Depth models by name; a model's module is imported when it is first asked for.

A new model is one new module beside this one whose class (or factory) carries
``@register("its-name")``, and one line in ``_MODULES``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

from slamdepth.depth.base import DepthModel
from slamdepth.errors import ConfigError

Factory = Callable[..., DepthModel]

_MODULES = {
    "dinov2": "slamdepth.depth.model",
    "sensor": "slamdepth.depth.sensor",
}
_factories: dict[str, Factory] = {}


def register(name: str) -> Callable[[Factory], Factory]:
    """Class decorator: make a depth model known as ``name``.

    It is called as ``factory(device=..., seed=...)``.
    """

    def add(factory: Factory) -> Factory:
        if name in _factories and _factories[name].__module__ != factory.__module__:
            raise ConfigError(f"two depth models are called '{name}'")
        _factories[name] = factory
        return factory

    return add


def depth_model_names() -> list[str]:
    """Every name :func:`create_depth_model` takes, sorted."""
    return sorted({*_MODULES, *_factories})


def create_depth_model(name: str, *, device: str = "cpu", seed: int = 0) -> DepthModel:
    """Build the depth model called ``name``.

    Args:
        device: where its network runs, ``"cpu"`` or ``"cuda"``.
        seed: for models with something random; the ones here have nothing.

    Raises:
        ConfigError: no such model; lists the names. Or the device is not there.
        WeightsError: its weights are missing or damaged.
    """
    if name not in _factories and name in _MODULES:
        importlib.import_module(_MODULES[name])
    if name not in _factories:
        raise ConfigError(f"unknown depth model '{name}'; choose from: {', '.join(depth_model_names())}")
    return _factories[name](device=device, seed=seed)
