# SPDX-License-Identifier: Apache-2.0
"""Time of a depth prediction by stage: before the ViT, the ViT, after it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from benchmarks.markdown import markdown_table
from slamdepth.datasets import open_dataset
from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.dinov2_mlp import SIDE, Dinov2Mlp, MlpHead, model_card
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

RANDOM_MLP = {"dinov2-mlp-224": 224, "dinov2-mlp-32": 32}
"""The dissertation's network at both sizes, with random weights, which do not change its time."""

STAGES = ("resize_ms", "vit_ms", "head_ms", "together_ms", "cpu_ms")
_HEADINGS = ("model", "device", "threads", "frame", "resize", "ViT", "head", "together", "CPU time")


def latency_row(
    name: str, device: str, frames: Sequence[Frame], repeats: int, warm_up: int
) -> dict[str, Any]:
    """Milliseconds of each stage of a model with the current number of threads, or the error.

    ``figures`` holds medians, ``spread`` the quartiles.
    """
    size = f"{frames[0].camera.height}x{frames[0].camera.width}"
    about = {"model": name, "device": device, "threads": torch.get_num_threads(), "frame": size}
    try:
        times = stage_times(_model(name, device), frames, device, repeats, warm_up)
    except SlamdepthError as error:
        return {**about, "error": str(error)}
    quartiles = np.percentile(times, (25, 50, 75), axis=0)
    return {
        **about,
        "figures": dict(zip(STAGES, quartiles[1].tolist(), strict=True)),
        "spread": dict(zip(STAGES, quartiles[[0, 2]].T.tolist(), strict=True)),
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
        lines.append([*about, *(f"{row['figures'][key]:.1f} ±{halves[key]:.1f}" for key in STAGES)])
    return markdown_table(_HEADINGS, lines)


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
        return create_depth_model(name, device=device)
    torch.manual_seed(0)
    head = MlpHead(RANDOM_MLP[name]).eval().requires_grad_(False)
    card = model_card({"focal_px": str(float(SIDE))})
    return Dinov2Mlp(load_dinov2(store.find_backbone(None), device), head, card, (), device)
