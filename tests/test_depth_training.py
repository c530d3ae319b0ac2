# SPDX-License-Identifier: Apache-2.0
"""Training of a head on four synthetic images with a tiny backbone; views, losses, readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from killed_training import tiny_backbone
from training_places import interrupted_at, make_place

from slamdepth.depth.head import load_head
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.training import loop, member
from slamdepth.training.augment import augmented_view, turned_view, unaugmented_view
from slamdepth.training.config import AugmentConfig, TrainConfig
from slamdepth.training.data import data_folder, open_place
from slamdepth.training.losses import laplace_nll, multiscale_gradient, scale_invariant
from slamdepth.training.results import TrainResult
from slamdepth.training.stages import coarse_target
from slamdepth.training.store import SampleStore
from slamdepth.training.views import plan_samples
from slamdepth.types import Camera, Frame


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    make_place(tmp_path / "data" / "room")
    make_place(tmp_path / "data" / "other", 2)
    make_place(tmp_path / "data" / "third", 2)
    return {
        "output": str(tmp_path / "head.safetensors"),
        "members": 2,
        "coarse_epochs": 2,
        "fine_epochs": 1,
        "batch": 4,
        "sources": [
            {
                "folder": str(tmp_path / "data"),
                "places": [{"name": "room", "samples": 8}],
                "held_out": ["other"],
            },
            {"folder": str(tmp_path / "data"), "places": [{"name": "third", "samples": 3}], "limit": 2},
        ],
        "view": {"rows": 28, "columns": 42},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }


def train(settings: dict[str, Any]) -> TrainResult:
    return loop.train_depth(TrainConfig.from_dict(settings), backbone=tiny_backbone())


def test_training_writes_a_loadable_head_and_judges_held_out_places(settings: dict[str, Any]) -> None:
    result = train(settings)
    head, about = load_head(result.output)
    assert head.shape.members == 2
    assert about["trained_on"] == "room, third"
    assert json.loads(about["settings"])["seed"] == 0
    assert result.losses.shape == (2, 3)
    assert set(result.held_out) == {"other"}
    # sigma was calibrated on the held-out place, so about 68 % lie within one
    assert head.sigma_scale == pytest.approx(result.sigma_scale)
    assert not list(result.output.parent.glob("*.checkpoint"))


def test_training_is_deterministic(settings: dict[str, Any]) -> None:
    first = train(settings).output.read_bytes()
    assert train(settings).output.read_bytes() == first
    other = train({**settings, "seed": 1}).output.read_bytes()
    assert other != first


def test_a_killed_training_resumes_to_the_same_result(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train(settings)
    expected = whole.output.read_bytes()
    whole.output.unlink()
    # in the second member's second epoch
    calls = interrupted_at(monkeypatch, member, "run_epoch", 5)
    with pytest.raises(KeyboardInterrupt):
        train(settings)
    again = train(settings)
    assert len(calls) == 5 + 2  # the first member's epochs are not repeated
    assert again.output.read_bytes() == expected
    np.testing.assert_array_equal(again.losses, whole.losses)


def test_features_are_computed_once(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    train(settings)
    model = tiny_backbone()
    monkeypatch.setattr(model, "forward", lambda *a: pytest.fail("the features are cached"))
    loop.train_depth(TrainConfig.from_dict({**settings, "learning_rate": 1e-3}), backbone=model)


def test_learning_happens(settings: dict[str, Any]) -> None:
    unaugmented = dict.fromkeys(("flip", "rolled", "colour", "blur", "noise", "jpeg", "max_tilt_deg"), 0.0)
    view = {**settings["view"], "augment": {**unaugmented, "upright_roll_deg": 0.0, "max_zoom": 1.0}}
    result = train({**settings, "members": 1, "coarse_epochs": 40, "fine_epochs": 0, "view": view,
                    "head": {**settings["head"], "dropout": 0.0}})  # fmt: skip
    assert result.losses[0, -1] < result.losses[0, 0] - 0.2


def test_samples_of_another_shape_are_not_stored(tmp_path: Path) -> None:
    store = SampleStore(tmp_path, 3, {"tokens": ((2, 4), np.float16), "factor": ((), np.float32)})
    for wrong in (np.ones(4), np.ones((2, 1, 4)), np.ones((1, 2, 4))):
        with pytest.raises(ValueError, match=r"'tokens' is \(.*\), not \(2, 2, 4\)"):
            store.put(range(2), factor=[1.0, 1.0], tokens=wrong)
    store.put(range(2), factor=[1.0, 1.0], tokens=np.ones((2, 2, 4)))
    store.commit()
    assert store.arrays["done"].tolist() == [1, 1, 0]


def test_a_place_is_not_both_trained_on_and_held_out(settings: dict[str, Any]) -> None:
    both = {**settings["sources"][0], "held_out": ["room"]}
    with pytest.raises(ConfigError, match=r"room is held out and also trained on"):
        train({**settings, "sources": [both]})
    with pytest.raises(ConfigError, match=r"no place to train on"):
        train({**settings, "sources": [{**both, "places": []}]})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"epoch": 3}, "setting 'epoch': unknown setting"),
        ({"batch": 0}, "setting 'batch'"),
        ({"sources": []}, "setting 'sources'"),
        ({"head": {"tap": 1}}, "setting 'head.tap': unknown setting"),
        ({"head": {"taps": [5, 50]}}, "setting 'head.taps': must be blocks from 0 to 11"),
        ({"head": {"taps": [-1]}}, "setting 'head.taps'"),
        ({"head": {"taps": [5, 5]}}, "setting 'head.taps'"),
        ({"head": {"taps": [8, 5]}}, "setting 'head.taps'"),
        ({"head": {"taps": []}}, "setting 'head.taps'"),
        ({"view": {"min_depth_m": 5, "max_depth_m": 1}}, "setting 'view': min_depth_m must be below"),
        ({"view": {"min_depth_m": 10}}, "setting 'view': min_depth_m must be below max_depth_m, got 10 and"),
        ({"coarse_epochs": 0, "fine_epochs": 0}, "setting 'fine_epochs': at least one epoch is needed"),
        ({"learning_rate": float("inf")}, "setting 'learning_rate'"),
        ({"loss": {"nll": float("nan")}}, "setting 'loss.nll'"),
        (
            {"sources": [{"folder": "data", "teaches": "level"}]},
            "setting 'sources.0.teaches': unknown setting",
        ),
        ({"sources": [{"folder": "data", "supervision": "level"}]}, "setting 'sources.0.supervision'"),
        ({"head": {"down_dim": 8}}, "setting 'head.down_dim': unknown setting"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], change: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as error:
        TrainConfig.from_dict({**settings, **change}, origin="train.yaml")
    assert str(error.value).startswith(f"train.yaml: {says}")


def test_training_on_no_depth_is_an_error(settings: dict[str, Any], caplog: pytest.LogCaptureFixture) -> None:
    settings["view"] |= {"min_depth_m": 8.0, "max_depth_m": 9.0}
    with pytest.raises(DatasetError, match=r"room, third: no view .* has depth between 8 and 9 m; check"):
        train(settings)
    assert not Path(settings["output"]).exists()
    assert "other: no view of it has depth between 8 and 9 m" in caplog.text


def test_every_member_needs_depth_and_a_place_without_is_logged(
    settings: dict[str, Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for file in (tmp_path / "data" / "third").glob("*.png"):
        cv2.imwrite(str(file), np.zeros((48, 64), np.uint16))
    train(settings)
    assert "third: no view of it has depth between 0.2 and 10 m" in caplog.text
    assert "room: no view" not in caplog.text
    first, second = settings["sources"]
    settings["sources"] = [{**first, "members": [0]}, {**second, "members": [1]}]
    with pytest.raises(DatasetError, match="no view that a head is to be trained on"):
        train(settings)


def test_settings_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the settings"):
        TrainConfig.from_yaml(tmp_path / "absent.yaml")
    (tmp_path / "x.yaml").write_text("a: [")
    with pytest.raises(ConfigError, match="not valid YAML"):
        TrainConfig.from_yaml(tmp_path / "x.yaml")


def test_shipped_settings_are_valid() -> None:
    folder = Path(loop.__file__).resolve().parent / "configs"
    files = sorted(folder.glob("*.yaml"))
    assert files
    for file in files:
        names = {place.name for source in TrainConfig.from_yaml(file).sources for place in source.places}
        # the kitchen is a judging sequence's place, and TUM is a benchmark
        assert not any("kitchen" in name or "freiburg" in name for name in names)


def test_reading_places(tmp_path: Path) -> None:
    place = open_place(make_place(tmp_path / "room"))
    frame = place.read(1)
    assert len(place) == 4
    assert frame.depth_m is not None
    assert (frame.depth_m[:4] == 0).all()
    assert 0.9 < frame.depth_m[4:].min() < frame.depth_m.max() < 2.8


def test_bad_places_are_named(tmp_path: Path) -> None:
    folder = make_place(tmp_path / "room")
    with pytest.raises(DatasetError, match=r"no camera\.json"):
        open_place(tmp_path, "pairs")
    (folder / "00001.png").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"00001\.png: the image does not decode"):
        open_place(folder).read(1)
    cv2.imwrite(str(folder / "00002.png"), np.ones((5, 5), np.uint16))
    with pytest.raises(DatasetError, match=r"00002\.png.*camera\.json says"):
        open_place(folder).read(2)
    (folder / "camera.json").write_text('{"width": 64}')
    with pytest.raises(DatasetError, match=r"camera\.json: the key 'height' is missing"):
        open_place(folder)
    with pytest.raises(DatasetError, match="no such folder"):
        data_folder(str(tmp_path / "absent"))


def test_samples_spread_over_frames(tmp_path: Path) -> None:
    place = open_place(make_place(tmp_path / "room"))
    few, many = plan_samples([place], [2], 0), plan_samples([place], [9], 0)
    assert sorted(k.frame for k in few) == [0, 3]
    assert len({(k.frame, k.copy) for k in many}) == 9
    assert plan_samples([place], [9], 0) == many != plan_samples([place], [9], 1)


def tilted_plane(width: int = 120, height: int = 90) -> tuple[Frame, np.ndarray, float]:
    """A plane n . X = d seen by a camera, with its exact depth."""
    camera = Camera(width, height, 100.0, 100.0, 59.5, 44.5)
    normal, distance = np.array([0.2, -0.3, 0.9]), 2.0
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    depth = (distance / (rays @ normal)).astype(np.float32)
    image = np.repeat((depth * 60).astype(np.uint8)[..., None], 3, 2)
    return Frame(0, 0.0, image, camera, depth), normal, distance


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("turn", [(0, 0, 0), (40, 0, 0), (0, 8, 0), (0, 0, 8), (-25, 5, -7)])
def test_turned_depth_is_exact(turn: tuple[float, float, float], flip: bool) -> None:
    from slamdepth.geometry import so3_exp

    frame, normal, distance = tilted_plane()
    rows, columns, zoom = 84, 112, 1.4
    _, depth, focal = turned_view(frame, rows, columns, *turn, zoom, flip)
    assert focal == pytest.approx(zoom * 100.0 * max(84 / 90, 112 / 120))
    roll, pan, tilt = np.radians(turn)
    R_camera_view = so3_exp(np.array([0, 0, roll])) @ so3_exp(np.array([tilt, pan, 0]))
    turned_normal = R_camera_view.T @ normal
    if flip:
        turned_normal = turned_normal * [-1, 1, 1]
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    rays = np.stack([(u - 55.5) / focal, (v - 41.5) / focal, np.ones_like(u)], -1)
    exact = distance / (rays @ turned_normal)
    known = depth > 0
    assert known.mean() > 0.6
    # nearest pixel sampling moves a sample by up to half a pixel
    np.testing.assert_allclose(depth[known], exact[known], rtol=0.01)


def test_in_plane_roll_leaves_the_middle_s_depth() -> None:
    frame, _, _ = tilted_plane()
    straight = unaugmented_view(frame, 84, 112).depth_m[41:43, 55:57].mean()
    rolled = turned_view(frame, 84, 112, 90.0, 0, 0, 1.0, False)[1][41:43, 55:57].mean()
    assert rolled == pytest.approx(straight, rel=2e-3)


def test_views_are_reproducible_and_valid() -> None:
    frame, _, _ = tilted_plane()
    views = [
        augmented_view(frame, 84, 112, AugmentConfig(), np.random.default_rng(seed)) for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(views[0].image_rgb, views[1].image_rgb)
    assert not np.array_equal(views[0].image_rgb, views[2].image_rgb)
    for view in views:
        assert view.image_rgb.shape == (84, 112, 3)
        assert view.image_rgb.dtype == np.uint8
        assert (view.depth_m >= 0).all()


def test_losses_on_known_errors() -> None:
    known = torch.ones(1, 4, 4, dtype=torch.bool)
    constant = torch.full((1, 4, 4), 0.3)
    assert float(scale_invariant(constant, known, 1.0)) == pytest.approx(0.0, abs=1e-7)
    assert float(scale_invariant(constant, known, 0.0)) == pytest.approx(0.09)
    assert float(multiscale_gradient(constant, known)) == 0.0
    # the Laplace likelihood is best where the spread is the mean absolute error
    at = [
        float(laplace_nll(constant, torch.full((1, 4, 4), float(np.log(b))), known)) for b in (0.2, 0.3, 0.4)
    ]
    assert at[1] < min(at[0], at[2])


def test_unknown_pixels_have_no_gradient() -> None:
    from slamdepth.training.config import LossConfig
    from slamdepth.training.losses import total_loss

    prediction = torch.zeros(1, 2, 28, 28, requires_grad=True)
    target = torch.full((1, 28, 28), 2.0)
    target[:, :, 14:] = 0.0
    torch.autograd.backward(total_loss(prediction, target, LossConfig()))
    assert prediction.grad is not None
    assert bool(torch.isfinite(prediction.grad).all())
    assert float(prediction.grad[..., 14:].abs().max()) == 0.0
    assert float(prediction.grad[:, 0, :, :14].abs().max()) > 0.0


def test_coarse_target_is_the_median_of_what_is_known() -> None:
    target = torch.zeros(1, 14, 7)
    target[0, :2, :3] = 1.0
    target[0, 0, 5] = 9.0
    torch.testing.assert_close(coarse_target(target), torch.tensor([[[1.0], [0.0]]]))
