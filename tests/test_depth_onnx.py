# SPDX-License-Identifier: Apache-2.0
"""Depth networks in ONNX files."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from depth_frames import frame_of

from slamdepth.depth import onnx_model
from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import ModelCard
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.types import Camera, DepthKind, Frame


def write_onnx(path: Path, about: dict[str, Any] | None, size: tuple[int | str, int | str]) -> None:
    """A network whose map is the mean of the three channels, at half the resolution."""
    import onnx
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, *size])
    out = helper.make_tensor_value_info("map", TensorProto.FLOAT, [1, 1, None, None])
    nodes = [
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("ReduceMean", ["pooled"], ["map"], axes=[1], keepdims=1),
    ]
    graph = helper.make_graph(nodes, "mean", [image], [out])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if about is not None:
        helper.set_model_props(model, {onnx_model.METADATA_KEY: json.dumps(about)})
    onnx.save(model, str(path))


METRIC = {"kind": "metric depth", "mean": [0, 0, 0], "std": [1, 1, 1], "licence": "MIT"}


def test_onnx_without_the_runtime_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "net.onnx"
    write_onnx(path, METRIC, (28, 42))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"pip install 'slamdepth\[onnx\]'"):
        create_depth_model(f"onnx:{path}")
    with pytest.raises(WeightsError, match="no such ONNX file"):
        create_depth_model(f"onnx:{tmp_path / 'absent.onnx'}")
    with pytest.raises(ConfigError, match="names its file already"):
        create_depth_model(f"onnx:{path}", weights=path)


class StandIn:
    """A session of a graph that gives the mean of the channels, without ONNX Runtime."""

    def get_inputs(self) -> list[Any]:
        return [SimpleNamespace(name="image", shape=[1, 3, "h", "w"], type="tensor(float)")]

    def get_outputs(self) -> list[Any]:
        return [SimpleNamespace(name="map")]

    def run(self, names: list[str], feed: dict[str, Any]) -> list[Any]:
        self.fed = feed["image"]
        return [self.fed.mean(axis=1)]


def test_onnx_input_and_output() -> None:
    about = onnx_model.OnnxAbout(kind=DepthKind.METRIC, focal_px=15.0, mean=(0, 0, 0), std=(1, 1, 2))
    card = ModelCard("onnx:x", about.kind, (28, 28), about.focal_px, "", "")
    session = StandIn()
    model = onnx_model.OnnxDepth(session, about, card, (), is_fixed=False)
    image = np.full((30, 120, 3), 51, np.uint8)
    prediction = model.predict(Frame(0, 0.0, image, Camera(120, 30, 60.0, 60.0, 60, 15)))
    assert session.fed.shape == (1, 3, 14, 56)
    np.testing.assert_allclose(session.fed[0, :, 5, 5], [0.2, 0.2, 0.1], rtol=1e-5)
    focal = 60 * np.sqrt(14 / 30 * 56 / 120)
    np.testing.assert_allclose(prediction.values, np.full((30, 120), 0.5 / 3 * focal / 15), rtol=1e-5)
    session.run = lambda names, feed: [np.zeros((1, 2, 14, 56))]  # type: ignore[method-assign]
    with pytest.raises(WeightsError, match=r"the first output is \(1, 2, 14, 56\), not one map"):
        model.predict(frame_of())


def test_a_graph_that_does_not_run_is_one_line() -> None:
    about = onnx_model.OnnxAbout(kind=DepthKind.METRIC)
    session = StandIn()

    def run(names: list[str], feed: dict[str, Any]) -> list[Any]:
        raise RuntimeError("INVALID_ARGUMENT : Got invalid dimensions\nindex: 0 Got: 1 Expected: 2")

    session.run = run  # type: ignore[method-assign]
    card = ModelCard("onnx:x", about.kind, (28, 28), None, "", "")
    model = onnx_model.OnnxDepth(session, about, card, ())
    says = r"onnx:x: does not run on an image \(1, 3, 28, 28\): INVALID_ARGUMENT : Got invalid dimensions$"
    with pytest.raises(WeightsError, match=says):
        model.predict(frame_of())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"input_size": [-112, 112]}, "input_size.0: Input should be greater than or equal to 1"),
        ({"input_size": [0, 112]}, "input_size.0: "),
        ({"input_size": [112]}, "input_size.1: "),
        ({"input_size": [112, 10**9]}, "input_size.1: "),
        ({"multiple": 0}, "multiple: "),
        ({"std": [0, 0, 0]}, "std.0: Input should be greater than 0"),
        ({"std": [1, 1, -1]}, "std.2: "),
        ({"mean": [float("nan"), 0, 0]}, "mean.0: Input should be a finite number"),
        ({"focal_px": float("inf")}, "focal_px: "),
    ],
)
def test_metadata_is_checked(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    with pytest.raises(WeightsError, match=rf"net\.onnx, metadata 'slamdepth': {says}") as error:
        onnx_model._about(tmp_path / "net.onnx", {"slamdepth": json.dumps({**METRIC, **change})})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "shape", [[2, 3, 28, 28], [0, 3, 28, 28], [1, 4, 28, 28], [1, 3, 28], [3], [2, 3, "h", "w"]]
)
def test_the_graph_must_take_one_image(shape: list[Any]) -> None:
    session, about = StandIn(), onnx_model.OnnxAbout(kind=DepthKind.METRIC, input_size=(28, 28))
    one = SimpleNamespace(name="image", shape=shape, type="tensor(float)")
    session.get_inputs = lambda: [one]  # type: ignore[method-assign]
    with pytest.raises(WeightsError, match="not one image"):
        onnx_model._input_size(Path("net.onnx"), session, about)
    one.shape = ["batch", 3, 28, 28]
    assert onnx_model._input_size(Path("net.onnx"), session, about) == ((28, 28), True)
    one.shape = [None, None, None, "w"]
    assert onnx_model._input_size(Path("net.onnx"), session, about) == ((28, 28), False)


def test_onnx_of_a_fixed_size(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed (extra 'onnx')")
    path = tmp_path / "net.onnx"
    write_onnx(path, {**METRIC, "focal_px": 30.0}, (24, 32))
    model = create_depth_model(f"onnx:{path}")
    assert isinstance(model, DepthModel)
    assert isinstance(model, onnx_model.OnnxDepth)
    assert (model.name, model.kind) == (f"onnx:{path}", DepthKind.METRIC)
    assert (model.card.native_size, model.card.native_focal_px) == ((24, 32), 30.0)
    assert (model.weights[0].licence, len(model.weights[0].sha256)) == ("MIT", 64)
    image = np.full((48, 64, 3), 51, np.uint8)
    frame = Frame(0, 0.0, image, Camera(64, 48, 60.0, 60.0, 32, 24))
    prediction = model.predict(frame)
    assert prediction.values.shape == (48, 64)
    np.testing.assert_allclose(prediction.values, 0.2, rtol=1e-5)  # 60 px at half the size: as trained


def test_onnx_of_an_open_size_keeps_the_aspect(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed (extra 'onnx')")
    path = tmp_path / "net.onnx"
    about = {"kind": "affine inverse depth", "input_size": [28, 28], "multiple": 14}
    write_onnx(path, about, ("h", "w"))
    model = create_depth_model(f"onnx:{path}")
    assert isinstance(model, onnx_model.OnnxDepth)
    assert model.kind is DepthKind.AFFINE_INVERSE_DEPTH
    values, size = model.infer(frame_of(120, 30).image_rgb)
    assert values.shape == (30, 120)
    assert size == (14, 56)


def test_a_file_must_say_what_its_values_mean(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed (extra 'onnx')")
    path = tmp_path / "net.onnx"
    sidecar = tmp_path / "net.onnx.json"

    def refused(match: str) -> None:
        with pytest.raises(WeightsError, match=match) as error:
            create_depth_model(f"onnx:{path}")
        assert "\n" not in str(error.value)

    write_onnx(path, None, (28, 42))
    refused(r'does not say what its values mean; write .*net\.onnx\.json with at least \{"kind": K\}')
    sidecar.write_text('{"kind": "depth"}', encoding="utf-8")
    refused(r"net\.onnx\.json: kind: ")
    sidecar.write_text("{", encoding="utf-8")
    refused("not readable as JSON")
    sidecar.write_text('{"kind": "affine depth"}', encoding="utf-8")
    assert create_depth_model(f"onnx:{path}").kind is DepthKind.AFFINE_DEPTH
    write_onnx(path, None, ("h", "w"))
    refused("leaves its input size open")
    path.write_bytes(b"no graph")
    refused("not a readable ONNX file")
