# SPDX-License-Identifier: Apache-2.0
"""The mean of the predictions for an image and for its mirror image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamdepth.depth.mirrored import MirroredDepth, mirror_image
from slamdepth.depth.registry import create_depth_model, depth_model_names, is_depth_model_name
from slamdepth.errors import ConfigError
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo

GRAVITY = np.array([0.6, 0.64, 0.48])


def frame(gravity: np.ndarray | None = None) -> Frame:
    image = np.random.default_rng(0).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    camera = Camera(4, 3, 5.0, 5.0, 1.0, 1.0, (0.1, 0.2, 0.3, 0.4, 0.5))
    return Frame(7, 0.5, image, camera, np.ones((3, 4), np.float32), gravity)


class Left:
    """Predicts 1 to 4 by the column of a pixel, whatever the image; estimates gravity."""

    name = "left"
    weights: tuple[WeightsInfo, ...] = (WeightsInfo("left", "00", "nothing", "none"),)

    def __init__(self, kind: DepthKind = DepthKind.METRIC, unknown: tuple[int, ...] = ()) -> None:
        self.kind, self.unknown = kind, unknown
        self.frames: list[Frame] = []

    def predict(self, frame: Frame) -> DepthPrediction:
        self.frames.append(frame)
        values = np.tile(np.arange(1, 5, dtype=np.float32), (3, 1))
        values[:, list(self.unknown)] = 0
        return DepthPrediction(values, self.kind, values / np.float32(10), gravity=GRAVITY, gravity_share=0.7)


def test_metric_depth_is_the_geometric_mean_of_both_predictions() -> None:
    prediction = MirroredDepth(Left()).predict(frame())
    assert prediction.sigma_log is not None
    np.testing.assert_allclose(prediction.values[0], [2.0, 6**0.5, 6**0.5, 2.0], rtol=1e-6)
    np.testing.assert_allclose(prediction.sigma_log, prediction.values / 10, rtol=1e-6)
    assert prediction.values.dtype == np.float32
    assert prediction.gravity is GRAVITY
    assert prediction.gravity_share == 0.7


def test_relative_depth_is_the_arithmetic_mean() -> None:
    prediction = MirroredDepth(Left(DepthKind.AFFINE_INVERSE_DEPTH)).predict(frame())
    assert prediction.kind is DepthKind.AFFINE_INVERSE_DEPTH
    np.testing.assert_allclose(prediction.values, 2.5)


def test_where_one_prediction_is_unknown_the_other_is_taken() -> None:
    prediction = MirroredDepth(Left(unknown=(0,))).predict(frame())
    np.testing.assert_allclose(prediction.values[0], [4.0, 6**0.5, 6**0.5, 4.0], rtol=1e-6)
    nothing = MirroredDepth(Left(unknown=(0, 3))).predict(frame())
    assert (nothing.values[:, [0, 3]] == 0).all()


@pytest.mark.parametrize("gravity", [None, np.array([0.0, 1.0, 0.0])])
def test_the_mirror_image_is_predicted_with_the_estimated_gravity(
    gravity: np.ndarray | None,
) -> None:
    model = Left()
    MirroredDepth(model).predict(frame(gravity))
    as_taken, mirrored = model.frames
    assert as_taken.gravity is gravity
    assert mirrored.gravity is not None
    np.testing.assert_allclose(mirrored.gravity, [-0.6, 0.64, 0.48])
    np.testing.assert_array_equal(mirrored.image_rgb, as_taken.image_rgb[:, ::-1])
    assert mirrored.depth_m is None


def test_a_mirror_image_of_a_mirror_image_is_the_image() -> None:
    taken = frame(GRAVITY)
    once = mirror_image(taken)
    twice = mirror_image(once)
    assert once.camera != taken.camera
    assert twice.camera == taken.camera
    np.testing.assert_array_equal(twice.image_rgb, taken.image_rgb)
    np.testing.assert_array_equal(twice.gravity, taken.gravity)
    assert mirror_image(frame()).gravity is None


def test_mirrored_models_are_created_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    from slamdepth.depth import registry

    monkeypatch.setitem(registry.MODELS.parts, "left", lambda **_: Left())
    model = create_depth_model("mirrored:left")
    assert isinstance(model, MirroredDepth)
    assert (model.name, model.kind, model.weights) == ("mirrored:left", DepthKind.METRIC, Left.weights)
    assert "mirrored:MODEL" in depth_model_names()
    names = ["dinov2", "mirrored:dinov2", "mirrored:onnx:net.onnx", "mirrored:right", "right"]
    assert [is_depth_model_name(name) for name in names] == [True, True, True, False, False]
    with pytest.raises(ConfigError, match="unknown depth model 'right'; choose from: auto, dinov2"):
        create_depth_model("mirrored:right")


def test_a_sensor_of_any_name_is_not_mirrored() -> None:
    with pytest.raises(ConfigError, match="a sensor's depth needs no mirror; use 'sensor'"):
        create_depth_model("mirrored:sensor")

    class Measured(Left):
        is_sensor = True

    with pytest.raises(ConfigError, match="'mirrored:left': a sensor's depth needs no mirror; use 'left'"):
        MirroredDepth(Measured())


def test_the_card_is_that_of_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    from slamdepth.depth.card import ModelCard, card_of

    assert card_of(MirroredDepth(Left())) is None
    card = ModelCard("left", DepthKind.METRIC, (3, 4), 5.0, "none", "nothing")
    monkeypatch.setattr(Left, "card", card, raising=False)
    assert card_of(MirroredDepth(Left())) == replace(card, name="mirrored:left")
