# SPDX-License-Identifier: Apache-2.0
"""Time of a depth prediction by stage: before the ViT, the ViT, after it.

``NAME:PRECISION`` and ``NAME:PRECISION:PIXELS`` stand for a model in a precision and with an input of so many
pixels, such as ``dinov2:int8:32340``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import torch
from torch import nn

from benchmarks.markdown import markdown_table
from slamdepth.config import Precision
from slamdepth.datasets import open_dataset
from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.dinov2_mlp import SIDE, Dinov2Mlp, MlpHead, model_card
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats, Floats32

RANDOM_MLP = {"dinov2-mlp-224": 224, "dinov2-mlp-32": 32}
"""The dissertation's network at both sizes, with random weights, which do not change its time."""

STAGES = ("resize_ms", "vit_ms", "head_ms", "together_ms", "cpu_ms")
_HEADINGS = (
    "model",
    "device",
    "threads",
    "frame",
    "resize",
    "ViT",
    "head",
    "together",
    "CPU time",
    "differs",
)
_COMPARED = 20
"""Frames, at most, whose depth is compared with that of the first model."""
_UPRIGHT = np.array([0.0, np.cos(np.radians(10.0)), np.sin(np.radians(10.0))])
"""Gravity in a camera that is held upright and looks a little down."""


