# SPDX-License-Identifier: Apache-2.0
"""Heads that read gravity, views rotated upright, and sources that supervise shape, scale or gravity only."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from killed_training import tiny_backbone
from safetensors.torch import save_file
from training_places import make_place

from slamdepth.depth.gravity_field import gravity_field
from slamdepth.depth.head import FORMAT, DepthHead, HeadEnsemble, HeadShape, load_head, save_head
from slamdepth.depth.layout import pack_about
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.depth.upright import roll_rad
from slamdepth.errors import ConfigError, DatasetError, WeightsError
from slamdepth.training import gravity, loop
from slamdepth.training.augment import View, augmented_view, matching_view, unaugmented_view
from slamdepth.training.caches import fill_cache, plan_caches
from slamdepth.training.config import AugmentConfig, HeadConfig, LossConfig, TrainConfig, ViewConfig
from slamdepth.training.data import Place, open_place
from slamdepth.training.features import load_batch, load_mixed_batch
from slamdepth.training.losses import supervised, total_loss
from slamdepth.training.stages import hide_gravity
from slamdepth.training.views import Partner, SampleKey, make_view
from slamdepth.types import Camera, Frame

SHAPE = HeadShape(taps=(0, 2), token_dim=24, dim=16, blocks=1, guide_dim=8, scale_dim=4, gravity=True)
_SEEDED = torch.Generator().manual_seed(1)
ARGS = (
    torch.randn(2, 2, 24, 3, 4, generator=_SEEDED),
    torch.randn(2, 2, 24, generator=_SEEDED),
    torch.randn(2, 3, 42, 56, generator=_SEEDED),
)
ROWS, COLUMNS = 70, 98
CALM = AugmentConfig(upright_roll_deg=0.0, rolled=0.0, colour=0.0, blur=0.0, noise=0.0, jpeg=0.0)


def unit(*xyz: float) -> np.ndarray:
    direction: np.ndarray = np.array(xyz) / np.linalg.norm(xyz)
    return direction


def fields(*gravities: tuple[float, float, float], focal_px: float = 60.0) -> torch.Tensor:
    return gravity_field(torch.tensor(gravities), torch.full((len(gravities),), focal_px), ROWS, 98)


def test_the_field_is_the_sine_of_the_angle_below_the_horizon() -> None:
    s, squared, size, one = fields((0.0, 1.0, 0.0))[0]  # an odd number of rows, none of columns
    assert s.shape == (10, 14)
    # the centre of block 0 is pixel 3, and the principal point lies at row 34.5
    y, x = 7 * torch.arange(10)[:, None] + 3 - 34.5, 7 * torch.arange(14)[None] + 3 - 48.5
    torch.testing.assert_close(s, y / (x**2 + y**2 + 60.0**2).sqrt())
    assert bool((s[:5] < 0).all())
    assert bool((s[5:] > 0).all())
    torch.testing.assert_close(squared, s**2)
    torch.testing.assert_close(size, s.abs())
    assert bool((one == 1).all())


def test_the_field_of_a_pitched_camera_and_of_one_with_a_middle_block() -> None:
    gravity_c = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.5**0.5, 0.5**0.5]])
    level, pitched = gravity_field(gravity_c, torch.full((2,), 50.0), 63, 77)[:, 0, 4, 5]
    assert float(level) == pytest.approx(0.0, abs=1e-7)
    assert float(pitched) == pytest.approx(np.sin(np.radians(45)), abs=1e-6)


def test_the_field_of_unknown_gravity_is_zero() -> None:
    known, unknown = fields((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    assert bool(known.any())
    assert not bool(unknown.any())


def test_gravity_changes_the_prediction_of_a_trained_head_only() -> None:
    torch.manual_seed(2)
    head = DepthHead(SHAPE).eval()
    without = DepthHead(replace(SHAPE, gravity=False)).eval()
    field = gravity_field(torch.tensor([[0.0, 0.8, 0.6], [0.6, 0.8, 0.0]]), torch.full((2,), 50.0), 42, 56)
    assert head.scale_branch is not None
    assert head.field is not None
    torch.nn.init.normal_(head.scale_branch.out.weight)
    torch.nn.init.normal_(head.out.weight)
    extra = without.load_state_dict(head.state_dict(), strict=False).unexpected_keys
    assert {name.rpartition(".")[0] for name in extra} == {"scale_branch.gravity", "field"}
    with torch.inference_mode():
        torch.testing.assert_close(head(*ARGS, field), without(*ARGS))
        torch.nn.init.normal_(head.get_parameter("scale_branch.gravity.weight"))
        unmoved, rescaled = without.coarse(*ARGS)[0][:, 0], head.coarse(*ARGS, field)[0][:, 0]
        assert float((rescaled - unmoved).mean(dim=(1, 2)).abs().min()) > 0.05
        torch.nn.init.normal_(head.field.weight)
        reshaped = head.coarse(*ARGS, field)[0][:, 0]
        torch.testing.assert_close(reshaped.mean(dim=(1, 2)), rescaled.mean(dim=(1, 2)))
        assert float((reshaped - rescaled).abs().max()) > 0.05
        torch.testing.assert_close(head(*ARGS), head(*ARGS, torch.zeros_like(field)))
        torch.testing.assert_close(head(*ARGS), without(*ARGS))


def test_a_head_that_reads_gravity_comes_back_from_its_file(tmp_path: Path) -> None:
    torch.manual_seed(3)
    model = HeadEnsemble(replace(SHAPE, members=2))
    for k in range(2):
        torch.nn.init.normal_(model.get_parameter(f"members.{k}.field.weight"))
    save_head(tmp_path / "h.safetensors", model, {})
    loaded, about = load_head(tmp_path / "h.safetensors")
    assert loaded.shape == replace(SHAPE, members=2)
    assert about["format"] == "slamdepth-depth-head-8"
    field = fields((0.0, 0.8, 0.6), (0.6, 0.8, 0.0))[:, :, :6, :8]
    with torch.inference_mode():
        log_depth, _, _ = loaded(*ARGS, field)
        outs = [member(*ARGS, field)[:, 0] for member in loaded.members]
        assert float((log_depth - loaded(*ARGS)[0]).abs().max()) > 1e-4
    torch.testing.assert_close(log_depth, (outs[0] + outs[1]) / 2)


def test_a_head_that_reads_gravity_needs_a_scale_branch(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="needs a scale_dim above 0"):
        DepthHead(replace(SHAPE, scale_dim=0))
    shape = json.dumps({**asdict(SHAPE), "scale_dim": 0})
    about = {"format": FORMAT, "shape": shape, "sigma_scale": "1.0"}
    save_file({"a": torch.zeros(1)}, tmp_path / "bad.safetensors", metadata=pack_about(about))
    with pytest.raises(WeightsError, match="needs a scale_dim above 0"):
        load_head(tmp_path / "bad.safetensors")


def with_gravity(folder: Path, *gravities: np.ndarray, count: int = 4) -> Place:
    make_place(folder, count)
    lines = [f"{k:05d} {' '.join(f'{x:.8f}' for x in xyz)}\n" for k, xyz in enumerate(gravities)]
    (folder / "gravity.txt").write_text("".join(lines))
    return open_place(folder)


def test_gravity_txt(tmp_path: Path) -> None:
    gravities = [unit(0.1, 0.9, 0.3), unit(-1, 0, 0)]
    place = with_gravity(tmp_path / "room", *gravities)
    for index, gravity_c in enumerate(gravities):
        read = place.gravity(index)
        assert read is not None
        np.testing.assert_allclose(read, gravity_c, atol=1e-7)
    assert place.gravity(2) is None
    silent = open_place(make_place(tmp_path / "silent"))
    assert silent.gravity(0) is None
    other = with_gravity(tmp_path / "other", gravities[0], -gravities[1])  # a file of the same size
    assert len({place.fingerprint, silent.fingerprint, other.fingerprint}) == 3


@pytest.mark.parametrize(
    "line", ["00001", "00001 0 1", "00001 0 1 0 0", "00001 0 one 0", "00001 0 2 0", "00001 nan 1 0"]
)
def test_a_bad_line_of_gravity_txt_is_named(tmp_path: Path, line: str) -> None:
    folder = make_place(tmp_path / "room")
    (folder / "gravity.txt").write_text(f"00000 0 1 0\n\n{line}\n")
    with pytest.raises(DatasetError, match=r"gravity\.txt: line 3: expected a name and a unit direction"):
        open_place(folder)
    (folder / "gravity.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(DatasetError, match=r"gravity\.txt: not readable"):
        open_place(folder)


def test_gravity_is_read_from_the_place_or_estimated_from_lines_and_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[Camera] = []

    def lines(image_rgb: np.ndarray, camera: Camera) -> np.ndarray | None:
        looked.append(camera)
        return None if len(looked) == 1 else unit(0, 0.8, 0.6)

    monkeypatch.setattr(gravity, "gravity_if_upright", lines)
    monkeypatch.setattr(gravity, "_found", {})
    monkeypatch.setattr(gravity, "_MAX_CACHED", 2)
    place = with_gravity(tmp_path / "room", unit(0, 1, 0))
    np.testing.assert_array_equal(gravity.gravity_of(place, 0), [0, 1, 0])
    assert not looked
    for _ in range(2):
        assert gravity.gravity_of(place, 1) is None
        np.testing.assert_array_equal(gravity.gravity_of(open_place(tmp_path / "room"), 2), [0, 0.8, 0.6])
    assert looked == [place.camera] * 2
    gravity.gravity_of(place, 3)
    assert len(gravity._found) == 2  # the oldest was forgotten


NORMAL, DISTANCE_M = unit(0.1, -0.2, 0.9), 2.0


def plane_frame() -> Frame:
    camera = Camera(120, 90, 100.0, 100.0, 60.2, 44.1)
    u, v = np.meshgrid(np.arange(120.0), np.arange(90.0))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    depth = (DISTANCE_M / (rays @ NORMAL)).astype(np.float32)
    return Frame(0, 0.0, np.repeat((depth * 60).astype(np.uint8)[..., None], 3, 2), camera, depth)


def assert_the_plane_is_where_gravity_says(view: View, gravity_c: np.ndarray) -> None:
    """The plane is turned as ``gravity_c`` was: known from its depths, it makes the same angle with it."""
    v, u = np.nonzero(view.depth_m)
    assert len(u) > 0.3 * view.depth_m.size
    rays = np.column_stack([u - (COLUMNS - 1) / 2, v - (ROWS - 1) / 2, np.full(len(u), view.focal_px)])
    points = rays / view.focal_px * view.depth_m[v, u][:, None]
    found = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]
    assert 1 / np.linalg.norm(found) == pytest.approx(DISTANCE_M, rel=0.01)
    assert found @ view.gravity / np.linalg.norm(found) == pytest.approx(NORMAL @ gravity_c, abs=0.02)


GRAVITIES = st.builds(
    lambda roll, pitch: unit(
        np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), np.sin(pitch)
    ),
    st.floats(-np.pi, np.pi),
    st.floats(-1.0, 1.0),
)  # fmt: skip


@given(gravity_c=GRAVITIES, seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_views_are_turned_upright(gravity_c: np.ndarray, seed: int) -> None:
    frame = plane_frame()
    calm = CALM.model_copy(update={"max_tilt_deg": 0.0})
    for view in (
        unaugmented_view(frame, ROWS, COLUMNS, gravity_c),
        augmented_view(frame, ROWS, COLUMNS, calm, np.random.default_rng(seed), gravity_c),
    ):
        assert np.linalg.norm(view.gravity) == pytest.approx(1.0)
        assert view.gravity[0] == pytest.approx(0.0, abs=1e-9)
        assert view.gravity[1] > 0
        assert view.gravity[2] == pytest.approx(gravity_c[2])
        assert_the_plane_is_where_gravity_says(view, gravity_c)
    tilted = augmented_view(frame, ROWS, COLUMNS, CALM, np.random.default_rng(seed), gravity_c)
    assert_the_plane_is_where_gravity_says(tilted, gravity_c)


def rolled_deg(view: View) -> float:
    return float(np.degrees(roll_rad(view.gravity)))


def test_rolls_are_drawn_about_upright() -> None:
    gravity_c, rng = unit(-0.7, 0.5, 0.1), np.random.default_rng(0)
    calm = CALM.model_copy(update={"upright_roll_deg": 4.0, "max_tilt_deg": 0.0})
    rolls = [rolled_deg(augmented_view(plane_frame(), 28, 42, calm, rng, gravity_c)) for _ in range(60)]
    assert abs(np.mean(rolls)) < 1.6
    assert 3.0 < np.std(rolls) < 5.2
    wide = calm.model_copy(update={"rolled": 1.0, "max_roll_deg": 90.0})
    rolls = [rolled_deg(augmented_view(plane_frame(), 28, 42, wide, rng, gravity_c)) for _ in range(60)]
    assert np.abs(rolls).max() < 90
    assert np.std(rolls) > 40


@given(gravity_c=GRAVITIES, wanted=GRAVITIES, seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_partner_is_turned_until_gravity_points_as_wanted(
    gravity_c: np.ndarray, wanted: np.ndarray, seed: int
) -> None:
    """However differently the two cameras were rolled, upside down too."""
    pitch = np.arcsin(gravity_c[2]) + np.radians(10)  # no further apart than partners are
    wanted = np.append(wanted[:2] / np.linalg.norm(wanted[:2]) * np.cos(pitch), np.sin(pitch))
    view = matching_view(plane_frame(), ROWS, COLUMNS, CALM, np.random.default_rng(seed), gravity_c, wanted)
    np.testing.assert_array_equal(view.gravity, wanted)
    assert_the_plane_is_where_gravity_says(view, gravity_c)


def mixing(*places: Place) -> tuple[ViewConfig, list[Partner]]:
    augment = AugmentConfig(mixed=1.0, mixed_again=0.0)
    config = ViewConfig(rows=56, columns=70, augment=augment, upright=True)
    return config, [Partner(place, augment, 1.0) for place in places]


def test_what_is_mixed_into_a_view_shares_its_gravity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gravity, "gravity_if_upright", lambda image_rgb, camera: None)
    rolled = with_gravity(tmp_path / "rolled", *[unit(1, 0.1, 0.05)] * 4)
    level = with_gravity(tmp_path / "level", *[unit(0, 1, 0)] * 4)
    steep = with_gravity(tmp_path / "steep", *[unit(0, 0.2, 0.9)] * 4)
    silent = open_place(make_place(tmp_path / "silent"))
    places, key = [rolled, silent], SampleKey(0, 1, 2)
    config, partners = mixing(steep, level)
    taken: list[tuple[float, float]] = []

    def watched(*args: object) -> View:
        view = matching_view(*args)  # type: ignore[arg-type]
        taken.append((float(args[5][2]), float(view.gravity[2])))  # type: ignore[index]
        return view

    monkeypatch.setattr("slamdepth.training.views.matching_view", watched)
    mixed, again = (make_view(places, key, config, 3, partners) for _ in range(2))
    np.testing.assert_array_equal(mixed.image_rgb, again.image_rgb)
    alone = make_view(places, key, config, 3)
    np.testing.assert_array_equal(mixed.gravity, alone.gravity)
    assert mixed.gravity[1] > 0.9
    assert (mixed.image_rgb != alone.image_rgb).any()
    assert len(taken) == 2
    assert all(abs(np.degrees(np.arcsin(of) - np.arcsin(to))) < 16 for of, to in taken)
    # nothing fits: not mixed; unknown gravity of the first: mixed
    for others in ([steep], [silent]):
        unmixed = make_view(places, key, config, 3, mixing(*others)[1])
        np.testing.assert_array_equal(unmixed.image_rgb, alone.image_rgb)
    unknown, tilted = SampleKey(1, 0, 0), config.model_copy(update={"upright": False})
    as_ever = make_view(places, unknown, config, 3, partners)
    np.testing.assert_array_equal(
        as_ever.image_rgb, make_view(places, unknown, tilted, 3, partners).image_rgb
    )
    assert not as_ever.gravity.any()
    assert not make_view(places, key, tilted, 3, partners).gravity.any()


@pytest.mark.parametrize(("shape", "scale"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_only_what_a_sample_supervises_is_learnt(shape: float, scale: float) -> None:
    torch.manual_seed(4)
    head = DepthHead(SHAPE)
    target = torch.rand(2, 6, 8) + 1.0
    target[:, :2] = 0.0
    prediction = head.coarse(*ARGS)[0]
    supervision = torch.tensor([[shape, scale]] * 2)
    loss = total_loss(supervised(prediction, target, supervision), target, LossConfig())
    torch.autograd.backward(loss)
    assert head.scale_branch is not None
    assert head.out.weight.grad is not None
    assert head.scale_branch.out.bias.grad is not None
    of_shape = head.out.weight.grad[0].abs().max()  # log depth; the other row is its spread
    of_scale = head.scale_branch.out.bias.grad.abs().max()
    for found, is_supervised in ((of_shape, shape), (of_scale, scale)):
        assert float(found) > 1e-3 if is_supervised else float(found) < 1e-6  # rounding


def test_a_sample_that_does_not_supervise_scale_has_no_scale_loss() -> None:
    torch.manual_seed(5)
    prediction, target = torch.randn(2, 2, 6, 8), torch.rand(2, 6, 8) + 1.0
    both, shape_only = torch.ones(2, 2), torch.tensor([[1.0, 0.0], [1.0, 1.0]])
    assert supervised(prediction, target, both) is prediction
    losses = [total_loss(supervised(prediction, f * target, shape_only), f * target, LossConfig()) for f in
              (torch.ones(2, 1, 1), torch.tensor([3.0, 1.0])[:, None, None])]  # fmt: skip
    torch.testing.assert_close(*losses)
    corrected = supervised(prediction, target, shape_only)
    torch.testing.assert_close(corrected[1], prediction[1])
    error = corrected[0, 0] - target[0].log()
    assert float(error.mean()) == pytest.approx(0.0, abs=1e-6)


def training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **head: object) -> TrainConfig:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    with_gravity(tmp_path / "data" / "hall", *[unit(0.6, 0.8, 0.0)] * 4)
    with_gravity(tmp_path / "data" / "loft", unit(0, 0.9, -0.1), count=2)
    source = {"folder": str(tmp_path / "data")}
    return TrainConfig.from_dict({
        "output": str(tmp_path / "head.safetensors"),
        "coarse_epochs": 2,
        "batch": 3,
        "sources": [
            {
                **source,
                "places": [{"name": "hall", "samples": 4}],
                "supervision": "scale",
                "held_out": ["loft"],
            },
            {**source, "places": [{"name": "hall", "samples": 5}], "supervision": "shape"},
        ],
        "view": {"rows": 42, "columns": 56, "upright": True},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8, "scale_dim": 4, "gravity": True, **head},
    })  # fmt: skip


def test_caches_have_gravity_and_their_supervision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, backbone = training(tmp_path, monkeypatch), tiny_backbone()
    planned = plan_caches(config, "given")
    caches = [fill_cache(plan, config, backbone) for plan in planned]
    assert [cache.supervision for cache in caches] == ["scale", "shape", "both"]
    np.testing.assert_allclose(
        caches[2].gravity[0], unit(0, 0.9, -0.1), atol=1e-6
    )  # the unaugmented view of the loft
    field, depth = load_batch(caches[2], np.array([0]), "cpu")[3:]
    focal_px = torch.tensor([float(caches[2].focal_factor[0]) * CANONICAL_FOCAL_PX])
    torch.testing.assert_close(
        field, gravity_field(torch.from_numpy(caches[2].gravity[:1]), focal_px, 42, 56)
    )
    assert depth.shape == (1, 42, 56)
    batch, supervision = load_mixed_batch(caches, np.array([[2, 0], [1, 4], [0, 3], [1, 0]]), "cpu")
    assert supervision.tolist() == [[0, 1], [1, 0], [1, 0], [1, 1]]
    torch.testing.assert_close(batch[3][3], field[0])
    torch.testing.assert_close(batch[0][1], load_batch(caches[1], np.array([0]), "cpu")[0][0])
    lying = config.model_copy(update={"view": config.view.model_copy(update={"upright": False})})
    assert not {plan.folder for plan in planned} & {plan.folder for plan in plan_caches(lying, "given")}


def test_gravity_is_hidden_from_some_samples() -> None:
    torch.manual_seed(6)
    field = torch.ones(400, 4, 2, 2)
    batch = (torch.zeros(1), torch.zeros(1), torch.zeros(1), field, torch.zeros(1))
    config = HeadConfig(scale_dim=4, gravity=True, unknown_gravity=0.25)
    field_seen = hide_gravity(batch, config)[3]
    assert bool((field_seen.amin(dim=(1, 2, 3)) == field_seen.amax(dim=(1, 2, 3))).all())
    assert float(field_seen.mean()) == pytest.approx(0.75, abs=0.08)
    always, never = config.model_copy(update={"unknown_gravity": 0.0}), HeadConfig()
    torch.testing.assert_close(hide_gravity(batch, always)[3], field)
    assert hide_gravity(batch, never) is batch  # such a head does not read it


def test_a_head_learns_with_gravity_the_same_for_the_same_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = training(tmp_path, monkeypatch, unknown_gravity=0.5)
    result = loop.train_depth(config, backbone=tiny_backbone())
    first = result.output.read_bytes()
    head, _ = load_head(result.output)
    assert head.shape.gravity
    for name in ("field", "scale_branch.gravity"):
        assert bool(head.get_parameter(f"members.0.{name}.weight").any())
    assert loop.train_depth(config, backbone=tiny_backbone()).output.read_bytes() == first


def test_settings_that_do_not_go_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="setting 'head': gravity needs a scale_dim above 0"):
        training(tmp_path, monkeypatch, scale_dim=0)
