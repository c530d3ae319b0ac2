# SPDX-License-Identifier: Apache-2.0
"""Depth models by name; a model's module is imported when it is first asked for.

A new model is a module of this package whose class (or factory) carries
``@register("its-name")``, and a line in ``_MODULES``. A package of its own adds one by an
entry point of the group ``slamdepth.depth_models``, whose name is the model's and whose
object is such a factory.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Container, Iterable
from pathlib import Path
from typing import Any

from slamdepth.config import Precision
from slamdepth.depth.base import DepthModel
from slamdepth.depth.checkpoints import check_device, check_device_name
from slamdepth.depth.hub_models import BY_NAME
from slamdepth.depth.hub_store import PREFIX, auto_name, is_hub_name
from slamdepth.errors import ConfigError
from slamdepth.registry import Registry
from slamdepth.types import DepthKind

_log = logging.getLogger(__name__)

Factory = Callable[..., DepthModel]

ENTRY_POINTS = "slamdepth.depth_models"
AUTO = "auto"
_ONNX = "onnx:"
_MIRRORED = "mirrored:"
_LACKS = {
    "weights": "takes no weights file",
    "precision": "has no choice of precision; leave out depth.precision",
    "input_px": "has no choice of input size; leave out depth.input_px",
}

_MODULES = {
    AUTO: __name__,  # stands for one of the others, see chosen_name
    "dinov2": "slamdepth.depth.model",
    "sensor": "slamdepth.depth.sensor",
    "dinov2-mlp": "slamdepth.depth.dinov2_mlp",
    **dict.fromkeys(BY_NAME, "slamdepth.depth.hub"),
}
MODELS: Registry[Factory] = Registry(
    "depth model", modules=_MODULES, entry_points=ENTRY_POINTS, reserved=(PREFIX, _ONNX, _MIRRORED)
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
    """Every name :func:`create_depth_model` takes, the default first; ``hf:ORG/NAME`` stands for any model of
    the hub or local folder of one, ``onnx:FILE`` for any file, ``mirrored:MODEL`` for any of the others."""
    names = MODELS.names()
    own, others = names[: len(_MODULES)], names[len(_MODULES) :]
    return [*own, f"{PREFIX}ORG/NAME", f"{PREFIX}FOLDER", f"{_ONNX}FILE", *others, f"{_MIRRORED}MODEL"]


def is_depth_model_name(name: str) -> bool:
    """Whether :func:`create_depth_model` takes ``name``; the files that it stands for need not be there."""
    if name.startswith(_MIRRORED):
        return is_depth_model_name(name.removeprefix(_MIRRORED))
    return name.startswith(_ONNX) or is_hub_name(name) or name in depth_model_names()


def chosen_name(*, has_weights: bool = False) -> str:
    """The model that ``auto`` stands for here and now; logs which and why.

    Args:
        has_weights: whether the user names a weights file, which then is one of the embedded model.
    """
    name, why = ("dinov2", "the embedded model, as its weights file is given") if has_weights else auto_name()
    _log.info("depth model '%s' is '%s': %s", AUTO, name, why)
    return name


def create_depth_model(
    name: str,
    *,
    device: str = "cpu",
    seed: int = 0,
    weights: str | Path | None = None,
    precision: Precision = "auto",
    input_px: int | None = None,
) -> DepthModel:
    """Build the depth model called ``name``.

    Args:
        name: one of :func:`depth_model_names`, or a folder with a model in the hub's layout. ``auto`` takes
            the best metric model in the cache folder, else the embedded one, and logs which.
        device: where its network runs: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``, checked for every model.
        seed: for models with something random; the ones here have nothing.
        weights: its weights file; default: by its official name from the cache folder.
        precision: what its network computes in. Only the embedded model has a choice.
        input_px: rows times columns of its network's input; None: as trained. Only the embedded model has a
            choice.

    Raises:
        ConfigError: no such model; lists the names. Or the device or the precision is not there, the model
            takes no weights file or has no such choice, or a plug-in is broken.
        WeightsError: its weights are missing, damaged or of another layout.
    """
    if name.startswith(_MIRRORED):
        from slamdepth.depth.mirrored import MirroredDepth

        return MirroredDepth(
            create_depth_model(
                name.removeprefix(_MIRRORED),
                device=device,
                seed=seed,
                weights=weights,
                precision=precision,
                input_px=input_px,
            )
        )
    options = _given(weights, precision, input_px)
    if name.startswith(_ONNX):
        if weights is not None:
            raise ConfigError(f"depth model '{name}' names its file already; leave out the weights")
        _check_options(name, options, ())
        check_device_name(device)  # ONNX Runtime has CUDA devices of its own, without PyTorch's
        from slamdepth.depth.onnx_model import create

        return create(name.removeprefix(_ONNX), device=device, seed=seed)
    check_device(device)
    if name == AUTO:
        name = chosen_name(has_weights=weights is not None)
    if is_hub_name(name):
        from slamdepth.depth.hub import HubDepth

        _check_options(name, options, ("weights",))
        return HubDepth.load(name, weights=None if weights is None else Path(weights), device=device)
    factory = MODELS.get(name, depth_model_names)
    parameters = inspect.signature(factory).parameters
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    _check_options(name, options, options if takes_all else parameters)
    model = factory(device=device, seed=seed, **options)
    plugin = MODELS.plugin(name)
    if plugin is not None and not (isinstance(model, DepthModel) and isinstance(model.kind, DepthKind)):
        raise ConfigError(
            f"depth model '{name}': its plug-in {plugin.value} makes no depth model with name, kind, "
            "weights and predict"
        )
    return model


def _given(weights: str | Path | None, precision: Precision, input_px: int | None) -> dict[str, Any]:
    """The arguments of a factory that differ from their defaults."""
    given = {
        "weights": None if weights is None else Path(weights),
        "precision": None if precision == "auto" else precision,
        "input_px": input_px,
    }
    return {option: value for option, value in given.items() if value is not None}


def _check_options(name: str, options: Iterable[str], accepted: Container[str]) -> None:
    for option in options:
        if option not in accepted:
            raise ConfigError(f"depth model '{name}' {_LACKS[option]}")
