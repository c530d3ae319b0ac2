# SPDX-License-Identifier: Apache-2.0
"""Depth models of other packages, and the names of all."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import create_depth_model, depth_model_names
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind, Frame


class PluginDepth:
    """Stands for a class in another package."""

    name, kind, weights = "plug", DepthKind.AFFINE_DEPTH, ()

    def __init__(self, *, device: str, seed: int) -> None:
        self.seed = seed

    def predict(self, frame: Frame) -> None: ...


def broken(*, device: str, seed: int) -> str:
    return "no model"


NOT_CALLABLE = 3


def plug_in(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    group = "slamdepth.depth_models"
    found = EntryPoints(EntryPoint(name, value, group) for name, value in points)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: found.select(group=group))


def test_plug_ins(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    here = __name__
    plug_in(
        monkeypatch,
        ("plug", f"{here}:PluginDepth"),
        ("dinov2", f"{here}:PluginDepth"),
        ("broken", f"{here}:broken"),
        ("number", f"{here}:NOT_CALLABLE"),
        ("gone", "no_such_package:Model"),
        ("twice", "a:A"),
        ("twice", "b:B"),
    )
    model = create_depth_model("plug", seed=7)
    assert isinstance(model, DepthModel)
    assert model.seed == 7  # type: ignore[attr-defined]
    assert "plug" in depth_model_names()
    assert "'dinov2' of" in caplog.text
    for name, match in (
        ("broken", "makes no depth model"),
        ("number", "is no factory"),
        ("gone", "no_such_package:Model cannot be loaded"),
        ("twice", "two plug-ins add depth model 'twice': a:A, b:B"),
    ):
        with pytest.raises(ConfigError, match=match):
            create_depth_model(name)
    with pytest.raises(ConfigError, match="'plug' takes no weights file"):
        create_depth_model("plug", weights=Path("x"))


def test_names() -> None:
    sizes = ("small", "base", "large")
    wanted = {f"depth-anything-v2-{s}{m}" for s in sizes for m in ("", "-metric-indoor", "-metric-outdoor")}
    wanted |= {"auto", "dinov2", "dinov2-mlp", "dinov2-dpt", "hf:ORG/NAME", "onnx:FILE", "sensor"}
    assert wanted <= set(depth_model_names())
    with pytest.raises(ConfigError, match="'sensor' takes no weights file"):
        create_depth_model("sensor", weights="x.pth")
