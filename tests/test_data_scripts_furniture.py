# SPDX-License-Identifier: Apache-2.0
"""Furniture from catalogues and the rooms furnished with it, with a synthetic library."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"
sys.path.insert(0, str(SCRIPTS))

import render_training_rooms  # noqa: E402
from furnished_rooms import furnished_scene  # noqa: E402
from furniture_models import Material, Mesh, load_mesh, read_catalogues  # noqa: E402
from mesh_render import MeshRenderer, MeshScene  # noqa: E402
from render_training_rooms import main  # noqa: E402

from slamdepth.synth.scene import Lamp  # noqa: E402
from slamdepth.types import Camera  # noqa: E402

# A box of 2 x 4 x 6 (y up) with a red front (+z), a glass top and a texture on the rest.
BOX = """mtllib box.mtl
v 0 0 0\nv 2 0 0\nv 2 4 0\nv 0 4 0\nv 0 0 6\nv 2 0 6\nv 2 4 6\nv 0 4 6
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1
usemtl red\nf 5/1 6/2 7/3 8/4
usemtl glass\nf 4/1 3/2 7/3 8/4
usemtl textured\nf -8/-4 -7/-3 -6/-2 -5/-1\nf 1 2 6 5\nf 1 5 8 4\nf 2 3 7 6
"""
MATERIALS = """newmtl red\nKd 0.9 0.1 0.1\nd 1
newmtl glass\nKd 1 1 1\nd 0.2
newmtl textured\nKd 1 1 1\nmap_Kd half.png
"""


def entry(number: int, **values: object) -> str:
    usual = {"name": "Box", "category": "Office", "model": "/box.obj", "width": 80, "depth": 40, "height": 70}
    return "".join(f"{key}#{number}={value}\n" for key, value in {**usual, **values}.items())


def library(folder: Path, *entries: str) -> Path:
    """A folder like that of unpacked libraries."""
    shop = folder / "shop"
    shop.mkdir(parents=True)
    (shop / "box.obj").write_text(BOX, encoding="latin-1")
    (shop / "box.mtl").write_text(MATERIALS, encoding="latin-1")
    half = np.zeros((8, 8, 3), np.uint8)
    half[:4, :, 0] = 255  # blue above, as OpenCV orders colours
    cv2.imwrite(str(shop / "half.png"), half)
    (shop / "PluginFurnitureCatalog.properties").write_text(
        "id=shop\n" + "".join(entries), encoding="latin-1"
    )
    return folder


def test_a_catalogue_gives_sizes_in_metres_and_heights_of_tops(tmp_path: Path) -> None:
    folder = library(
        tmp_path, entry(1), entry(2, dropOnTopElevation=-1, elevation=145), entry(3, dropOnTopElevation=48),
        entry(4, model="/missing.obj"),
    )  # fmt: skip
    first, hung, low = read_catalogues(folder)
    assert first.size_m == (0.8, 0.4, 0.7)
    assert (first.top_m, hung.top_m, low.top_m) == (0.7, None, 0.48)
    assert (first.elevation_m, hung.elevation_m) == (0.0, 1.45)


def test_a_model_is_scaled_with_its_front_towards_minus_y(tmp_path: Path) -> None:
    (piece,) = read_catalogues(library(tmp_path, entry(1)))
    mesh = load_mesh(piece)
    assert mesh is not None
    np.testing.assert_allclose(mesh.corners.min(axis=(0, 1)), [-0.4, -0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(mesh.corners.max(axis=(0, 1)), [0.4, 0.2, 0.7], atol=1e-9)
    colours = [material.image for material in mesh.materials]
    red = next(k for k, image in enumerate(colours) if image.shape == (1, 1, 3) and image[0, 0, 0] > 0.8)
    assert np.all(mesh.corners[mesh.material == red][..., 1] == pytest.approx(-0.2))
    assert len(mesh.corners) == 2 * 5  # the glass top is left out


def test_a_model_is_rotated_as_its_catalogue_says(tmp_path: Path) -> None:
    (piece,) = read_catalogues(library(tmp_path, entry(1, modelRotation="0 0 1 0 1 0 -1 0 0")))
    mesh = load_mesh(piece)
    assert mesh is not None
    red = next(
        k for k, m in enumerate(mesh.materials) if m.image.shape == (1, 1, 3) and m.image[0, 0, 0] > 0.8
    )
    assert np.all(mesh.corners[mesh.material == red][..., 0] == pytest.approx(0.4))


def test_a_texture_is_upright_and_depth_is_along_z() -> None:
    upper = np.zeros((32, 32, 3), np.float32)
    upper[:16, :, 2] = 0.8
    corners = np.array([[[-1, 2, 1], [-1, 2, -1], [1, 2, 1]], [[1, 2, 1], [-1, 2, -1], [1, 2, -1]]], float)
    uv = np.array([[[0, 0], [0, 1], [1, 0]], [[1, 0], [0, 1], [1, 1]]], float)
    mesh = Mesh(corners, uv, np.zeros(2, np.int32), (Material(upper),))
    scene = MeshScene(mesh, [Lamp((0, 0, 0), (0.1, 0, 0), (0, 0, 0.1), (2, 2, 2))], np.full(3, 0.5))
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # looks along +y, z up
    colour, depth = MeshRenderer(scene, Camera(40, 30, 60, 60, 19.5, 14.5), 0).render(T_world_camera)
    np.testing.assert_allclose(depth, 2.0, rtol=1e-5)
    assert colour[3, :, 2].min() > 100
    assert colour[-4, :, 2].max() < 20


def test_furniture_is_within_the_walls(tmp_path: Path) -> None:
    pieces = read_catalogues(
        library(
            tmp_path, entry(1), entry(2, category="Kitchen", elevation=145, dropOnTopElevation=-1),
            entry(3, width=12, depth=8, height=9, category="Miscellaneous"),
            entry(4, width=50, depth=40, height=170, category="Characters"),
        )
    )  # fmt: skip
    for seed in range(4):
        corners = furnished_scene(seed, pieces).mesh.corners.reshape(-1, 3)
        floor = corners[np.abs(corners[:, 2]) < 1e-6]
        low, high = floor.min(axis=0)[:2], floor.max(axis=0)[:2]
        inside = ((corners[:, :2] > low - 0.3) & (corners[:, :2] < high + 0.3)).all(axis=1)
        assert inside.mean() > 0.97
        assert corners[:, 2].min() > -0.02


def test_furnished_views_are_reproducible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_training_rooms, "WIDTH", 112)
    monkeypatch.setattr(render_training_rooms, "HEIGHT", 84)
    monkeypatch.setattr(render_training_rooms, "MIN_MATERIALS", 3)
    folder = library(tmp_path / "furniture", entry(1), entry(2, width=12, depth=8, height=9))
    made = []
    for name in ("a", "b"):
        options = ["--rooms", "1", "--views", "2", "--focal-px", "88", "--furniture", str(folder)]
        main([str(tmp_path / name), *options])
        made.append([path.read_bytes() for path in sorted((tmp_path / name).glob("*.[jp][pn]g"))])
    assert len(made[0]) == 4
    assert made[0] == made[1]


@pytest.mark.parametrize(("more", "says"), [([], "no catalogue"), (["--simple"], "leave one of them out")])
def test_a_folder_without_catalogues_is_one_clear_line(
    tmp_path: Path, more: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as leaving:
        main([str(tmp_path / "out"), "--furniture", str(tmp_path), *more])
    assert leaving.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
