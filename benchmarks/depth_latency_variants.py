# SPDX-License-Identifier: Apache-2.0
"""The ViT-S/14 in forms that may be faster than PyTorch eager, and what each costs in accuracy."""

from __future__ import annotations

import contextlib
import importlib
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.errors import SlamdepthError

TAPS = (5, 8, 11)

Run = Callable[[Tensor], Tensor]


class Unavailable(Exception):
    """A form this machine or device cannot have; the text says why."""


class Tokens(nn.Module):
    """Patch and class tokens of all taps as one tensor ``(B, taps, 1 + h * w, dim)``."""

    def __init__(self, vit: DinoV2, taps: tuple[int, ...] = TAPS) -> None:
        super().__init__()
        self.vit, self.taps = vit, taps

    def forward(self, image: Tensor) -> Tensor:
        tapped = self.vit(image, self.taps)
        return torch.stack(
            [torch.cat([token[:, None], grid.flatten(2).transpose(1, 2)], dim=1) for grid, token in tapped],
            dim=1,
        )


def eager(network: Tokens, image: Tensor) -> Run:
    return network


def channels_last(network: Tokens, image: Tensor) -> Run:
    network.to(memory_format=torch.channels_last)
    return lambda x: network(x.to(memory_format=torch.channels_last))


def compiled(network: Tokens, image: Tensor) -> Run:
    return torch.compile(network)


def bfloat16_autocast(network: Tokens, image: Tensor) -> Run:
    def run(x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, dtype=torch.bfloat16):
            return network(x)

    return run


def bfloat16_weights(network: Tokens, image: Tensor) -> Run:
    network.bfloat16()
    network.vit._resized.clear()
    return lambda x: network(x.bfloat16())


def bfloat16_compiled(network: Tokens, image: Tensor) -> Run:
    bfloat16_weights(network, image)
    inner = torch.compile(network)
    return lambda x: inner(x.bfloat16())


def float16_weights(network: Tokens, image: Tensor) -> Run:
    if image.device.type == "cpu":
        raise Unavailable("float16 is for GPUs")
    network.half()
    network.vit._resized.clear()
    return lambda x: network(x.half())


def int8_dynamic(network: Tokens, image: Tensor) -> Run:
    if image.device.type != "cpu":
        raise Unavailable("PyTorch's dynamic int8 is for CPUs")
    try:
        from torch.ao.quantization import quantize_dynamic
    except ImportError as error:
        raise Unavailable("this PyTorch has no quantize_dynamic any more") from error
    return quantize_dynamic(network, {nn.Linear}, dtype=torch.qint8)


def onnx_float32(network: Tokens, image: Tensor) -> Run:
    return _onnx(network, image, is_int8=False)


def onnx_int8(network: Tokens, image: Tensor) -> Run:
    return _onnx(network, image, is_int8=True)


VARIANTS: dict[str, Callable[[Tokens, Tensor], Run]] = {
    "eager": eager,
    "channels-last": channels_last,
    "compile": compiled,
    "bfloat16-autocast": bfloat16_autocast,
    "bfloat16": bfloat16_weights,
    "bfloat16-compile": bfloat16_compiled,
    "float16": float16_weights,
    "int8": int8_dynamic,
    "onnx": onnx_float32,
    "onnx-int8": onnx_int8,
}


def variant_row(
    variant: str,
    device: str,
    size: tuple[int, int],
    repeats: int,
    warm_up: int,
    vit: Callable[[str], DinoV2] | None = None,
) -> dict[str, Any]:
    """Median wall and CPU time in milliseconds, and the relative error of the tokens against
    eager float32, ``|a - b| / |b|``. ``failed`` says why there are none.

    Args:
        size: rows and columns of the input.
        vit: how to make the backbone for a device; default: the cached weights.
    """
    about = {
        "variant": variant,
        "device": device,
        "size": f"{size[0]}x{size[1]}",
        "threads": torch.get_num_threads(),
    }
    make = vit or (lambda where: load_dinov2(store.find_backbone(None), where))
    generator = torch.Generator().manual_seed(0)
    image = torch.randn((1, 3, *size), generator=generator).to(device)
    try:
        with torch.inference_mode(), warnings.catch_warnings(), _untraced():
            warnings.simplefilter("ignore")
            truth = Tokens(make(device)).eval()(image).float()
            run = VARIANTS[variant](Tokens(make(device)).eval(), image)
            error = float((run(image).float() - truth).norm() / truth.norm())
            wall_ms, cpu_ms = _median_ms(run, image, repeats, warm_up)
        return {**about, "wall_ms": wall_ms, "cpu_ms": cpu_ms, "error": error}
    except (Unavailable, SlamdepthError) as why:
        return {**about, "failed": str(why)}
    except Exception as why:  # a compiler or exporter that is missing or broken raises anything
        first = (str(why).strip().splitlines() or [""])[0]
        return {**about, "failed": f"{type(why).__name__}: {first}"[:160]}


def _median_ms(run: Run, image: Tensor, repeats: int, warm_up: int) -> tuple[float, float]:
    wall, cpu = [], []
    for repeat in range(warm_up + repeats):
        cpu_s, wall_s = time.process_time(), time.perf_counter()
        run(image)
        if image.device.type == "cuda":
            torch.cuda.synchronize()
        if repeat >= warm_up:
            wall.append(time.perf_counter() - wall_s)
            cpu.append(time.process_time() - cpu_s)
    return 1e3 * statistics.median(wall), 1e3 * statistics.median(cpu)


def _onnx(network: Tokens, image: Tensor, *, is_int8: bool) -> Run:
    try:
        runtime: Any = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise Unavailable("needs ONNX Runtime: pip install 'slamdepth[onnx]'") from error
    on_gpu = image.device.type == "cuda"
    provider = "CUDAExecutionProvider" if on_gpu else "CPUExecutionProvider"
    if provider not in runtime.get_available_providers():
        raise Unavailable(f"this ONNX Runtime has no {provider}")
    # The exporter has no bicubic resizing with sizes; for one size the embedding is a constant.
    vit = network.cpu().vit
    fixed = vit.position_embedding(image.shape[2] // vit.patch, image.shape[3] // vit.patch)
    vit.position_embedding = lambda rows, columns: fixed
    vit._resized.clear()
    with tempfile.TemporaryDirectory(prefix="depth-latency-") as name:
        file = Path(name) / "vit.onnx"
        # The exporter of torch.export needs onnxscript; this one needs nothing.
        torch.onnx.export(
            network, (image.cpu(),), str(file), input_names=["image"], output_names=["tokens"],
            opset_version=17, dynamo=False,
        )  # fmt: skip
        if is_int8:
            quantization: Any = importlib.import_module("onnxruntime.quantization")
            smaller = Path(name) / "int8.onnx"
            quantization.quantize_dynamic(file, smaller, op_types_to_quantize=["MatMul", "Gemm"])
            file = smaller
        options = runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        session = runtime.InferenceSession(str(file), options, providers=[provider])

    def run(x: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {"image": x.cpu().numpy()})[0]).to(x.device)

    return run


@contextlib.contextmanager
def _untraced() -> Any:
    """Compiled code of one row does not count against the limits of the next."""
    torch.compiler.reset()
    try:
        yield
    finally:
        torch.compiler.reset()
