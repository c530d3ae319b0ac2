# SPDX-License-Identifier: Apache-2.0
"""A tracker whose depth model learns from its map; at its real speed or slower, the same bits."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from learning_model import Learner
from tracking_scene import CAMERA, CONFIG, ConstantDepth, Run, colour_only, frames, walk

from slamdepth.config import Config
from slamdepth.depth import registry
from slamdepth.depth.alignment import coarse_correction, corrected_depth, log_depth_at
from slamdepth.depth.robust_centre import robust_centre
from slamdepth.errors import ConfigError
from slamdepth.tracker import adaptation, create_tracker
from slamdepth.tracker.finish import _scale_vote
from slamdepth.types import Adaptation, Reconstruction

ADAPT = CONFIG.model_copy(
    update={
        "depth": CONFIG.depth.model_copy(update={"adapt": True}),
        # the walk is short: points have to be born early to be well known at its end
        "tracking": CONFIG.tracking.model_copy(update={"depth_delay": 4}),
    }
)


@pytest.fixture(autouse=True)
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    """The walk is short: lessons come earlier in it than in a run of some length."""
    monkeypatch.setattr(adaptation, "_FIRST", 2)
    monkeypatch.setattr(adaptation, "_EVERY", 1)


@lru_cache(maxsize=1)
def learnt() -> tuple[Learner, Run, Reconstruction]:
    model = Learner()
    run = Run(frames(change=colour_only), model, ADAPT)
    return model, run, run.finish()


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_lessons_change_nothing(seed: int) -> None:
    _, run, expected = learnt()
    slow = Run(frames(change=colour_only), Learner(seed, 0.3), ADAPT)
    made = slow.finish()
    np.testing.assert_array_equal(made.trajectory.T_world_camera, expected.trajectory.T_world_camera)
    np.testing.assert_array_equal(made.points_m, expected.points_m)
    for one, other in zip(made.keyframes, expected.keyframes, strict=True):
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
    for one, other in zip(run.results, slow.results, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_every_few_keyframes_and_at_the_end() -> None:
    model, _, made = learnt()
    counts = [len(views) for views in model.lessons]
    assert counts[:-1] == list(range(2, len(made.keyframes) + 1))
    assert len(counts) >= 3
    assert counts[-1] == len(made.keyframes)
    assert made.adaptation == Adaptation(len(counts), len(made.keyframes), 4, 0.02, 0.01, in_use=True)
    assert any("--adapt: the depth model learnt" in note and "were made anew" in note for note in made.notes)


def test_predictions_of_all_keyframes_are_made_anew() -> None:
    model, _, made = learnt()
    for keyframe in made.keyframes:
        np.testing.assert_array_equal(
            keyframe.prediction.values[:, 0], model.predict(keyframe.frame).values[:, 0]
        )


def test_final_depth_is_tied_to_the_points_from_predictions_as_trained() -> None:
    model, run, made = learnt()
    for kept, keyframe in zip(run.tracker._map.keyframes, made.keyframes, strict=True):
        assert kept.prediction is not None
        untaught = model.predict_as_trained(keyframe.frame)
        np.testing.assert_array_equal(kept.prediction.values, untaught.values)
        field = run.tracker._mapper.depth_field(kept, kept.prediction)
        expected = corrected_depth(coarse_correction(field, kept.prediction), kept.prediction)
        np.testing.assert_array_equal(keyframe.depth_m, expected)


def test_the_scale_is_voted_on_by_the_model_as_trained() -> None:
    model, run, made = learnt()
    landmarks = run.tracker._map
    votes = []
    for keyframe in landmarks.keyframes:
        log, _ = log_depth_at(model.predict_as_trained(keyframe.frame), keyframe.features.raw_px)
        votes.append(_scale_vote(landmarks, replace(keyframe, predicted_log_depth=log)))
    np.testing.assert_allclose(made.scale_votes, [vote for vote in votes if vote is not None], atol=1e-9)
    assert robust_centre(np.array(made.scale_votes)) == pytest.approx(0.0, abs=1e-9)


def test_what_is_not_in_use_leaves_the_run_as_it_was() -> None:
    alike = ADAPT.model_copy(update={"depth": CONFIG.depth})
    plain = Run(frames(change=colour_only), Learner(), alike)
    unused = Run(frames(change=colour_only), Learner(in_use=False), ADAPT)
    one, other = plain.finish(), unused.finish()
    np.testing.assert_array_equal(one.trajectory.T_world_camera, other.trajectory.T_world_camera)
    np.testing.assert_array_equal(one.keyframes[-1].depth_m, other.keyframes[-1].depth_m)
    assert one.adaptation is None
    assert not [note for note in one.notes if "--adapt" in note]
    assert any("so it is not used" in note for note in other.notes)


def test_points_that_teach_are_right_and_some_are_held_out() -> None:
    model, _, _ = learnt()
    held, points = 0, 0
    by_index = {frame.index: frame.depth_m for frame in walk()[0]}
    for view in model.lessons[-1]:
        if len(view.px) < 20:
            continue
        true_m = by_index[view.frame.index]
        assert true_m is not None
        u, v = np.rint(view.px).astype(int).T
        error = view.log_depth - np.log(true_m[v, u].astype(np.float64))
        assert np.median(np.abs(error - np.median(error))) < 0.03
        assert len(view.px) < 400
        held, points = held + np.count_nonzero(view.is_held_out), points + len(view.px)
    assert points > 200
    assert 0.1 < held / points < 0.3


def test_models_and_odometries_that_cannot_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"'constant' cannot adapt.*leave out --adapt"):
        create_tracker(CAMERA, ConstantDepth(), ADAPT)
    with pytest.raises(ConfigError, match="kiss-icp has none: leave out one"):
        create_tracker(CAMERA, Learner(), ADAPT.model_copy(update={"odometry": "kiss-icp"}))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--depth", "sensor"), "depth model 'sensor' cannot adapt while it runs; leave out --adapt"),
        (("--depth", "sensor", "--odometry", "kiss-icp"), "kiss-icp has none: leave out one of the two"),
    ],
)
def test_the_command_line_refuses_in_one_line(
    tiny_room: Path, tmp_path: Path, options: tuple[str, ...], says: str
) -> None:
    done = call("run", tiny_room, *options, "--adapt", "--quiet", "--output", tmp_path / "out")
    assert done.returncode != 0
    assert says in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_command_line_reports_what_was_learnt(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    registry.register("learner")(lambda *, device="cpu", seed=0: Learner())
    for name, options in (("off", ()), ("on", ("--adapt",))):
        out = tmp_path / name
        done = call("run", tiny_room, "--depth", "learner", "--no-mesh", "--quiet", "--output", out, *options)
        assert done.returncode == 0, done.stderr
        report = json.loads((out / "report.json").read_text())
        assert report["settings"]["depth"]["adapt"] is (name == "on")
        assert Config.from_yaml(out / "config.yaml").depth.adapt is (name == "on")
        if name == "off":
            assert report["adaptation"] is None
        else:
            assert report["adaptation"]["updates"] >= 1
            assert report["adaptation"]["loss_before"] == 0.02
            assert any(note.startswith("--adapt: the depth model learnt") for note in report["notes"])
            assert "--adapt: the depth model learnt" in (out / "report.html").read_text()
