# SPDX-License-Identifier: Apache-2.0
"""A pretended CUDA device: shapes and devices are tracked, nothing is computed.

A tensor moved to ``"cuda"`` becomes one of PyTorch's device ``meta``; moved back to the CPU it is all ones.
An operation that reads tensors of both devices raises :class:`MixedDevicesError`, as on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

_CONFIG = import_module("torch.fx.experimental._config")  # PyTorch adds its ``patch`` when it is imported
_TAKES_BOTH = {"__getitem__", "__setitem__", "copy_"}
_SCALARS: dict[str, Any] = {"item": 1.0, "__float__": 1.0, "__int__": 1000, "__bool__": True}


class MixedDevicesError(RuntimeError):
    """One operation read tensors of the CPU and of the pretended GPU."""


@contextmanager
def pretend_cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The device ``"cuda"`` is available inside the context."""
    with monkeypatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(nn.Module, "to", _module_to)
        patch.setattr(nn.Module, "load_state_dict", _load_state_dict)
        with _CONFIG.patch(meta_nonzero_assume_all_nonzero=True), _Pretending():
            yield


class _Pretending(TorchFunctionMode):
    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        del types
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        first = args[0] if args else None
        if isinstance(first, Tensor):
            if func is torch.Tensor.to:
                return _moved(func, first, *_asked(args[1:], kwargs), args, kwargs)
            if first.is_meta:
                if func is torch.Tensor.cpu:
                    return torch.ones(first.shape, dtype=first.dtype)
                if name in ("numpy", "__array__"):
                    raise TypeError("a CUDA tensor cannot be converted to a NumPy array")
                if name in _SCALARS:
                    return _SCALARS[name]
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = [tensor for tensor in tensors if tensor.is_meta]
        here = [tensor for tensor in tensors if not tensor.is_meta and tensor.dim() > 0]
        if there and here and name not in _TAKES_BOTH:
            raise MixedDevicesError(f"{name} reads tensors of the CPU and of the GPU")
        if _is_cuda(kwargs.get("device")):
            kwargs["device"] = "meta"
        return func(*args, **kwargs)


def _asked(args: Any, kwargs: dict[str, Any]) -> tuple[Any, torch.dtype | None]:
    """The device and the type that ``Tensor.to`` or ``Module.to`` were asked for."""
    device, dtype = kwargs.get("device"), kwargs.get("dtype")
    for value in args:
        if isinstance(value, str | torch.device):
            device = value
        elif isinstance(value, torch.dtype):
            dtype = value
        elif isinstance(value, Tensor):
            device, dtype = value.device, value.dtype
    return device, dtype


def _moved(
    func: Callable[..., Any], tensor: Tensor, device: Any, dtype: torch.dtype | None, args: Any, kwargs: Any
) -> Any:
    if _is_cuda(device):
        return _there(tensor, dtype)
    if device is not None and tensor.is_meta:
        return torch.ones(tensor.shape, dtype=dtype or tensor.dtype)
    return func(*args, **kwargs)


def _is_cuda(device: Any) -> bool:
    return device is not None and str(device).startswith(("cuda", "meta"))


def _there(tensor: Tensor, dtype: torch.dtype | None) -> Tensor:
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=dtype or tensor.dtype, device="meta")


def _module_to(module: nn.Module, *args: Any, **kwargs: Any) -> nn.Module:
    """``Module.to`` with new parameters: new data in the old ones, as PyTorch does, cannot be on ``meta``."""
    device, dtype = _asked(args, kwargs)
    for part in module.modules():
        for name, value in part._parameters.items():
            if value is not None:
                moved = value.detach().to(device, dtype or value.dtype)
                part._parameters[name] = nn.Parameter(moved, requires_grad=value.requires_grad)
        for name, buffer in part._buffers.items():
            if buffer is not None:
                kept = dtype if buffer.is_floating_point() else None
                part._buffers[name] = buffer.to(device, kept or buffer.dtype)
    return module


def _load_state_dict(module: nn.Module, state: dict[str, Tensor], *_: Any, **__: Any) -> None:
    """Compare names and shapes; there is no data to load."""
    own = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    assert own == {name: tuple(value.shape) for name, value in state.items()}
