# SPDX-License-Identifier: Apache-2.0
"""Depth models by name; a model's module is imported when it is first asked for.

A new model is one new module next to this one whose class (or factory) carries
``@register("its-name")``, and one line in ``_MODULES``. A package of its own adds one by an
entry point of the group ``slamdepth.depth_models``, whose name is the model's and whose
object is such a factory.
"""

from __future__ import annotations

import importlib
import inspect
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamdepth.depth.base import DepthModel
from slamdepth.depth.checkpoints import check_device, check_device_name
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

logger = logging.getLogger(__name__)

Factory = Callable[..., DepthModel]

ENTRY_POINTS = "slamdepth.depth_models"
_ONNX = "onnx:"
_MIRRORED = "mirrored:"
_DEPTH_ANYTHING = [
    f"depth-anything-v2-{size}{metric}"
    for size in ("small", "base", "large")
    for metric in ("", "-metric-indoor", "-metric-outdoor")
]
_OFFICIAL = ["dinov2-linear", "dinov2-linear-kitti", "dinov2-dpt", "dinov2-dpt-kitti"]

_MODULES = {
    "dinov2": "slamdepth.depth.model",
    "sensor": "slamdepth.depth.sensor",
    "dinov2-mlp": "slamdepth.depth.dinov2_mlp",
    **dict.fromkeys(_OFFICIAL, "slamdepth.depth.dinov2_official"),
    **dict.fromkeys(_DEPTH_ANYTHING, "slamdepth.depth.depth_anything"),
}
_factories: dict[str, Factory] = {}


def register(name: str) -> Callable[[Factory], Factory]:
    """Class decorator: make a depth model known as ``name``.

    It is called as ``factory(device=..., seed=...)``, and with ``weights=Path`` where the
    user names a weights file and the factory has such an argument.
    """

    def add(factory: Factory) -> Factory:
        if name in _factories and _factories[name].__module__ != factory.__module__:
            raise ConfigError(f"two depth models are called '{name}'")
        _factories[name] = factory
        return factory

    return add


def depth_model_names() -> list[str]:
    """Every name :func:`create_depth_model` takes, the default first; ``onnx:FILE`` stands for any file,
    ``mirrored:MODEL`` for any of the others."""
    others = sorted({*_factories, *_plugins()} - set(_MODULES))
    return [*_MODULES, f"{_ONNX}FILE", *others, f"{_MIRRORED}MODEL"]


def is_depth_model_name(name: str) -> bool:
    """Whether :func:`create_depth_model` takes ``name``; an ``onnx:`` file need not be there."""
    if name.startswith(_MIRRORED):
        return is_depth_model_name(name.removeprefix(_MIRRORED))
    return name.startswith(_ONNX) or name in depth_model_names()


def create_depth_model(
    name: str, *, device: str = "cpu", seed: int = 0, weights: str | Path | None = None
) -> DepthModel:
    """Build the depth model called ``name``.

    Args:
        name: one of :func:`depth_model_names`.
        device: where its network runs: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``, checked for every model.
        seed: for models with something random; the ones here have nothing.
        weights: its weights file; default: by its official name from the cache folder.

    Raises:
        ConfigError: no such model; lists the names. Or the device is not there, the model
            takes no weights file, or a plug-in is broken.
        WeightsError: its weights are missing, damaged or of another layout.
    """
    if name.startswith(_MIRRORED):
        from slamdepth.depth.mirrored import MirroredDepth

        looked_through = name.removeprefix(_MIRRORED)
        return MirroredDepth(create_depth_model(looked_through, device=device, seed=seed, weights=weights))
    if name.startswith(_ONNX):
        if weights is not None:
            raise ConfigError(f"depth model '{name}' names its file already; leave out the weights")
        check_device_name(device)  # ONNX Runtime has CUDA devices of its own, without PyTorch's
        from slamdepth.depth.onnx_model import create

        return create(name.removeprefix(_ONNX), device=device, seed=seed)
    check_device(device)
    if name not in _factories and name in _MODULES:
        importlib.import_module(_MODULES[name])
    if name not in _factories:
        plugins = _plugins().get(name)
        if plugins is None:
            raise ConfigError(f"unknown depth model '{name}'; choose from: {', '.join(depth_model_names())}")
        return _from_plugin(name, plugins, device, seed, weights)
    return _call(name, _factories[name], device, seed, weights)


def _call(name: str, factory: Factory, device: str, seed: int, weights: str | Path | None) -> DepthModel:
    if weights is None:
        return factory(device=device, seed=seed)
    parameters = inspect.signature(factory).parameters
    if "weights" not in parameters and not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        raise ConfigError(f"depth model '{name}' takes no weights file")
    return factory(device=device, seed=seed, weights=Path(weights))


def _plugins() -> dict[str, list[EntryPoint]]:
    """Entry points of other packages by name; names of models here are not theirs to take."""
    from importlib.metadata import entry_points

    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=ENTRY_POINTS):
        if point.name in _MODULES or point.name.startswith((_ONNX, _MIRRORED)):
            logger.warning("depth model '%s' of %s is ignored: the name is taken", point.name, point.value)
            continue
        found.setdefault(point.name, []).append(point)
    return found


def _from_plugin(
    name: str, points: list[EntryPoint], device: str, seed: int, weights: str | Path | None
) -> DepthModel:
    if len(points) > 1:
        raise ConfigError(f"two plug-ins add depth model '{name}': {', '.join(p.value for p in points)}")
    try:
        factory: Any = points[0].load()
    except Exception as error:  # whatever a foreign module raises when imported
        raise ConfigError(
            f"depth model '{name}': its plug-in {points[0].value} cannot be loaded: {error}"
        ) from error
    if not callable(factory):
        raise ConfigError(f"depth model '{name}': its plug-in {points[0].value} is no factory")
    model = _call(name, factory, device, seed, weights)
    if not isinstance(model, DepthModel) or not isinstance(model.kind, DepthKind):
        raise ConfigError(
            f"depth model '{name}': its plug-in {points[0].value} makes no depth model with name, kind, "
            "weights and predict"
        )
    return model
