# SPDX-License-Identifier: Apache-2.0
"""Depth models by name; a model's module is imported when it is first asked for.

A new model is a module of this package whose class (or factory) carries
``@register("its-name")``, and a line in ``_MODULES``. A package of its own adds one by an
entry point of the group ``slamdepth.depth_models``, whose name is the model's and whose
object is such a factory.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

from slamdepth.depth.base import DepthModel
from slamdepth.depth.checkpoints import check_device, check_device_name
from slamdepth.errors import ConfigError
from slamdepth.registry import Registry
from slamdepth.types import DepthKind

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
MODELS: Registry[Factory] = Registry(
    "depth model", modules=_MODULES, entry_points=ENTRY_POINTS, reserved=(_ONNX, _MIRRORED)
)


def register(name: str) -> Callable[[Factory], Factory]:
    """Class decorator: make a depth model known as ``name``.

    It is called as ``factory(device=..., seed=...)``, and with ``weights=Path`` where the
    user names a weights file and the factory has such an argument.

    Raises:
        ConfigError: another depth model has the name.
    """
    return MODELS.register(name)


def depth_model_names() -> list[str]:
    """Every name :func:`create_depth_model` takes, the default first; ``onnx:FILE`` stands for any file,
    ``mirrored:MODEL`` for any of the others."""
    names = MODELS.names()
    own, others = names[: len(_MODULES)], names[len(_MODULES) :]
    return [*own, f"{_ONNX}FILE", *others, f"{_MIRRORED}MODEL"]


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
    model = _call(name, MODELS.get(name, depth_model_names), device, seed, weights)
    plugin = MODELS.plugin(name)
    if plugin is not None and not (isinstance(model, DepthModel) and isinstance(model.kind, DepthKind)):
        raise ConfigError(
            f"depth model '{name}': its plug-in {plugin.value} makes no depth model with name, kind, "
            "weights and predict"
        )
    return model


def _call(name: str, factory: Factory, device: str, seed: int, weights: str | Path | None) -> DepthModel:
    if weights is None:
        return factory(device=device, seed=seed)
    parameters = inspect.signature(factory).parameters
    if "weights" not in parameters and not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        raise ConfigError(f"depth model '{name}' takes no weights file")
    return factory(device=device, seed=seed, weights=Path(weights))
