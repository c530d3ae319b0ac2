# SPDX-License-Identifier: Apache-2.0
"""The fully connected head, ONNX files, and depth models of other packages."""

from __future__ import annotations

import json
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from depth_checkpoint_files import frame_of
from safetensors.torch import save_file
from torch.nn import functional as F

from slamdepth.depth import dinov2_mlp, onnx_model
from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.dinov2_mlp import Dinov2Mlp, MlpHead, load_mlp, model_card, save_mlp, token_features
from slamdepth.depth.registry import create_depth_model, depth_model_names
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.types import Camera, DepthKind, Frame

FEATURES, HIDDEN = 257 * 6, 8


# --- dinov2-mlp ---------------------------------------------------------------------------


@pytest.mark.parametrize("side", [224, 32])
def test_mlp_is_the_dissertation_s(side: int) -> None:
    with torch.device("meta"):
        head = MlpHead(side)
    assert {name: tuple(v.shape) for name, v in head.state_dict().items()} == {
        "scaler.minimum": (257 * 384,),
        "scaler.maximum": (257 * 384,),
        "layers.0.weight": (1024, 257 * 384),
        "layers.0.bias": (1024,),
        "layers.1.weight": (1024, 1024),
        "layers.1.bias": (1024,),
        "layers.2.weight": (side * side, 1024),
        "layers.2.bias": (side * side,),
    }
    parameters = sum(v.numel() for v in head.parameters())
    assert parameters == 257 * 384 * 1024 + 1024 + 1024 * 1024 + 1024 + side * side * 1025
    assert head(torch.zeros(2, 257 * 384, device="meta")).shape == (2, side, side)


def test_mlp_computes_what_it_says() -> None:
    torch.manual_seed(0)
    head = MlpHead(2, features=5, hidden=3)
    seen = torch.rand(7, 5) * 4 - 2
    seen[:, 1] = 0.5  # a feature that never varied
    head.fit_scaler(seen)
    scaled = head.scaler(seen)
    torch.testing.assert_close(scaled.amax(0), torch.tensor([1.0, 0, 1, 1, 1]))
    torch.testing.assert_close(scaled.amin(0), torch.zeros(5))
    x = scaled
    for index in range(3):
        layer = head.layers[index]
        x = F.softplus(x @ layer.weight.T + layer.bias)  # type: ignore[operator, union-attr]
    torch.testing.assert_close(head(seen), x.view(7, 2, 2))
    assert (head(-100 * seen) >= 0).all()


def test_tokens_are_the_class_token_and_then_the_patches_row_by_row() -> None:
    torch.manual_seed(0)
    backbone = DinoV2(dim=6, depth=2, heads=3, grid=5).eval()
    image = torch.randn(1, 3, 224, 224)
    features = token_features(backbone, image)
    assert features.shape == (1, FEATURES)
    ((grid, token),) = backbone(image, (1,))
    torch.testing.assert_close(features[0, :6], token[0])
    torch.testing.assert_close(features[0, 6 * (1 + 16 * 3 + 2) :][:6], grid[0, :, 3, 2])


@pytest.mark.parametrize("side", [224, 32])
def test_mlp_round_trip_and_prediction(side: int, tmp_path: Path) -> None:
    torch.manual_seed(0)
    path = tmp_path / f"dinov2_mlp_{side}.safetensors"
    about = {"trained_on": "nothing", "licence": "Apache-2.0", "focal_px": "224.0"}
    head = MlpHead(side, FEATURES, HIDDEN)
    save_mlp(path, head, about)
    loaded, header = load_mlp(path, features=FEATURES, hidden=HIDDEN)
    assert loaded.output == side
    assert not loaded.training
    for name, value in head.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value.half().float())
    backbone = DinoV2(dim=6, depth=2, heads=3, grid=5).eval()
    model = Dinov2Mlp(backbone, loaded, model_card(header), ())
    assert isinstance(model, DepthModel)
    assert (model.kind, model.card.native_size) == (DepthKind.METRIC, (224, 224))
    assert (model.card.trained_on, model.card.licence) == ("nothing", "Apache-2.0")
    values = model.predict(frame_of()).values
    assert values.shape == (48, 64)
    assert (values > 0).all()
    np.testing.assert_allclose(model.predict(frame_of(focal=120.0)).values, 2 * values, rtol=1e-5)


