# SPDX-License-Identifier: Apache-2.0
"""The published checkpoints: their layouts key by key, strict loading, and what comes out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from depth_checkpoint_files import (
    conv,
    depth_anything_layout,
    frame_of,
    linear_layout,
    official_dpt_layout,
    random_tensors,
    write_random_files,
)
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from slamdepth.depth import depth_anything, dinov2_official
from slamdepth.depth.alignment import log_depth_at
from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.dinov2_heads import DptHead, LinearHead, OfficialHead
from slamdepth.depth.dpt import BASE, LARGE, SMALL, DepthAnything, DptShape
from slamdepth.depth.evaluate import judge_depth
from slamdepth.depth.metric import check_metric
from slamdepth.depth.registry import create_depth_model, depth_model_names
from slamdepth.errors import CameraError, ConfigError, TrackingError, WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

TINY = DptShape(24, 4, 3, (0, 1, 2, 3), 16, (4, 6, 8, 10), grid=5)


@pytest.fixture(scope="module")
def small_tensors() -> dict[str, Tensor]:
    return random_tensors(depth_anything_layout(384, 12, 64, (48, 96, 192, 384)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, small_tensors: dict[str, Tensor]) -> Path:
    """A cache folder with random files in the official layouts, under the official names."""
    folder = tmp_path_factory.mktemp("cache")
    write_random_files(folder, small_tensors)
    return folder


@pytest.fixture
def cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(folder))
    return folder


@pytest.mark.parametrize(
    ("shape", "million"), [(SMALL, 24.785), (BASE, 97.471), (LARGE, 335.316)], ids=["small", "base", "large"]
)
def test_depth_anything_has_the_official_tensors(shape: DptShape, million: float) -> None:
    official = depth_anything_layout(shape.dim, shape.depth, shape.features, shape.stages)
    if shape is SMALL:
        assert len(official) == 239
    assert sum(math.prod(s) for s in official.values()) / 1e6 == pytest.approx(million, abs=1e-3)
    with torch.device("meta"):
        ours = {name: tuple(v.shape) for name, v in DepthAnything(shape).state_dict().items()}
    assert official.pop("pretrained.mask_token") == (1, shape.dim)
    assert ours == official


def test_official_heads_have_the_official_tensors() -> None:
    with torch.device("meta"):
        heads = {
            "dpt": OfficialHead(DptHead(384, 10.0)),
            "linear": OfficialHead(LinearHead(384, 1, 10.0)),
            "linear4": OfficialHead(LinearHead(384, 4, 10.0)),
        }
    layouts = {"dpt": official_dpt_layout(), "linear": linear_layout(1), "linear4": linear_layout(4)}
    for name, head in heads.items():
        assert {key: tuple(v.shape) for key, v in head.state_dict().items()} == layouts[name]


@pytest.mark.parametrize(
    ("name", "size", "focal_px", "max_m"),
    [
        ("dinov2-linear", (480, 640), 518.86, 10.0),
        ("dinov2-dpt", (480, 640), 518.86, 10.0),
        ("dinov2-linear-kitti", (375, 1242), 721.54, 80.0),
    ],
)
def test_official_heads_say_what_they_are_and_predict(
    cache: Path, name: str, size: tuple[int, int], focal_px: float, max_m: float
) -> None:
    model = create_depth_model(name)
    assert isinstance(model, DepthModel)
    assert isinstance(model, dinov2_official.Dinov2OfficialDepth)
    assert (model.name, model.kind, model.card.native_size) == (name, DepthKind.METRIC, size)
    assert model.card.native_focal_px == pytest.approx(focal_px, abs=0.01)
    assert model.card.licence.startswith("Apache-2.0")
    assert [len(info.sha256) for info in model.weights] == [64, 64]
    # Small images instead of the native size, for time.
    model.card = replace(model.card, native_size=(60, 80), native_focal_px=75.0)
    prediction = model.predict(frame_of(focal=60.0))
    assert prediction.kind is DepthKind.METRIC
    assert prediction.values.shape == (48, 64)
    assert prediction.values.dtype == np.float32
    assert prediction.values.min() >= 0.001 * (1 - 1e-5)
    assert prediction.values.max() <= max_m
    assert np.ptp(prediction.values) > 0


def test_depth_anything_predicts(cache: Path) -> None:
    relative = create_depth_model("depth-anything-v2-small")
    metric = create_depth_model("depth-anything-v2-small-metric-indoor")
    assert isinstance(relative, depth_anything.DepthAnythingV2)
    assert isinstance(metric, depth_anything.DepthAnythingV2)
    assert (relative.kind, metric.kind) == (DepthKind.AFFINE_INVERSE_DEPTH, DepthKind.METRIC)
    assert relative.card.licence == metric.card.licence == "Apache-2.0"
    assert relative.weights[0].sha256 == sha256_of(cache / "depth_anything_v2_vits.pth")
    for model in (relative, metric):
        model.short_side = 70
        prediction = model.predict(frame_of())
        assert prediction.kind is model.kind
        assert prediction.values.shape == (48, 64)
        assert np.isfinite(prediction.values).all()
        assert (prediction.values >= 0).all()
    native = 64 / metric.card.native_size[1] * metric.card.native_focal_px  # type: ignore[operator]
    once = metric.predict(frame_of(focal=native)).values
    np.testing.assert_allclose(metric.predict(frame_of(focal=2 * native)).values, 2 * once, rtol=1e-5)
    np.testing.assert_array_equal(
        relative.predict(frame_of(focal=60)).values, relative.predict(frame_of(focal=120)).values
    )


def test_native_camera_changes_nothing() -> None:
    """Depth of the training camera itself is taken as the network gives it."""
    torch.manual_seed(0)
    card, _ = depth_anything.model_card("small", "indoor")
    model = depth_anything.DepthAnythingV2(DepthAnything(TINY, 20.0).eval(), card, ())
    hypersim = Camera(1024, 768, 886.81, 886.81, 511.5, 383.5)
    image = np.random.default_rng(0).integers(0, 256, (768, 1024, 3), dtype=np.uint8)
    values, size = model.infer(image)
    assert size == (518, 686) == card.native_size
    np.testing.assert_allclose(model.predict(Frame(0, 0.0, image, hypersim)).values, values, rtol=1e-6)
    assert values.min() > 0
    assert values.max() < 20.0
    with pytest.raises(CameraError, match="aspect"):
        model.predict(frame_of(400, 30))


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [(480, 640, (518, 686)), (640, 480, (686, 518)), (518, 518, (518, 518)), (375, 1242, (518, 1722))],
)
def test_official_input_size(height: int, width: int, expected: tuple[int, int]) -> None:
    assert depth_anything.network_size(height, width) == expected


@given(st.integers(28, 2000), st.integers(28, 2000))
def test_input_size_of_any_image(height: int, width: int) -> None:
    rows, columns = depth_anything.network_size(height, width)
    assert rows % 14 == columns % 14 == 0
    assert min(rows, columns) == 518
    assert abs(rows / height - columns / width) <= 7.01 / min(height, width)


def test_relative_is_never_taken_for_metric(cache: Path, tmp_path: Path) -> None:
    relative_file = cache / "depth_anything_v2_vits.pth"
    renamed = tmp_path / "model.pth"
    renamed.symlink_to(relative_file)
    for path in (relative_file, renamed):
        with pytest.raises(WeightsError, match=r"takes depth_anything_v2_metric_hypersim_vits\.pth"):
            create_depth_model("depth-anything-v2-small-metric-indoor", weights=path)
    metric_file = cache / "depth_anything_v2_metric_hypersim_vits.safetensors"
    with pytest.raises(WeightsError, match="named as a metric model"):
        create_depth_model("depth-anything-v2-small", weights=metric_file)
    with pytest.raises(WeightsError, match="does not say 'vkitti' metric"):
        create_depth_model("depth-anything-v2-small-metric-outdoor", weights=metric_file)

    model = create_depth_model("depth-anything-v2-small", weights=relative_file)
    with pytest.raises(ConfigError, match="predicts affine inverse depth; tracking needs metres"):
        check_metric(model)
    with_depth = replace(frame_of(), depth_m=np.full((48, 64), 2.0, np.float32))
    assert "as_predicted" not in judge_depth(model, [with_depth]).ways
    disparity = DepthPrediction(np.ones((4, 4), np.float32), model.kind)
    with pytest.raises(TrackingError, match="cannot be read as metres"):
        log_depth_at(disparity, np.zeros((1, 2)))


def test_data_set_of_a_head_is_not_mixed_up(cache: Path) -> None:
    with pytest.raises(WeightsError, match="named as trained on kitti"):
        create_depth_model("dinov2-linear", weights=cache / "dinov2_vits14_kitti_linear_head.pth")


@pytest.mark.parametrize(
    "name", [n for n in depth_model_names() if n.startswith(("dinov2-", "depth-anything"))]
)
def test_absent_weights_say_file_and_place(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path))
    with pytest.raises(WeightsError) as error:
        create_depth_model(name)
    text = str(error.value)
    assert "\n" not in text
    assert str(tmp_path) in text
    assert ".pth" in text or ".safetensors" in text
    with pytest.raises(WeightsError, match=r"absent\.pth: no such weights file"):
        create_depth_model(name, weights=tmp_path / "absent.pth")


def test_missing_extra_and_misshapen_tensors_are_named(
    cache: Path, small_tensors: dict[str, Tensor], tmp_path: Path
) -> None:
    def refused(tensors: dict[str, Tensor], match: str) -> None:
        path = tmp_path / "depth_anything_v2_vits.pth"
        torch.save(tensors, path)
        with pytest.raises(WeightsError, match=match) as error:
            create_depth_model("depth-anything-v2-small", weights=path)
        assert "\n" not in str(error.value)

    key = "depth_head.scratch.refinenet4.resConfUnit1.conv1.weight"
    # Views of one value, so that the files are small.
    light = {name: torch.zeros(1).expand(value.shape) for name, value in small_tensors.items()}
    refused({k: v for k, v in light.items() if k != key}, rf"1 missing \(first: {key} \(64, 64, 3, 3\)\)")
    refused(
        {**light, "depth_head.extra": torch.zeros(2)}, r"1 unexpected \(first: depth_head\.extra \(2,\)\)"
    )
    refused({**light, key: torch.zeros(64, 64, 1, 1)}, rf"{key} is \(64, 64, 1, 1\), not \(64, 64, 3, 3\)")
    refused({**light, "pretrained.mask_token": torch.zeros(3)}, "mask_token")
    refused({**light, key: torch.zeros(64, 64, 3, 3, dtype=torch.int32)}, rf"{key} is torch\.int32")
    refused({**light, "backbone.embeddings.cls_token": torch.zeros(1)}, "transformers port")
    refused({"epoch": 3}, "'epoch' is none")  # type: ignore[dict-item]
    with pytest.raises(WeightsError, match="missing"):  # the small file is not the base one
        create_depth_model("depth-anything-v2-large", weights=cache / "depth_anything_v2_vits.pth")


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
def test_unreadable_files_are_one_line(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"depth_anything_v2_vits.{ending}"
    for content in (b"", b"hello", b"PK\x03\x04" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(WeightsError, match=r"not a readable weights file: [A-Z]") as error:
            create_depth_model("depth-anything-v2-small", weights=path)
        assert "\n" not in str(error.value)


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    path = tmp_path / "depth_anything_v2_vits.pth"
    torch.save(torch.nn.Linear(2, 2), path)
    with pytest.raises(WeightsError, match="more than tensors and plain values, which is never run"):
        create_depth_model("depth-anything-v2-small", weights=path)


def test_head_files_are_strict(cache: Path, tmp_path: Path) -> None:
    path = tmp_path / "dinov2_vits14_nyu_linear_head.pth"
    torch.save(
        {"state_dict": random_tensors(linear_layout(1)) | {"decode_head.bn.weight": torch.ones(3)}}, path
    )
    with pytest.raises(WeightsError, match=r"1 unexpected \(first: decode_head\.bn\.weight"):
        create_depth_model("dinov2-linear", weights=path)
    torch.save({"state_dict": conv("decode_head.conv_depth", 256, 768, 3)}, path)
    with pytest.raises(WeightsError, match="none"):
        create_depth_model("dinov2-linear", weights=path)


def test_linear_head_is_the_published_computation() -> None:
    """Enlarge, classify, ReLU + 0.1, normalise, expectation, in the published order."""
    torch.manual_seed(1)
    head = LinearHead(6, 2, 10.0)
    tapped = [(torch.randn(1, 6, 3, 4), torch.randn(1, 6)) for _ in range(2)]
    both = [torch.cat([x, t[:, :, None, None].expand_as(x)], 1) for x, t in tapped]
    enlarged = [F.interpolate(x, size=(12, 16), mode="bilinear", align_corners=False) for x in both]
    logits = head.conv_depth(torch.cat(enlarged, dim=1)).relu() + 0.1
    depths = torch.linspace(0.001, 10.0, 256)[None, :, None, None]
    expected = (logits / logits.sum(1, keepdim=True) * depths).sum(1)
    torch.testing.assert_close(head(tapped), expected, rtol=1e-4, atol=1e-5)


def test_padding_is_cut_off_again() -> None:
    """The map keeps its place: depth that grows to the right does so over the whole image."""

    class Ramp(torch.nn.Module):
        layers = 1
        max_depth_m = 100.0

        def forward(self, tapped: list[tuple[Tensor, Tensor]]) -> Tensor:
            columns = tapped[0][0].shape[-1] * 14
            return (torch.arange(columns).float() + 1).expand(1, 14, columns)

    backbone = DinoV2(dim=24, depth=1, heads=3, grid=5).eval()
    card = ModelCard("ramp", DepthKind.METRIC, (30, 40), 60.0, "", "")
    head = OfficialHead(Ramp())  # type: ignore[arg-type]
    model = dinov2_official.Dinov2OfficialDepth(backbone, head, card, (), taps=(0,))
    values = model.predict(frame_of(40, 30, focal=60.0)).values
    # 40 columns are padded to 42, one on the left: the first column of the image is the second.
    np.testing.assert_allclose(values[15], np.arange(40) + 2, rtol=1e-5)


def test_final_norm_is_left_out_for_official_heads() -> None:
    backbone = DinoV2(dim=24, depth=1, heads=3, grid=5).eval()
    torch.nn.init.constant_(backbone.norm.weight, 0.0)
    card = ModelCard("linear", DepthKind.METRIC, (28, 28), None, "", "")
    head = OfficialHead(LinearHead(24, 1, 10.0)).eval()
    model = dinov2_official.Dinov2OfficialDepth(backbone, head, card, (), taps=(0,))
    assert np.ptp(model.predict(frame_of()).values) > 0