def latency_row(
    name: str,
    device: str,
    frames: Sequence[Frame],
    repeats: int,
    warm_up: int,
    reference: Sequence[Floats32] | None = None,
) -> dict[str, Any]:
    """Milliseconds of each stage of a model with the current number of threads, or the error.

    ``figures`` holds medians, ``spread`` the quartiles, ``differs`` how far depth is from ``reference``: the
    mean over frames of the median of ``|log(depth / reference)|``, None without one.
    """
    size = f"{frames[0].camera.height}x{frames[0].camera.width}"
    about = {"model": name, "device": device, "threads": torch.get_num_threads(), "frame": size}
    try:
        model = _model(name, device)
        times = stage_times(model, frames, device, repeats, warm_up)
    except SlamdepthError as error:
        return {**about, "error": str(error)}
    quartiles = np.percentile(times, (25, 50, 75), axis=0)
    return {
        **about,
        "figures": dict(zip(STAGES, quartiles[1].tolist(), strict=True)),
        "spread": dict(zip(STAGES, quartiles[[0, 2]].T.tolist(), strict=True)),
        "differs": None if reference is None else _difference(depth_of(model, frames), reference),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as Markdown, in milliseconds; ± is half of the distance between the quartiles."""
    lines = []
    for row in rows:
        about = [row["model"], row["device"], str(row["threads"]), row["frame"]]
        if "error" in row:
            lines.append([*about, row["error"]])
            continue
        halves = {key: (high - low) / 2 for key, (low, high) in row["spread"].items()}
        differs = "-" if row["differs"] is None else f"{row['differs']:.4f}"
        lines.append([*about, *(f"{row['figures'][key]:.1f} ±{halves[key]:.1f}" for key in STAGES), differs])
    return markdown_table(_HEADINGS, lines)


def depth_of(model: DepthModel, frames: Sequence[Frame]) -> list[Floats32]:
    """Depth ``(H, W)`` of at most 20 of ``frames``, spread evenly."""
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), _COMPARED)).round().astype(int)
    return [model.predict(frames[index]).values for index in chosen.tolist()]


def _difference(depths: Sequence[Floats32], reference: Sequence[Floats32]) -> float:
    pairs = zip(depths, reference, strict=True)
    return float(np.mean([np.median(np.abs(np.log(one / other))) for one, other in pairs]))


def upright(frame: Frame) -> Frame:
    """``frame`` with the gravity of a camera that is held upright, so that one pass of the ViT is enough."""
    return replace(frame, gravity=_UPRIGHT)


def reference_depth(name: str, device: str, frames: Sequence[Frame]) -> list[Floats32] | None:
    """Depth by the model ``name``; None where it cannot be had."""
    try:
        return depth_of(_model(name, device), frames)
    except SlamdepthError:
        return None


def stage_times(
    model: DepthModel, frames: Sequence[Frame], device: str, repeats: int, warm_up: int
) -> Floats:
    """Milliseconds of ``repeats`` predictions after ``warm_up`` others, ``(repeats, 5)`` as :data:`STAGES`.

    ``resize`` is everything before the ViT (resizing, normalising, moving to the device), ``head``
    everything after it (head, enlarging to the frame, moving back), ``cpu`` the processor time of all
    threads for the whole. If a model runs the ViT more than once for an image, these times are added up, and
    the time in between counts as ``head``.

    Args:
        frames: predicted in turn.

    Raises:
        ConfigError: the model has no DINOv2 inside.
    """
    vit = vit_of(model)
    marks: list[float] = []

    def mark(*_: Any) -> None:
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        marks.append(time.perf_counter())

    hooks = [vit.register_forward_pre_hook(mark), vit.register_forward_hook(mark)]
    rows = []
    try:
        for repeat in range(warm_up + repeats):
            marks.clear()
            cpu_s = time.process_time()
            mark()
            model.predict(frames[repeat % len(frames)])
            mark()
            if repeat >= warm_up:
                vit_s = sum(after - before for before, after in zip(marks[1:-1:2], marks[2::2], strict=True))
                before_s, whole_s = marks[1] - marks[0], marks[-1] - marks[0]
                rows.append(
                    [before_s, vit_s, whole_s - before_s - vit_s, whole_s, time.process_time() - cpu_s]
                )
    finally:
        for hook in hooks:
            hook.remove()
    return 1e3 * np.array(rows)


def vit_of(model: DepthModel) -> DinoV2:
    """The DINOv2 inside a model.

    Raises:
        ConfigError: the model has none.
    """
    for value in vars(model).values():
        if isinstance(value, DepthModel):
            return vit_of(value)
        if isinstance(value, nn.Module):
            for module in value.modules():
                if isinstance(module, DinoV2):
                    return module
    raise ConfigError(f"depth model '{model.name}' has no DINOv2 inside, so it has no such stages")


def noise_frame(size: str) -> Frame:
    """A frame of noise of ``size`` ROWSxCOLUMNS.

    Raises:
        ConfigError: ``size`` is no such size.
    """
    try:
        rows, columns = (int(part) for part in size.split("x"))
        camera = Camera(columns, rows, 0.8 * columns, 0.8 * columns, (columns - 1) / 2, (rows - 1) / 2)
    except (ValueError, SlamdepthError) as error:
        raise ConfigError(f"--frame {size}: a size is ROWSxCOLUMNS, as 480x640") from error
    image = np.random.default_rng(0).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    return Frame(0, 0.0, image, camera)


def frames_of(sequence: Path, count: int) -> list[Frame]:
    """``count`` frames spread evenly over a sequence, without depth.

    Raises:
        DatasetError: the folder is no sequence, or a frame cannot be read.
    """
    dataset = open_dataset(sequence)
    indices = np.linspace(0, len(dataset) - 1, min(count, len(dataset))).round().astype(int)
    return [dataset.read(index) for index in indices.tolist()]


def _model(name: str, device: str) -> DepthModel:
    if name not in RANDOM_MLP:
        name, _, form = name.partition(":") if name.startswith("dinov2:") else (name, "", "")
        precision, _, pixels = form.partition(":")
        if precision and precision not in get_args(Precision):
            raise ConfigError(f"'{precision}' is none of {', '.join(get_args(Precision))}")
        if pixels and not pixels.isdecimal():
            raise ConfigError(f"'{pixels}' is no number of pixels")
        return create_depth_model(
            name,
            device=device,
            precision=cast(Precision, precision or "auto"),
            input_px=int(pixels) if pixels else None,
        )
    torch.manual_seed(0)
    head = MlpHead(RANDOM_MLP[name]).eval().requires_grad_(False)
    card = model_card({"focal_px": str(float(SIDE))})
    return Dinov2Mlp(load_dinov2(store.find_backbone(None), device), head, card, (), device)
