# SPDX-License-Identifier: Apache-2.0
"""Mesh files, read back by Open3D."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from slamdepth.errors import OutputError
from slamdepth.mapping.mesh import Mesh
from slamdepth.open3d_loader import import_open3d


@pytest.fixture
def mesh() -> Mesh:
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-2, 2, (60, 3)).astype(np.float32)
    triangles = np.array([rng.choice(60, 3, replace=False) for _ in range(90)], np.int32)
    triangles[:20] = np.arange(60).reshape(20, 3)  # every vertex is used: some readers drop the others
    return Mesh(vertices, triangles, rng.uniform(0, 1, (60, 3)).astype(np.float32))


@pytest.mark.parametrize("ending", [".ply", ".obj", ".PLY"])
def test_open3d_reads_back_what_was_written(tmp_path: Path, mesh: Mesh, ending: str) -> None:
    path = tmp_path / f"mesh{ending}"
    mesh.save(path)
    read = import_open3d().io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(np.asarray(read.vertices), mesh.vertices_m, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(read.triangles), mesh.triangles)
    np.testing.assert_allclose(np.asarray(read.vertex_colors), mesh.colors, atol=0.6 / 255)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_glb_holds_the_mesh_in_linear_colour(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.glb"
    mesh.save(path)
    data = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + json_length])
    binary = data[20 + json_length + 8 :]
    assert json_length % 4 == len(binary) % 4 == 0
    assert document["buffers"][0]["byteLength"] == len(binary)

    def accessor(index: int, dtype: str, columns: int) -> np.ndarray:
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, dtype).reshape(-1, columns)

    np.testing.assert_array_equal(accessor(0, "<f4", 3), mesh.vertices_m)
    np.testing.assert_array_equal(accessor(2, "<u4", 3), mesh.triangles)
    linear = accessor(1, "<u2", 4)[:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb, mesh.colors, atol=1e-3)


def test_open3d_reads_the_glb(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.glb"
    mesh.save(path)
    read = import_open3d().io.read_triangle_mesh(str(path))
    assert len(read.vertices) == 60
    assert len(read.triangles) == 90
    assert read.has_vertex_colors()


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb"])
def test_an_empty_mesh_is_a_valid_file(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"empty{ending}"
    Mesh.empty("nothing").save(path)
    assert path.stat().st_size > 10


def test_same_mesh_same_bytes(tmp_path: Path, mesh: Mesh) -> None:
    for ending in (".ply", ".obj", ".glb"):
        mesh.save(tmp_path / f"a{ending}")
        mesh.save(str(tmp_path / f"b{ending}"))
        assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


@pytest.mark.parametrize("name", ["mesh.stl", "mesh", "mesh.ply.gz"])
def test_an_unknown_ending_lists_the_known(tmp_path: Path, mesh: Mesh, name: str) -> None:
    with pytest.raises(OutputError, match=r"\.ply, \.obj, \.glb"):
        mesh.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_an_unwritable_place_is_an_output_error(tmp_path: Path, mesh: Mesh) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        mesh.save(tmp_path / "missing" / "mesh.ply")


def test_shapes_are_checked() -> None:
    none = np.zeros((0, 3), np.float32)
    with pytest.raises(ValueError, match="outside"):
        Mesh(none, np.zeros((1, 3), np.int32), none)
    with pytest.raises(ValueError, match="colours"):
        Mesh(none, np.zeros((0, 3), np.int32), np.zeros((2, 3), np.float32))
