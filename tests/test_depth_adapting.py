# SPDX-License-Identifier: Apache-2.0
"""The embedded model while it learns: a bias that can be learnt, one that cannot, and nobody's scale."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
import torch
from test_depth_models import tiny_model

from slamdepth.depth import adapting as module
from slamdepth.depth.adaptation import AdaptingDepthModel, TaughtView, adapting
from slamdepth.depth.adapting import AdaptingDinov2
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import HeadEnsemble, HeadShape, LastLayerChange
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.scale import DepthScale
from slamdepth.depth.scaled import ScaledDepth
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError
from slamdepth.types import Adaptation, Camera, DepthPrediction, Frame

WIDTH, HEIGHT = 160, 120
VIEWS = 12


@lru_cache(maxsize=1)
def model() -> Dinov2Depth:
    made = tiny_model()
    torch.manual_seed(1)
    for head in made._head.members:  # as initialised it says the same everywhere
        torch.nn.init.normal_(head.out.weight, std=0.05)
    return made


def frame(index: int) -> Frame:
    """A smooth picture, another one for each index."""
    rng = np.random.default_rng(index)
    coarse = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return Frame(index, index / 30, image, Camera(WIDTH, HEIGHT, 150.0, 150.0, 80.0, 60.0))


@lru_cache(maxsize=1)
def bias() -> LastLayerChange:
    """What the model lacks: its last layer should have been another one."""
    shape = (1, 8)
    return LastLayerChange(
        torch.from_numpy(np.random.default_rng(7).normal(0, 0.3, shape).astype(np.float32))
    )


@lru_cache(maxsize=64)
def true_log_depth(index: int) -> np.ndarray:
    given = frame(index)
    return np.log(model().decode(model().features(given), given, bias()).values.astype(np.float64))


def view(index: int, *, scale_log: float = 0.0, noise: float = 0.0) -> TaughtView:
    rng = np.random.default_rng(1000 + index)
    px = np.column_stack([rng.integers(0, WIDTH, 150), rng.integers(0, HEIGHT, 150)]).astype(np.float64)
    log_depth = true_log_depth(index)[px[:, 1].astype(int), px[:, 0].astype(int)] + scale_log
    return TaughtView(frame(index), px, log_depth + noise * rng.normal(size=150), np.arange(150) % 5 == 0)


def taught(scales_log: np.ndarray | None = None) -> tuple[AdaptingDinov2, list[Adaptation]]:
    """A model after half of the views, and after all."""
    learner = AdaptingDinov2(model(), ridge=1e-3)
    scales_log = np.zeros(VIEWS) if scales_log is None else scales_log
    said = []
    for count in (VIEWS // 2, VIEWS):
        for index in range(count):
            learner.predict(frame(index))
        said.append(learner.adapt([view(i, scale_log=float(scales_log[i])) for i in range(count)]))
    return learner, said


def relief_error(prediction: DepthPrediction, index: int) -> float:
    error = np.log(prediction.values) - true_log_depth(index)
    return float(np.mean(np.abs(error - np.median(error))))


def missing(prediction: DepthPrediction, given: TaughtView) -> np.ndarray:
    """What the prediction's log depth lacks at the points of a view."""
    u, v = given.px.astype(int).T
    return given.log_depth - np.log(prediction.values[v, u].astype(np.float64))


def equal(a: DepthPrediction, b: DepthPrediction) -> bool:
    assert a.sigma_log is not None
    assert b.sigma_log is not None
    return np.array_equal(a.values, b.values) and np.array_equal(a.sigma_log, b.sigma_log)


def test_it_starts_as_what_it_was() -> None:
    learner = adapting(model())
    assert isinstance(learner, AdaptingDepthModel)
    assert (learner.name, learner.kind, learner.weights) == ("dinov2", model().kind, model().weights)
    assert equal(learner.predict(frame(0)), model().predict(frame(0)))


@pytest.mark.parametrize("level_dim", [0, 4])
def test_a_common_doubt_and_the_level_stay_what_they_were(level_dim: int) -> None:
    torch.manual_seed(0)
    backbone = DinoV2(dim=24, depth=2, heads=3, grid=5).eval().requires_grad_(False)
    shape = HeadShape((0, 1), 24, 16, 1, 8, members=2, doubt=4, level_dim=level_dim)
    head = HeadEnsemble(shape).eval().requires_grad_(False)
    doubting = Dinov2Depth(backbone, head, ())
    learner = adapting(doubting)
    first = doubting.predict(frame(0))
    assert equal(learner.predict(frame(0)), first)
    again = learner.predict(frame(0))  # from kept features
    np.testing.assert_allclose(again.sigma_log, first.sigma_log, rtol=1e-4)
    np.testing.assert_allclose(again.values, first.values, rtol=5e-3)


def test_a_change_of_nothing_changes_nothing() -> None:
    none = LastLayerChange(torch.zeros(1, 8))
    features = model().features(frame(0))
    assert equal(model().decode(features, frame(0), none), model().predict(frame(0)))


