# SPDX-License-Identifier: Apache-2.0
"""The rooms that training views are rendered of."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"
sys.path.insert(0, str(SCRIPTS))

from render_training_rooms import HEIGHT, WIDTH, filmed, room_views, write_gravity  # noqa: E402
from training_rooms import plain_scene, varied_scene  # noqa: E402

from slamdepth.synth.shapes import Surface  # noqa: E402
from slamdepth.training.readers.pairs import read_gravity  # noqa: E402

SMALL = ["--rooms", "1", "--views", "3", "--first-seed", "5000"]


def rendered(folder: Path, *more: str) -> list[Path]:
    script = str(SCRIPTS / "render_training_rooms.py")
    subprocess.run([sys.executable, script, str(folder), *SMALL, *more], check=True, capture_output=True)
    return sorted(folder.glob("*.jpg"))


@pytest.mark.parametrize("seed", [3, 5001])
def test_a_plain_room_is_the_varied_one_painted_anew(seed: int) -> None:
    varied, plain = varied_scene(seed).surfaces, plain_scene(seed).surfaces
    assert len(plain) == len(varied)
    for one, other in zip(varied, plain, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert one.emission == other.emission

    def texture(surface: Surface) -> np.ndarray:
        return surface.paint(np.random.default_rng(0), 40, 40, 0.01)

    glowing = [k for k, surface in enumerate(varied) if surface.emission > 0]
    assert glowing
    for k in glowing:
        np.testing.assert_array_equal(texture(plain[k]), texture(varied[k]))
    wall = max(range(1, len(varied)), key=lambda k: float(np.ptp(varied[k].points.reshape(-1, 3)[:, 2])))
    assert texture(plain[wall]).std(axis=(0, 1)).max() < 0.05


def test_views_are_pairs_and_come_out_the_same_again(tmp_path: Path) -> None:
    first, again = rendered(tmp_path / "a", "--plain"), rendered(tmp_path / "b", "--plain")
    assert [p.name for p in first] == ["00000.jpg", "00001.jpg", "00002.jpg"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]
    about = json.loads((tmp_path / "a" / "camera.json").read_text(encoding="utf-8"))
    for image in first:
        depth = cv2.imread(str(image.with_suffix(".png")), cv2.IMREAD_UNCHANGED)
        assert depth.shape == (about["height"], about["width"])
        assert np.percentile(depth, 95) > 1.2 * np.percentile(depth, 5)  # not a piece of wall
    told = read_gravity(tmp_path / "a" / "gravity.txt")
    assert list(told) == [image.stem for image in first]
    np.testing.assert_allclose(np.linalg.norm(list(told.values()), axis=1), 1.0, atol=1e-5)  # six decimals


def test_who_films_stands_or_sits() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0], [5, 4, 2.6], (500, 3))
    views = np.array([filmed(points, rng) for _ in range(500)])
    height, target_height = views[:, 0, 2], views[:, 1, 2]
    assert 0.65 < height.min() < height.max() < 2.1  # four standard deviations below sitting, above standing
    assert 0.2 < (height < 1.25).mean() < 0.5  # two of five sit, some of them tall
    assert (target_height < height).mean() > 0.6  # most of what people look at is below their eyes


def height_below(depth: np.ndarray, down: np.ndarray, focal_px: float) -> np.ndarray:
    """How far below the camera each pixel lies, in metres."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (u - (WIDTH - 1) / 2) / focal_px, (v - (HEIGHT - 1) / 2) / focal_px
    return np.asarray((x * down[0] + y * down[1] + down[2]) * depth)


@pytest.mark.parametrize("by_hand", [True, False], ids=["by hand", "from anywhere"])
def test_down_is_where_the_floor_is(by_hand: bool) -> None:
    views = room_views(5000, 4, 265.0, by_hand=by_hand)
    assert len(views) == 4
    floors = 0
    for _, depth, down in views:
        assert np.linalg.norm(down) == pytest.approx(1.0)
        below = height_below(depth, down, 265.0)
        lowest = np.percentile(below, 99.9)
        on_floor = np.abs(below - lowest) < 1e-3  # a tilt of 0.1 degrees is 2 mm a metre
        floors += on_floor.mean() > 0.03
        if by_hand:
            assert lowest < 2.1  # nothing is below the floor
            assert abs(np.degrees(np.arctan2(down[0], down[1]))) < 25  # rolled by 5 degrees or so
        else:
            assert np.degrees(np.arcsin(down[2])) > -8.5  # things are seen from 8 degrees below to 80 above
    assert floors >= 2


def note(folder: Path, room: int, text: str) -> None:
    (folder / f".{room:05d}.done").write_text(text, encoding="utf-8")
    (folder / f"{room * 1000:05d}.png").touch()


def test_gravity_of_all_rooms_comes_in_order(tmp_path: Path) -> None:
    note(tmp_path, 101, "101000 0 1 0\n")
    note(tmp_path, 2, "02000 0 0.6 0.8\n02001 1 0 0\n")
    note(tmp_path, 0, "00000 0 1 0\n")
    (tmp_path / ".00001.done").touch()  # no view of that room was good enough
    write_gravity(tmp_path)
    lines = (tmp_path / "gravity.txt").read_text(encoding="utf-8").splitlines()
    assert lines == ["00000 0 1 0", "02000 0 0.6 0.8", "02001 1 0 0", "101000 0 1 0"]


def test_a_room_that_does_not_say_where_down_is_has_to_be_rendered_again(tmp_path: Path) -> None:
    note(tmp_path, 0, "")
    script = str(SCRIPTS / "render_training_rooms.py")
    done = subprocess.run(
        [sys.executable, script, str(tmp_path), *SMALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert ".00000.done: does not say where down is; delete it" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "gravity.txt").exists()
