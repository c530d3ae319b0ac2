# SPDX-License-Identifier: Apache-2.0
"""Depth models by name, and what they promise."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sequences import imread

from slamdepth.depth import registry
from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import ModelCard, card_of
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.evaluate import judge_depth
from slamdepth.depth.head import HeadEnsemble, HeadShape
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.registry import create_depth_model, depth_model_names
from slamdepth.depth.wide_view import middle_view
from slamdepth.errors import CameraError, ConfigError, DatasetError, WeightsError
from slamdepth.report.depth import model_lines
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo


def frame_of(width: int = 64, height: int = 48, *, focal: float = 60.0, depth: bool = True) -> Frame:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    depth_m = rng.uniform(1, 3, (height, width)).astype(np.float32) if depth else None
    return Frame(3, 0.1, image, camera, depth_m)


def tiny_model() -> Dinov2Depth:
    torch.manual_seed(0)
    backbone = DinoV2(dim=24, depth=2, heads=3, grid=5).eval().requires_grad_(False)
    head = HeadEnsemble(HeadShape((0, 1), 24, 16, 1, 8)).eval().requires_grad_(False)
    return Dinov2Depth(backbone, head, ())


def test_names_and_unknown_name() -> None:
    assert {"dinov2", "sensor"} <= set(depth_model_names())
    with pytest.raises(ConfigError, match=r"unknown depth model 'midas'; choose from: auto, dinov2.*sensor"):
        create_depth_model("midas")


def test_sensor_passes_depth_through() -> None:
    model = create_depth_model("sensor")
    assert isinstance(model, DepthModel)
    frame = frame_of()
    assert frame.depth_m is not None
    frame.depth_m[0, 0], frame.depth_m[0, 1], frame.depth_m[0, 2] = np.nan, -1.0, 0.0
    prediction = model.predict(frame)
    assert prediction.is_sensor
    assert prediction.kind is DepthKind.METRIC
    assert (prediction.values[0, :3] == 0).all()
    np.testing.assert_array_equal(prediction.values[1:], frame.depth_m[1:])
    assert prediction.sigma_log is not None
    # 1.4 mm at 1 m and 12.6 mm at 3 m, with a floor of 2 permille
    expected = np.hypot(0.0014 * prediction.values[1:], 0.002)
    np.testing.assert_allclose(prediction.sigma_log[1:], expected, rtol=1e-6)


def test_sensor_without_depth_says_what_to_do() -> None:
    with pytest.raises(DatasetError, match=r"frame 3 has no sensor depth; choose a predicted depth"):
        create_depth_model("sensor").predict(frame_of(depth=False))


@pytest.mark.parametrize(("width", "height"), [(64, 48), (48, 64), (100, 30), (161, 97)])
def test_prediction_is_at_the_resolution_of_the_frame(width: int, height: int) -> None:
    prediction = tiny_model().predict(frame_of(width, height))
    assert prediction.values.shape == (height, width)
    assert prediction.values.dtype == np.float32
    assert prediction.sigma_log is not None
    assert prediction.sigma_log.shape == (height, width)
    assert np.isfinite(prediction.values).all()
    assert (prediction.values > 0).all()
    assert (prediction.sigma_log > 0).all()


def test_prediction_is_deterministic_and_scales_with_the_focal_length() -> None:
    model = tiny_model()
    first, again = model.predict(frame_of()), model.predict(frame_of())
    np.testing.assert_array_equal(first.values, again.values)
    longer = model.predict(frame_of(focal=120.0))
    np.testing.assert_allclose(longer.values, 2 * first.values, rtol=1e-5)


def test_a_wide_view_has_the_scale_of_its_middle() -> None:
    model, wide = tiny_model(), frame_of(128, 96, focal=50.0)
    found = middle_view(wide)
    assert found is not None
    middle, at = found
    both = model.predict(wide).values[at] / model.predict(middle).values
    assert np.median(both) == pytest.approx(1.0, rel=1e-5)


def test_the_default_model_names_its_training_data() -> None:
    head = WeightsInfo("head", "ab", "six places", "free")
    model = Dinov2Depth(
        DinoV2(24, 2, 3, grid=5),
        HeadEnsemble(HeadShape((0, 1), 24, 16, 1, 8)),
        (WeightsInfo("vit", "cd", "the web", "free"), head),
        precision="float32",
    )
    assert model.card == ModelCard("dinov2", DepthKind.METRIC, (238, 322), 280.0, "free", "six places")
    assert card_of(create_depth_model("sensor")) is None
    assert model_lines(model) == [
        "dinov2: metric depth; trained at 238x322 pixels of focal length 280 px",
        "weights vit, sha256 cd; free; trained on the web; computes in float32",
        "weights head, sha256 ab; free; trained on six places",
    ]
    assert model_lines(create_depth_model("sensor")) == ["sensor: metric depth"]


def test_images_too_small_or_too_narrow_are_refused() -> None:
    with pytest.raises(CameraError, match="sides of at least"):
        tiny_model().predict(frame_of(20, 20))
    with pytest.raises(CameraError, match="aspect"):
        tiny_model().predict(frame_of(400, 30))


def test_missing_cuda_is_one_line() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device here")
    with pytest.raises(ConfigError, match="no CUDA device"):
        create_depth_model("dinov2", device="cuda")


@pytest.mark.parametrize(
    "device", ["gpu", "banana", "mps", "", "cuda:", "cuda:-1", "cuda:01", "CPU", "cuda0"]
)
@pytest.mark.parametrize("model", ["dinov2", "sensor", "mirrored:sensor", "onnx:absent.onnx", "dinov2-mlp"])
def test_an_unknown_device_is_one_line(model: str, device: str) -> None:
    with pytest.raises(ConfigError, match=f"^unknown device '{device}'; choose from: cpu, cuda, cuda:N"):
        create_depth_model(model, device=device)


def test_a_plug_in_gets_available_devices_only(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[str] = []

    def factory(*, device: str, seed: int) -> object:
        given.append(device)
        return create_depth_model("sensor")

    point = SimpleNamespace(value="elsewhere:make", load=lambda: factory)
    monkeypatch.setattr(registry.MODELS, "_plugins", lambda: {"elsewhere": [point]})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for device in ("cpu", "cuda", "cuda:1"):
        create_depth_model("elsewhere", device=device)
    with pytest.raises(ConfigError, match="'cuda:2': the last CUDA device is 'cuda:1'"):
        create_depth_model("elsewhere", device="cuda:2")
    with pytest.raises(ConfigError, match="unknown device 'gpu'"):
        create_depth_model("elsewhere", device="gpu")
    assert given == ["cpu", "cuda", "cuda:1"]


def test_missing_backbone_names_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path))
    with pytest.raises(WeightsError, match="slamdepth weights pull") as error:
        create_depth_model("dinov2")
    assert "\n" not in str(error.value)


class _Scaled:
    """Sensor depth times a factor, with a given sigma: an error that must be found exactly."""

    name = "scaled"
    kind = DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, factor: float, sigma: float) -> None:
        self.factor, self.sigma = factor, sigma

    def predict(self, frame: Frame) -> DepthPrediction:
        assert frame.depth_m is not None
        values = (frame.depth_m * self.factor).astype(np.float32)
        return DepthPrediction(values, self.kind, np.full_like(values, self.sigma))


def test_a_known_error_is_measured() -> None:
    watched: list[int] = []
    judged = judge_depth(
        _Scaled(1.1, 0.2),
        [frame_of(), frame_of(depth=False)],
        watch=lambda frame, prediction: watched.append(frame.index),
    )
    assert judged.frames == len(watched) == 1
    assert judged.ways["as_predicted"]["abs_rel"].value == pytest.approx(0.1, abs=1e-6)
    assert judged.ways["frame_median"]["abs_rel"].value == pytest.approx(0.0, abs=1e-6)
    assert judged.within_one_sigma is not None
    assert judged.within_one_sigma.value == 1.0
    wrong = judge_depth(_Scaled(1.1, 0.05), [frame_of()])
    assert wrong.within_one_sigma is not None
    assert wrong.within_one_sigma.value == 0.0


def test_evaluation_without_any_sensor_depth_is_an_error() -> None:
    with pytest.raises(DatasetError, match="no frame has sensor depth"):
        judge_depth(_Scaled(1.0, 0.1), [frame_of(depth=False)])


@pytest.mark.weights
@pytest.mark.data
def test_shipped_model_on_a_real_image(data_dir: Path) -> None:
    import cv2

    try:
        store.find_backbone()
    except WeightsError as error:
        pytest.skip(str(error))
    model = create_depth_model("dinov2")
    assert isinstance(model, DepthModel)
    assert [len(info.sha256) for info in model.weights] == [64, 64]
    assert "TUM" in model.weights[1].trained_on
    folder = data_dir / "7scenes_redkitchen_seq-01"
    image = imread(folder / "frame-000000.color.jpg")[:, :, ::-1].copy()
    depth = imread(folder / "frame-000000.depth.png", cv2.IMREAD_UNCHANGED)
    depth_m = np.where(depth < 60000, depth, 0).astype(np.float32) / np.float32(1000)
    frame = Frame(0, 0.0, image, Camera(640, 480, 585, 585, 320, 240), depth_m)
    judged = judge_depth(model, [frame])
    # zero-shot: the right order of magnitude and better than a constant
    assert judged.ways["as_predicted"]["abs_rel"].value < 0.5
    assert judged.ways["frame_median"]["delta1"].value > 0.35


def test_the_default_takes_a_head_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Path | None] = []

    def load(*, head: Path | None, device: str, precision: str, input_px: int | None) -> Dinov2Depth:
        asked.append(head)
        return tiny_model()

    monkeypatch.setattr(Dinov2Depth, "load", load)
    create_depth_model("dinov2")
    create_depth_model("dinov2", weights=tmp_path / "mine.safetensors")
    assert asked == [None, tmp_path / "mine.safetensors"]
