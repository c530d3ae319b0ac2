# SPDX-License-Identifier: Apache-2.0
"""No tensor is left on the wrong device when networks run on a GPU, checked on a pretended one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from depth_frames import frame_of
from killed_training import tiny_backbone
from pretend_cuda import MixedDevicesError, pretend_cuda
from training_places import make_place

from slamdepth.depth.head import HeadEnsemble, HeadShape
from slamdepth.depth.mirrored import MirroredDepth
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.registry import create_depth_model
from slamdepth.training import gravity_direction, loop, out_of_fold
from slamdepth.training.config import TrainConfig
from slamdepth.types import Camera, Frame

SHAPE = HeadShape(
    taps=(0, 1), token_dim=24, dim=16, guide_dim=8, members=2, uncertainty_dim=8, scale_dim=4, input_px=5000,
    gravity=True, gravity_dim=8,
)  # fmt: skip


def corridor() -> Frame:
    """Straight lines to three vanishing points, the camera rolled."""
    image = np.full((240, 320, 3), 128, dtype=np.uint8)
    for k in range(0, 320, 20):
        cv2.line(image, (k, 0), (k + 60, 240), (20, 30, 40), 2)
        cv2.line(image, (0, k), (320, k - 80), (220, 210, 240), 2)
        cv2.line(image, (170, 110), (k, 239), (90, 30, 160), 2)
    return Frame(0, 0.0, image, Camera(320, 240, 260.0, 260.0, 159.5, 119.5))


def test_an_operation_on_both_devices_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pretend_cuda(monkeypatch):
        layer = torch.nn.Linear(3, 2).to("cuda")
        assert layer(torch.ones(1, 3).to("cuda")).cpu().shape == (1, 2)
        with pytest.raises(MixedDevicesError, match="linear"):
            layer(torch.ones(1, 3))
        with pytest.raises(TypeError, match="CUDA"):
            layer(torch.ones(1, 3, device="cuda")).detach().numpy()
    assert not layer(torch.ones(1, 3, device="meta")).is_cpu


def test_the_default_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines, gravity, the rotated image and uncertainty; with gravity given; and the mirror image."""
    with pretend_cuda(monkeypatch):
        model = Dinov2Depth(tiny_backbone(), HeadEnsemble(SHAPE).eval(), (), "cuda")
        frame = corridor()
        found = model.predict(frame)
        assert found.gravity is not None
        with_gravity = replace(frame, gravity=np.array([0.6, 0.8, 0.0]))
        for one in (model, MirroredDepth(model)):
            assert one.predict(with_gravity).values.shape == (240, 320)


@pytest.mark.parametrize("family", ["relative", "zoedepth", "depth_pro"])
def test_models_of_the_hub(family: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="needs pip install 'slamdepth[hub]'")
    from hub_folders import save_tiny

    save_tiny(tmp_path, family)
    with pretend_cuda(monkeypatch):
        model = create_depth_model(f"hf:{tmp_path}", device="cuda")
        assert model.predict(frame_of()).values.shape == (48, 64)


def test_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """All that ``train-depth`` trains: heads, gravity, and uncertainty on places left out."""
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(gravity_direction, "STEPS", 2)
    monkeypatch.setattr(out_of_fold, "_STEPS", 2)
    data = tmp_path / "data"
    for count, name in enumerate(("hall", "loft", "shop"), start=3):
        make_place(data / name, count)
        (data / name / "gravity.txt").write_text("".join(f"{k:05d} 0.6 0.8 0.0\n" for k in range(count)))
    hall, loft = (
        {"folder": str(data), "places": [{"name": name, "samples": 12}]} for name in ("hall", "loft")
    )
    config = TrainConfig.from_dict(
        {
            "output": str(tmp_path / "head.safetensors"),
            "uncertainty": "out_of_fold",
            "coarse_epochs": 1,
            "fine_epochs": 1,
            "members": 2,
            "batch": 4,
            "sources": [
                {**hall, "held_out": ["shop"]},
                {**loft, "supervision": "shape"},
                {**hall, "augment": {"mixed": 1.0}, "supervision": "scale"},
                {**loft, "augment": {"rolled": 1.0, "max_roll_deg": 180.0}, "supervision": "gravity"},
            ],
            "view": {"rows": 42, "columns": 56, "upright": True},
            "head": {
                "taps": [0, 1],
                "dim": 16,
                "guide_dim": 8,
                "scale_dim": 4,
                "gravity": True,
                "gravity_dim": 8,
            },
        }
    )
    with pretend_cuda(monkeypatch):
        loop.train_depth(config, backbone=tiny_backbone().to("cuda"), device="cuda")