def test_a_bias_is_removed_where_nothing_was_learnt() -> None:
    before = model().predict(frame(0))
    learner, said = taught()
    assert not said[0].in_use  # nothing has judged it yet
    assert (said[0].updates, said[0].views, said[0].judged_views, said[0].loss_after) == (1, 6, 0, None)
    assert said[1].in_use
    assert (said[1].updates, said[1].views, said[1].judged_views) == (2, 12, 6)
    assert said[1].loss_before is not None
    assert said[1].loss_after is not None
    assert said[1].loss_after < 0.1 * said[1].loss_before
    for index in (100, 101, 102):  # all pixels of pictures it never saw
        assert relief_error(learner.predict(frame(index)), index) < 0.2 * relief_error(
            model().predict(frame(index)), index
        )
    assert relief_error(learner.predict(frame(0)), 0) < 0.2 * relief_error(before, 0)  # from kept features
    np.testing.assert_allclose(learner.predict_as_trained(frame(0)).values, before.values, rtol=5e-3)
    assert equal(learner.predict_as_trained(frame(200)), model().predict(frame(200)))
    assert equal(model().predict(frame(0)), before)  # the model that was given stays as it is


def test_the_scale_stays_and_that_of_the_map_teaches_nothing() -> None:
    learner, _ = taught()
    drifted, said = taught(np.linspace(-0.7, 0.9, VIEWS))
    assert said[1].in_use
    np.testing.assert_allclose(
        drifted.predict(frame(50)).values, learner.predict(frame(50)).values, rtol=1e-3
    )
    votes = [
        np.median(missing(learner.predict(frame(i)), view(i)))
        - np.median(missing(model().predict(frame(i)), view(i)))
        for i in range(VIEWS)
    ]
    assert abs(np.mean(votes)) < 0.01
    changes = [
        np.log(learner.predict(frame(i)).values / model().predict(frame(i)).values) for i in range(VIEWS)
    ]
    means = np.array([change.mean() for change in changes])
    assert np.ptp(means) < 2e-3  # one offset for all images; half-precision features round
    assert min(np.std(change) for change in changes) > 0.05


def test_the_same_lessons_give_the_same_bits() -> None:
    (one, said), (other, said_again) = taught(), taught()
    assert said == said_again
    for index in (3, 60):
        assert equal(one.predict(frame(index)), other.predict(frame(index)))


def test_noise_is_not_used() -> None:
    learner = AdaptingDinov2(model(), ridge=1e-3)
    for count in (VIEWS // 2, VIEWS):
        views = []
        for index in range(count):
            predicted = learner.predict(frame(index))
            given = view(index)
            noise = np.random.default_rng(index).normal(0, 0.5, len(given.px))
            views.append(replace(given, log_depth=given.log_depth - missing(predicted, given) + noise))
        said = learner.adapt(views)
    assert said.loss_before is not None
    assert said.loss_after is not None
    assert said.loss_after > said.loss_before
    assert not said.in_use
    assert equal(learner.predict(frame(70)), model().predict(frame(70)))


def test_views_with_few_points_and_unknown_ones_are_left_out() -> None:
    learner = AdaptingDinov2(model())
    few = view(0)
    learner.predict(few.frame)
    few = replace(few, px=few.px[:9], log_depth=few.log_depth[:9], is_held_out=few.is_held_out[:9])
    assert learner.adapt([few, view(1)]) == Adaptation()


def test_features_of_a_bounded_number_of_views_spread_over_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_VIEWS", 5)
    learner = AdaptingDinov2(model())
    for index in range(20):
        learner.predict(frame(index))
    kept = sorted(learner._kept)
    assert len(kept) == 5
    assert (kept[0], kept[-1]) == (0, 19)
    assert np.diff(kept).max() <= 8
    assert equal(learner.predict(frame(1)), model().predict(frame(1)))  # dropped ones are computed again


def test_a_factor_is_kept_and_a_shift_refused() -> None:
    plain = adapting(model())
    scaled = adapting(ScaledDepth(model(), DepthScale(2.0)))
    for learner in (plain, scaled):
        for count in (VIEWS // 2, VIEWS):
            for index in range(count):
                learner.predict(frame(index))
            said = learner.adapt([view(index) for index in range(count)])
        assert said.in_use
    np.testing.assert_allclose(
        scaled.predict(frame(90)).values, 2.0 * plain.predict(frame(90)).values, rtol=1e-5
    )
    with pytest.raises(ConfigError, match="shift and --adapt"):
        adapting(ScaledDepth(model(), DepthScale(2.0, 0.3)))


@pytest.mark.parametrize("wrapped", [False, True])
def test_other_models_refuse(wrapped: bool) -> None:
    class Other:
        name, kind, weights = "other", model().kind, ()

        def predict(self, frame: Frame) -> DepthPrediction:
            raise NotImplementedError

    other = ScaledDepth(Other(), DepthScale(2.0)) if wrapped else Other()
    with pytest.raises(ConfigError, match=r"'other' cannot adapt.*--depth dinov2"):
        adapting(other)
    with pytest.raises(ConfigError, match="'sensor' cannot adapt"):
        adapting(SensorDepth())
