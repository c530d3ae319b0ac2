# SPDX-License-Identifier: Apache-2.0
"""Find, read and strictly load weights files of depth networks."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from slamdepth.depth import weights as store
from slamdepth.depth.layout import check_layout
from slamdepth.errors import ConfigError, WeightsError

if TYPE_CHECKING:
    from torch import Tensor, nn

    Module = TypeVar("Module", bound=nn.Module)


def find_checkpoint(model: str, file_names: Sequence[str], given: str | Path | None) -> Path:
    """The weights file of ``model``: ``given``, else the first of ``file_names`` in the cache.

    Raises:
        WeightsError: there is no such file; says its name and where to put it.
    """
    if given is not None:
        if Path(given).is_file():
            return Path(given)
        raise WeightsError(f"{given}: no such weights file for depth model '{model}'")
    folder = store.cache_dir()
    for name in file_names:
        if (folder / name).is_file():
            return folder / name
    either = " or ".join(file_names)
    raise WeightsError(
        f"depth model '{model}' has no weights: put {either} into {folder}, "
        "or name the file (--depth-weights)"
    )


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors or PyTorch file; of the latter also those under ``state_dict``.

    PyTorch files are read as data only: no code in them is run.

    Raises:
        WeightsError: the file cannot be read or holds something else.
    """
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            tensors: dict[str, Tensor] = load_file(str(path))
            return tensors
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and safetensors each raise their own types
        if "Weights only load failed" in str(error):
            why = "it holds more than tensors and plain values, which is never run; save its state_dict()"
        else:
            why = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        raise WeightsError(f"{path}: not a readable weights file: {why}") from error
    if isinstance(loaded, Mapping) and isinstance(loaded.get("state_dict"), Mapping):
        loaded = loaded["state_dict"]
    if not isinstance(loaded, Mapping) or not loaded:
        raise WeightsError(f"{path}: expected a table of tensors")
    for name, value in loaded.items():
        if not isinstance(value, torch.Tensor):
            raise WeightsError(f"{path}: expected a table of tensors, but {name!r} is none")
    return {str(name): value for name, value in loaded.items()}


def load_strictly(
    build: Callable[[], Module],
    tensors: Mapping[str, Tensor],
    origin: str,
    *,
    device: str = "cpu",
) -> Module:
    """Build a network and load ``tensors`` into it: every one it needs, and no other.

    Args:
        build: makes the network; called on the meta device, so that nothing is allocated or initialised. It
            must keep no tensors outside its state.
        tensors: by name.
        origin: the file, named in errors.
        device: where the network is put.

    Returns:
        The network in float32 and eval mode, frozen, on ``device``.

    Raises:
        WeightsError: a tensor is missing, extra, misshapen or no floating point; names it.
    """
    import torch

    with torch.device("meta"):
        network = build()
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    check_layout(found, expected, origin)
    for name in expected:
        if not tensors[name].is_floating_point():
            raise WeightsError(f"{origin}: tensor {name} is {tensors[name].dtype}, not floating point")
    network.load_state_dict({name: tensors[name].float() for name in expected}, assign=True)
    network.eval().requires_grad_(False)
    return network.to(device)


def check_device(device: str) -> None:
    """Check that networks can run on ``device`` on this machine: ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        ConfigError: the name is unknown, or there is no such CUDA device.
    """
    check_device_name(device)
    if device == "cpu":
        return
    import torch

    if not torch.cuda.is_available():
        raise ConfigError(f"device '{device}': no CUDA device is available; use 'cpu'")
    _, _, number = device.partition(":")
    if number and int(number) >= (count := torch.cuda.device_count()):
        raise ConfigError(f"device '{device}': the last CUDA device is 'cuda:{count - 1}'")


def check_device_name(device: str) -> None:
    """Check that ``device`` is a device's name: ``cpu``, ``cuda`` or ``cuda:N``; it need not be available.

    Raises:
        ConfigError: the name is unknown.
    """
    if not re.fullmatch(r"cpu|cuda(:(0|[1-9][0-9]*))?", device):
        raise ConfigError(
            f"unknown device '{device}'; choose from: cpu, cuda, cuda:N (CUDA device N, from 0)"
        )