def test_mlp_files_are_strict(tmp_path: Path) -> None:
    path = tmp_path / "head.safetensors"
    head = MlpHead(32, FEATURES, HIDDEN)
    save_file(head.state_dict(), str(path))
    with pytest.raises(WeightsError, match=r"not a dinov2-mlp head of this package \(format None\)"):
        create_depth_model("dinov2-mlp", weights=path)
    save_mlp(path, head, {})
    with pytest.raises(WeightsError, match=r"misshapen \(first: scaler.minimum is \(1542,\), not \(98688,\)"):
        create_depth_model("dinov2-mlp", weights=path)
    save_mlp(path, MlpHead(16, FEATURES, HIDDEN), {})
    with pytest.raises(WeightsError, match=r"layers\.2\.weight is \(256, 8\), not \(50176, 8\)"):
        load_mlp(path, features=FEATURES, hidden=HIDDEN)
    save_mlp(path, head, {"focal_px": "wide"})
    with pytest.raises(WeightsError, match="focal_px 'wide' is no positive number"):
        load_mlp(path, features=FEATURES, hidden=HIDDEN)
    assert dinov2_mlp.FILES == ("dinov2_mlp_224.safetensors", "dinov2_mlp_32.safetensors")


# --- onnx:FILE ----------------------------------------------------------------------------


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
    """A session of a graph that gives the mean of the channels, so that no runtime is needed."""

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


def test_onnx_that_does_not_run_is_one_line() -> None:
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
def test_what_onnx_says_of_itself_is_checked(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    with pytest.raises(WeightsError, match=rf"net\.onnx, metadata 'slamdepth': {says}") as error:
        onnx_model._about(tmp_path / "net.onnx", {"slamdepth": json.dumps({**METRIC, **change})})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "shape", [[2, 3, 28, 28], [0, 3, 28, 28], [1, 4, 28, 28], [1, 3, 28], [3], [2, 3, "h", "w"]]
)
def test_onnx_takes_one_image(shape: list[Any]) -> None:
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


def test_onnx_must_say_what_it_means(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed (extra 'onnx')")
    path = tmp_path / "net.onnx"
    beside = tmp_path / "net.onnx.json"

    def refused(match: str) -> None:
        with pytest.raises(WeightsError, match=match) as error:
            create_depth_model(f"onnx:{path}")
        assert "\n" not in str(error.value)

    write_onnx(path, None, (28, 42))
    refused(r'does not say what its values mean; write .*net\.onnx\.json with at least \{"kind": K\}')
    beside.write_text('{"kind": "depth"}', encoding="utf-8")
    refused(r"net\.onnx\.json: kind: ")
    beside.write_text("{", encoding="utf-8")
    refused("not readable as JSON")
    beside.write_text('{"kind": "affine depth"}', encoding="utf-8")
    assert create_depth_model(f"onnx:{path}").kind is DepthKind.AFFINE_DEPTH
    write_onnx(path, None, ("h", "w"))
    refused("leaves its input size open")
    path.write_bytes(b"no graph")
    refused("not a readable ONNX file")


# --- models of other packages -------------------------------------------------------------


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
    wanted |= {"dinov2", "dinov2-mlp", "dinov2-linear", "dinov2-dpt", "onnx:FILE", "sensor"}
    assert wanted <= set(depth_model_names())
    with pytest.raises(ConfigError, match="'sensor' takes no weights file"):
        create_depth_model("sensor", weights="x.pth")
