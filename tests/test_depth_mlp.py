# SPDX-License-Identifier: Apache-2.0
"""The fully connected baseline head over DINOv2 tokens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from depth_frames import frame_of
from safetensors.torch import save_file
from torch.nn import functional as F

from slamdepth.depth import dinov2_mlp
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.dinov2_mlp import Dinov2Mlp, MlpHead, load_mlp, model_card, save_mlp, token_features
from slamdepth.depth.registry import create_depth_model
from slamdepth.errors import WeightsError
from slamdepth.types import DepthKind

FEATURES, HIDDEN = 257 * 6, 8


@pytest.mark.parametrize("side", [224, 32])
def test_mlp_has_the_layers_of_the_original(side: int) -> None:
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


def test_mlp_scales_features_and_applies_a_softplus_after_each_layer() -> None:
    torch.manual_seed(0)
    head = MlpHead(2, features=5, hidden=3)
    samples = torch.rand(7, 5) * 4 - 2
    samples[:, 1] = 0.5  # a feature that never varied
    head.fit_scaler(samples)
    scaled = head.scaler(samples)
    torch.testing.assert_close(scaled.amax(0), torch.tensor([1.0, 0, 1, 1, 1]))
    torch.testing.assert_close(scaled.amin(0), torch.zeros(5))
    x = scaled
    for index in range(3):
        layer = head.layers[index]
        x = F.softplus(x @ layer.weight.T + layer.bias)
    torch.testing.assert_close(head(samples), x.view(7, 2, 2))
    assert (head(-100 * samples) >= 0).all()


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
