# SPDX-License-Identifier: Apache-2.0
"""A depth model's ``predict`` cut at its ViT: what is before, the ViT, what is after."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import torch
from torch import nn

from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.dinov2_mlp import SIDE, Dinov2Mlp, MlpHead, model_card
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.types import Camera, Frame

RANDOM_MLP = {"dinov2-mlp-224": 224, "dinov2-mlp-32": 32}
"""The dissertation's network at both sizes; weights do not change its time."""


def stage_row(name: str, device: str, frame_size: str, repeats: int, warm_up: int) -> dict[str, Any]:
    """Median milliseconds of each stage of a model; ``failed`` says why there are none."""
    about = {"model": name, "device": device, "threads": torch.get_num_threads(), "frame": frame_size}
    try:
        model = _model(name, device)
        return {**about, **stage_times(model, frame_of(frame_size), device, repeats, warm_up)}
    except SlamdepthError as error:
        return {**about, "failed": str(error)}


def stage_times(model: DepthModel, frame: Frame, device: str, repeats: int, warm_up: int) -> dict[str, float]:
    """Medians over ``repeats`` predictions in milliseconds, after ``warm_up`` others.

    ``resize_ms`` is all before the ViT (resizing, normalising, moving to the device),
    ``head_ms`` all after it (head, enlarging to the frame, moving back), ``cpu_ms`` the
    processor time of all threads for the whole. Where an image is seen more than once, the ViT's
    times are added up, and what lies between them counts as after it.

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
            model.predict(frame)
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
    names = ("resize_ms", "vit_ms", "head_ms", "together_ms", "cpu_ms")
    columns = zip(*rows, strict=True)
    return {name: 1e3 * statistics.median(column) for name, column in zip(names, columns, strict=True)}


def vit_of(model: DepthModel) -> DinoV2:
    """The DINOv2 a model holds.

    Raises:
        ConfigError: it has none, so there is nothing to cut.
    """
    for value in vars(model).values():
        if isinstance(value, DepthModel):
            return vit_of(value)
        if isinstance(value, nn.Module):
            for module in value.modules():
                if isinstance(module, DinoV2):
                    return module
    raise ConfigError(f"depth model '{model.name}' has no DINOv2 inside, so it has no such stages")


def frame_of(size: str) -> Frame:
    """A frame of noise; ``size`` is ROWSxCOLUMNS.

    Raises:
        ConfigError: ``size`` is none.
    """
    try:
        rows, columns = (int(part) for part in size.split("x"))
        camera = Camera(columns, rows, 0.8 * columns, 0.8 * columns, (columns - 1) / 2, (rows - 1) / 2)
    except (ValueError, SlamdepthError) as error:
        raise ConfigError(f"--frame {size}: a size is ROWSxCOLUMNS, as 480x640") from error
    image = np.random.default_rng(0).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    return Frame(0, 0.0, image, camera)


def _model(name: str, device: str) -> DepthModel:
    if name not in RANDOM_MLP:
        return create_depth_model(name, device=device)
    torch.manual_seed(0)
    head = MlpHead(RANDOM_MLP[name]).eval().requires_grad_(False)
    card = model_card({"focal_px": str(float(SIDE))})
    return Dinov2Mlp(load_dinov2(store.find_backbone(None), device), head, card, (), device)
