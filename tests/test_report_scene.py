# SPDX-License-Identifier: Apache-2.0
"""The scene of a run: what is in it, its file, and its part of the page."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import leave_out_plots
from report_data import bare_data, full_data
from scene_data import data_with_scene, room_mesh, room_scene, several_maps_with_scene

from slamdepth.errors import DatasetError, SlamdepthError
from slamdepth.mapping.mesh import Mesh
from slamdepth.report import ReportData, build_html, build_summary
from slamdepth.report.scene import (
    Scene,
    read_scene,
    scene_json,
    scene_of,
    three_js,
    with_small_meshes,
    write_scene,
)
from slamdepth.report.scene.page_data import first_view, segments
from slamdepth.report.scene.simplify import simplified


def page_of(data: ReportData) -> str:
    return build_html(data, build_summary(data))


def same(one: Scene, other: Scene) -> bool:
    a, b = (scene_json(replace(s, maps=tuple(replace(m, mesh=None) for m in s.maps))) for s in (one, other))
    return a == b


def test_a_scene_has_path_keyframes_images_loops_and_truth() -> None:
    scene = room_scene()
    (one,) = scene.maps
    assert (len(one.path), len(one.keyframes), len(one.thumbnails)) == (70, 6, 6)
    assert one.loops.tolist() == [[0, 5], [1, 4]]
    assert one.truth is not None
    assert len(one.truth) == 70
    gap = np.linalg.norm(one.truth.T_world_camera[:, :3, 3] - one.path.T_world_camera[:, :3, 3], axis=1)
    assert np.median(gap) < 0.05
    assert 0.5 < scene.near_m < scene.far_m < 4.0
    image = cv2.imdecode(np.frombuffer(one.thumbnails[2].image, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (192, 256, 3)


def test_images_are_few_and_evenly_spread_over_the_maps() -> None:
    run = full_data().reconstruction
    scene = scene_of(replace(run, others=(replace(run, keyframes=run.keyframes[:3]),)), [], [], 4)
    rows = [[thumbnail.row for thumbnail in one.thumbnails] for one in scene.maps]
    assert rows == [[0, 5], [0]]
    assert [len(one.keyframes) for one in scene.maps] == [6, 3]


def test_a_run_without_frames_has_an_empty_scene_and_a_page_without_script() -> None:
    data = bare_data()
    scene = scene_of(data.reconstruction, [None], [None])
    assert [len(one.path) for one in scene.maps] == [0]
    assert "<script" not in page_of(replace(data, scene=scene))


def test_the_file_gives_back_the_scene_without_mesh_and_path(tmp_path: Path) -> None:
    scene = several_maps_with_scene().scene
    assert scene is not None
    write_scene(tmp_path / "scene.safetensors", scene)
    back = read_scene(tmp_path / "scene.safetensors")
    assert back.camera == scene.camera
    assert all(one.mesh is None and len(one.path) == 0 for one in back.maps)
    filled = zip(back.maps, scene.maps, strict=True)
    back = replace(back, maps=tuple(replace(one, path=other.path) for one, other in filled))
    rounded = tuple(
        replace(one, points_m=one.points_m.astype(np.float32).astype(np.float64), truth=None)
        for one in scene.maps
    )
    assert same(back, replace(scene, maps=rounded))
    write_scene(tmp_path / "again.safetensors", scene)
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "scene.safetensors").read_bytes()


def test_a_damaged_or_foreign_or_newer_file_is_refused_by_name(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    path = tmp_path / "scene.safetensors"
    write_scene(path, room_scene())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=r"scene\.safetensors: cannot be read"):
        read_scene(path)
    save_file({"a": np.zeros(1)}, path)
    with pytest.raises(DatasetError, match="is no scene"):
        read_scene(path)
    save_file(
        {"a": np.zeros(1)}, path, {"slamdepth": json.dumps({"format": "slamdepth scene", "version": 9})}
    )
    with pytest.raises(DatasetError, match="has version 9"):
        read_scene(path)
    save_file({"a": np.zeros(1)}, path, {"slamdepth": "[]"})
    with pytest.raises(DatasetError, match="is no scene"):
        read_scene(path)
    save_file({"a": np.zeros(1)}, path, {"slamdepth": "[" * 100_000})  # too deeply nested to be decoded
    with pytest.raises(DatasetError, match=r"scene\.safetensors: cannot be read"):
        read_scene(path)
    scene = room_scene()
    write_scene(path, replace(scene, maps=(replace(scene.maps[0], loops=np.array([[0, 6]])),)))
    with pytest.raises(DatasetError, match=r"scene\.safetensors: cannot be read: 1/loops names a keyframe"):
        read_scene(path)


def test_a_large_mesh_is_thinned_out_and_keeps_shape_and_colours() -> None:
    mesh = room_mesh(cells=60)
    small = simplified(mesh, 4000)
    assert 2000 < len(small.triangles) <= 4100
    np.testing.assert_allclose(small.vertices_m.min(axis=0), mesh.vertices_m.min(axis=0), atol=0.02)
    colours = np.unique(np.round(mesh.colors * 255), axis=0)
    distance = np.abs(np.round(small.colors * 255)[:, None] - colours).sum(axis=2).min(axis=1)
    assert np.mean(distance < 12) > 0.9
    assert simplified(mesh, 10**6) is mesh


def test_all_maps_share_the_triangles_of_a_page() -> None:
    scene = room_scene()
    one = replace(scene.maps[0], mesh=room_mesh(cells=30))
    small = with_small_meshes(replace(scene, maps=(one, one)), 2000)
    counts = [len(m.mesh.triangles) for m in small.maps if m.mesh is not None]
    assert sum(counts) <= 2100
    assert counts[0] == counts[1]


def test_a_path_is_broken_where_frames_were_lost() -> None:
    path = room_scene().maps[0].path
    assert len(segments(path)) == len(path) - 2


def test_the_first_view_sees_the_room_from_above() -> None:
    one = room_scene().maps[0]
    for shown in (one, replace(one, mesh=None)):
        eye, target, up, size = first_view(shown)
        assert (eye - target) @ up > 0
        assert size > 1.0


def test_three_js_is_there_with_its_licence() -> None:
    script = three_js()
    assert script.startswith("/**")
    assert "Three.js Authors" in script[:200]
    assert "SPDX-License-Identifier: MIT" in script[:200]
    assert "GLTFLoader" not in script
    assert 500_000 < len(script) < 800_000


def test_the_page_allows_its_own_scripts_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
    page = page_of(data_with_scene())
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    allowed = html.unescape(policy[1])
    assert "default-src 'none'" in allowed
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in allowed
    assert page_of(data_with_scene()) == page
    verdict, scene, tiles = (page.index(text) for text in ('class="verdict', 'id="scene"', 'class="tiles"'))
    assert verdict < scene < tiles


def test_without_three_js_the_page_has_no_3d_view_and_a_warning_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    leave_out_plots(monkeypatch)

    def missing() -> str:
        raise SlamdepthError("three.js is gone")

    monkeypatch.setattr("slamdepth.report.scene.page.three_js", missing)
    assert "<script" not in page_of(data_with_scene())
    assert "the page has no 3D view: three.js is gone" in caplog.text


def test_the_largest_page_stays_under_15_mb(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many triangles, points, poses and images as a page takes, none of which compresses."""
    leave_out_plots(monkeypatch)
    data = data_with_scene()
    assert data.scene is not None
    rng = np.random.default_rng(0)
    one = data.scene.maps[0]
    mesh = Mesh(
        rng.normal(size=(100_000, 3)).astype(np.float32),
        rng.integers(0, 100_000, (200_000, 3)).astype(np.int32),
        rng.random((100_000, 3)).astype(np.float32),
    )
    thumbnails = tuple(
        replace(one.thumbnails[0], image=b"x" * 20_000, depth=b"x" * 10_000) for _ in range(160)
    )
    large = replace(one, mesh=mesh, points_m=rng.normal(size=(30_000, 3)), thumbnails=thumbnails)
    page = page_of(replace(data, scene=replace(data.scene, maps=(large,))))
    assert len(page) < 13_000_000
