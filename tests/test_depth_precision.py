# SPDX-License-Identifier: Apache-2.0
"""What numbers the backbone computes in, and how much that changes."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from depth_frames import frame_of

from slamdepth import ConfigError, create_depth_model
from slamdepth.config import Precision
from slamdepth.depth import precision as precisions
from slamdepth.depth.dinov2 import DinoV2, LayerScale
from slamdepth.depth.head import HeadEnsemble, HeadShape
from slamdepth.depth.int8 import Int8Linear, check_int8, to_int8
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.precision import chosen_precision
from slamdepth.types import WeightsInfo


def _why_no_int8() -> str:
    try:
        check_int8("cpu")
    except ConfigError as error:
        return str(error)
    return ""


needs_int8 = pytest.mark.skipif(bool(_why_no_int8()), reason=_why_no_int8() or "int8 works here")


def _backbone() -> DinoV2:
    torch.manual_seed(0)
    model = DinoV2(dim=48, depth=3, heads=3, grid=5).eval()
    for module in model.modules():
        if isinstance(module, LayerScale):
            torch.nn.init.uniform_(module.gamma, 0.2, 1.5)
    return model.requires_grad_(False)


@needs_int8
@pytest.mark.parametrize("shift", [0.0, 5.0, -5.0])
def test_an_int8_layer_is_close_to_the_same_layer_in_float32(shift: float) -> None:
    torch.manual_seed(1)
    layer, x = torch.nn.Linear(96, 40), torch.randn(2, 7, 96) + shift
    expected = layer(x).detach()
    out = Int8Linear(layer.weight, layer.bias)(x)
    assert out.shape == expected.shape
    assert (out - expected).norm() < 0.02 * expected.norm()


@needs_int8
def test_large_weights_next_to_one_another_do_not_saturate() -> None:
    weight = torch.ones(4, 64) * torch.tensor([[1.0], [-1.0], [0.5], [-2.0]])
    out = Int8Linear(weight, torch.zeros(4))(torch.ones(2, 64))
    torch.testing.assert_close(out, weight.sum(dim=1).expand(2, -1), rtol=0.02, atol=0.0)


@needs_int8
def test_an_int8_layer_takes_an_input_of_zeros() -> None:
    layer = torch.nn.Linear(16, 8)
    out = Int8Linear(layer.weight, layer.bias)(torch.zeros(3, 16))
    torch.testing.assert_close(out, layer.bias.detach().expand(3, -1))


@needs_int8
def test_int8_tokens_are_close_to_those_in_float32_and_the_same_twice() -> None:
    image = torch.randn(1, 3, 56, 70, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        expected = _backbone()(image, (1, 2))
        model = to_int8(_backbone())
        first, again = model(image, (1, 2)), model(image, (1, 2))
    for (grid, token), (grid_8, token_8), (grid_again, token_again) in zip(
        expected, first, again, strict=True
    ):
        assert (grid_8 - grid).norm() < 0.05 * grid.norm()
        assert (token_8 - token).norm() < 0.05 * token.norm()
        assert torch.equal(grid_8, grid_again)
        assert torch.equal(token_8, token_again)


@pytest.mark.parametrize(
    ("device", "instructions", "taken"),
    [
        ("cpu", ("avx2", "avx512_f", "avx512_bf16"), "bfloat16"),
        ("cpu", ("avx2", "avx512_f"), "int8"),
        ("cpu", ("avx2",), "int8"),
        ("cpu", (), "float32"),
        ("cuda", ("avx2",), "float32"),
    ],
)
def test_auto_takes_the_fastest_that_the_processor_has(
    monkeypatch: pytest.MonkeyPatch, device: str, instructions: tuple[str, ...], taken: str
) -> None:
    monkeypatch.setattr(precisions, "instructions", lambda: instructions)
    monkeypatch.setattr(precisions, "check_int8", lambda device: None)
    monkeypatch.setattr("slamdepth.processor.instructions", lambda: instructions)
    assert chosen_precision("auto", device) == taken


def _without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no such operator\nand a long trace")

    monkeypatch.setattr("slamdepth.depth.int8.instructions", lambda: ("avx2",))
    monkeypatch.setattr("slamdepth.processor.instructions", lambda: ("avx2",))
    monkeypatch.setattr(precisions, "instructions", lambda: ("avx2",))
    monkeypatch.setattr("slamdepth.depth.int8.Int8Linear", fail)


def test_auto_falls_back_to_float32_with_one_line_where_the_kernels_fail(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _without_kernels(monkeypatch)
    with caplog.at_level(logging.WARNING):
        assert chosen_precision("auto", "cpu") == "float32"
    (record,) = caplog.records
    assert "computes in float32" in record.getMessage()
    assert record.getMessage().endswith("has no int8 kernels here: no such operator")


def test_int8_that_is_asked_for_and_cannot_be_had_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    _without_kernels(monkeypatch)
    with pytest.raises(ConfigError, match=r"depth\.precision int8: PyTorch .* no such operator; take 'auto'"):
        chosen_precision("int8", "cpu")
    with pytest.raises(ConfigError, match="int8 runs on the CPU only, not on 'cuda'"):
        chosen_precision("int8", "cuda")
    monkeypatch.setattr("slamdepth.depth.int8.instructions", lambda: ())
    with pytest.raises(ConfigError, match="needs a processor with AVX2"):
        chosen_precision("int8", "cpu")


def test_emulated_bfloat16_is_taken_where_it_is_asked_for_and_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(precisions, "has_bfloat16", lambda: False)
    assert chosen_precision("bfloat16", "cpu") == "bfloat16"
    assert "emulated" in caplog.text


@pytest.mark.parametrize("precision", ["float32", "bfloat16", pytest.param("int8", marks=needs_int8)])
def test_the_weights_say_what_the_backbone_computes_in(precision: Precision) -> None:
    head = HeadEnsemble(HeadShape((0, 1), 48, 16, 1, 8)).eval().requires_grad_(False)
    two = (WeightsInfo("backbone", "ab", "-", "-"), WeightsInfo("head", "cd", "-", "-"))
    model = Dinov2Depth(_backbone(), head, two, precision=precision)
    assert model.weights == (replace(two[0], precision=precision), two[1])


def test_other_models_have_no_choice_of_precision() -> None:
    for name in ("sensor", "onnx:x.onnx", "hf:ORG/NAME"):
        with pytest.raises(ConfigError, match="has no choice of precision"):
            create_depth_model(name, precision="int8")


@pytest.mark.weights
@needs_int8
def test_int8_changes_depth_by_a_per_cent() -> None:
    frame = frame_of(320, 240, 260.0)
    exact = create_depth_model("dinov2", precision="float32").predict(frame)
    int8 = create_depth_model("dinov2", precision="int8").predict(replace(frame, gravity=exact.gravity))
    assert np.median(np.abs(np.log(int8.values / exact.values))) < 0.03


def test_a_smaller_input_keeps_the_scale_of_the_trained_one() -> None:
    head = HeadEnsemble(HeadShape((0, 1), 48, 16, 1, 8, input_px=56 * 70)).eval().requires_grad_(False)
    frame, far = frame_of(160, 128, 130.0), frame_of(160, 128, 260.0)
    trained = Dinov2Depth(_backbone(), head, (), precision="float32")
    smaller = Dinov2Depth(_backbone(), head, (), precision="float32", input_px=28 * 42)
    # An untrained head predicts 1.8 m at the canonical focal length, whatever it sees.
    np.testing.assert_allclose(smaller.predict(frame).values, trained.predict(frame).values, rtol=0.02)
    np.testing.assert_allclose(smaller.predict(far).values, trained.predict(far).values, rtol=0.02)
    assert smaller.predict(frame).values.shape == (128, 160)


def test_other_models_have_no_choice_of_input_size() -> None:
    for name in ("sensor", "onnx:x.onnx", "hf:ORG/NAME"):
        with pytest.raises(ConfigError, match="has no choice of input size"):
            create_depth_model(name, input_px=30_000)
