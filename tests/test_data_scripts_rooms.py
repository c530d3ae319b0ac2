# SPDX-License-Identifier: Apache-2.0
"""Synthetic rooms for training, and the views rendered of them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequences import imread

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"
sys.path.insert(0, str(SCRIPTS))

import render_training_rooms  # noqa: E402
from render_training_rooms import HEIGHT, WIDTH, handheld, main, room_views, write_gravity  # noqa: E402
from training_rooms import simple_scene, varied_scene  # noqa: E402

from slamdepth.synth.shapes import Surface  # noqa: E402
from slamdepth.training.readers.pairs import read_gravity  # noqa: E402

SMALL = ["--rooms", "1", "--views", "3", "--first-seed", "5000"]


@pytest.fixture(autouse=True)
def coarse_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Texels of 5 cm, which take a third of the time; poses and depths do not depend on them."""
    monkeypatch.setattr(render_training_rooms, "TEXEL_M", 0.05)


def rendered(folder: Path, *more: str) -> list[Path]:
    main([str(folder), *SMALL, *more])
    return sorted(folder.glob("*.jpg"))


@pytest.mark.parametrize("seed", [3, 5001])
def test_a_simple_room_is_the_varied_one_repainted(seed: int) -> None:
    varied, simple = varied_scene(seed).surfaces, simple_scene(seed).surfaces
    assert len(simple) == len(varied)
    for one, other in zip(varied, simple, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert one.emission == other.emission

    def texture(surface: Surface) -> np.ndarray:
        return surface.paint(np.random.default_rng(0), 40, 40, 0.01)

    glowing = [k for k, surface in enumerate(varied) if surface.emission > 0]
    assert glowing
    for k in glowing:
        np.testing.assert_array_equal(texture(simple[k]), texture(varied[k]))
    wall = max(range(1, len(varied)), key=lambda k: float(np.ptp(varied[k].points.reshape(-1, 3)[:, 2])))
    assert texture(simple[wall]).std(axis=(0, 1)).max() < 0.05


def test_views_are_pairs_and_reproducible(tmp_path: Path) -> None:
    first, again = rendered(tmp_path / "a", "--simple"), rendered(tmp_path / "b", "--simple")
    assert [p.name for p in first] == ["00000.jpg", "00001.jpg", "00002.jpg"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]
    about = json.loads((tmp_path / "a" / "camera.json").read_text(encoding="utf-8"))
    for image in first:
        depth = imread(image.with_suffix(".png"), cv2.IMREAD_UNCHANGED)
        assert depth.shape == (about["height"], about["width"])
        assert np.percentile(depth, 95) > 1.2 * np.percentile(depth, 5)  # not a piece of wall
    gravity = read_gravity(tmp_path / "a" / "gravity.txt")
    assert list(gravity) == [image.stem for image in first]
    np.testing.assert_allclose(np.linalg.norm(list(gravity.values()), axis=1), 1.0, atol=1e-5)  # six decimals


def test_a_handheld_camera_is_at_the_height_of_a_person() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0], [5, 4, 2.6], (500, 3))
    views = np.array([handheld(points, rng) for _ in range(500)])
    height, target_height = views[:, 0, 2], views[:, 1, 2]
    assert 0.65 < height.min() < height.max() < 2.1  # four standard deviations below sitting, above standing
    assert 0.2 < (height < 1.25).mean() < 0.5  # 40 % sit, some of them tall
    assert (target_height < height).mean() > 0.6  # people mostly look down


def height_below(depth: np.ndarray, gravity: np.ndarray, focal_px: float) -> np.ndarray:
    """Distance in metres of each pixel below the camera."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (u - (WIDTH - 1) / 2) / focal_px, (v - (HEIGHT - 1) / 2) / focal_px
    return np.asarray((x * gravity[0] + y * gravity[1] + gravity[2]) * depth)


@pytest.mark.parametrize("by_hand", [True, False], ids=["by hand", "from anywhere"])
def test_gravity_points_to_the_floor(by_hand: bool) -> None:
    views = room_views(5000, 4, 265.0, by_hand=by_hand)
    assert len(views) == 4
    floors = 0
    for _, depth, gravity in views:
        assert np.linalg.norm(gravity) == pytest.approx(1.0)
        below = height_below(depth, gravity, 265.0)
        lowest = np.percentile(below, 99.9)
        on_floor = np.abs(below - lowest) < 1e-3  # a tilt of 0.1 degrees is 2 mm per metre
        floors += on_floor.mean() > 0.03
        if by_hand:
            assert lowest < 2.1  # nothing is below the floor
            assert abs(np.degrees(np.arctan2(gravity[0], gravity[1]))) < 25  # rolled by 5 degrees or so
        else:
            assert np.degrees(np.arcsin(gravity[2])) > -8.5  # from 8 degrees below the target to 80 above
    assert floors >= 2


def note(folder: Path, room: int, text: str) -> None:
    (folder / f".{room:05d}.done").write_text(text, encoding="utf-8")
    (folder / f"{room * 1000:05d}.png").touch()


def test_gravity_of_all_rooms_is_in_order(tmp_path: Path) -> None:
    note(tmp_path, 101, "101000 0 1 0\n")
    note(tmp_path, 2, "02000 0 0.6 0.8\n02001 1 0 0\n")
    note(tmp_path, 0, "00000 0 1 0\n")
    (tmp_path / ".00001.done").touch()  # no view of that room was good enough
    write_gravity(tmp_path)
    lines = (tmp_path / "gravity.txt").read_text(encoding="utf-8").splitlines()
    assert lines == ["00000 0 1 0", "02000 0 0.6 0.8", "02001 1 0 0", "101000 0 1 0"]


def test_a_room_without_gravity_has_to_be_rendered_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    note(tmp_path, 0, "")
    with pytest.raises(SystemExit) as leaving:
        main([str(tmp_path), *SMALL])
    assert leaving.value.code == 2
    assert ".00000.done: has no directions of gravity; delete it" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "gravity.txt").exists()
