# SPDX-License-Identifier: Apache-2.0
"""The converters: what goes in comes out of the TUM reader again."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequences import make_sevenscenes, make_tum, poses, write_image

from slamdepth.datasets import Dataset, ReadOptions, open_dataset
from slamdepth.errors import DatasetError

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"


@pytest.fixture
def sevenscenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("convert_7scenes")


@pytest.fixture
def icl(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("convert_icl_nuim")


def assert_same(first: Dataset, second: Dataset, indices: list[int]) -> None:
    assert len(first) == len(second)
    assert first.camera == second.camera
    np.testing.assert_array_equal(first.timestamps_s, second.timestamps_s)
    assert first.ground_truth is not None
    assert second.ground_truth is not None
    np.testing.assert_array_equal(first.ground_truth.timestamps_s, second.ground_truth.timestamps_s)
    np.testing.assert_allclose(
        first.ground_truth.T_world_camera, second.ground_truth.T_world_camera, rtol=0, atol=2e-9
    )
    for index in indices:
        a, b = first.read(index, with_depth=True), second.read(index, with_depth=True)
        np.testing.assert_array_equal(a.image_rgb, b.image_rgb)
        assert a.depth_m is not None
        assert b.depth_m is not None
        np.testing.assert_array_equal(a.depth_m, b.depth_m)


@pytest.mark.parametrize("link", [False, True])
def test_sevenscenes_through_both_readers(sevenscenes: ModuleType, tmp_path: Path, link: bool) -> None:
    source = make_sevenscenes(tmp_path / "seq-01")
    # No 65535 in the last one: it can be linked as it is.
    write_image(source / "frame-000002.depth.png", np.full((480, 640), 700, np.uint16))
    output = tmp_path / "out"
    assert sevenscenes.main([str(source), str(output), *(["--link"] if link else [])]) == 0
    converted = open_dataset(output, options=ReadOptions(follow_links=link))
    assert_same(open_dataset(source), converted, [0, 1, 2])
    assert converted.notes == []
    assert (output / "rgb" / "frame-000000.png").is_symlink() == link
    assert (output / "depth" / "frame-000002.png").is_symlink() == link
    assert not (output / "depth" / "frame-000001.png").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "seq-01"]


@pytest.mark.data
def test_real_kitchen_through_both_readers(sevenscenes: ModuleType, data_dir: Path, tmp_path: Path) -> None:
    source, output = data_dir / "7scenes_redkitchen_seq-01", tmp_path / "out"
    assert sevenscenes.convert(source, output, link=True) == 300
    converted = open_dataset(output, options=ReadOptions(follow_links=True))
    assert_same(open_dataset(source), converted, [0, 137, 299])


def test_refuses_other_folders_and_used_outputs(
    sevenscenes: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum = make_tum(tmp_path / "tum")
    assert sevenscenes.main([str(tum), str(tmp_path / "out")]) == 2
    assert "is no 7-Scenes sequence" in capsys.readouterr().err
    source = make_sevenscenes(tmp_path / "seq", 1)
    assert sevenscenes.main([str(source), str(tum)]) == 2
    error = capsys.readouterr().err
    assert "is there already and not empty" in error
    assert error.count("\n") == 1
    (source / "frame-000000.depth.png").write_bytes(b"")
    assert sevenscenes.main([str(source), str(tmp_path / "out")]) != 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seq", "tum"], "nothing half-written"


# ICL-NUIM


def make_icl(folder: Path, count: int = 3, first: int = 1) -> Path:
    """Images numbered from 0; poses numbered from ``first``, as the archives differ in that."""
    for i in range(count):
        write_image(folder / "rgb" / f"{i}.png", np.full((480, 640, 3), 40 * i, np.uint8))
        write_image(folder / "depth" / f"{i}.png", np.full((480, 640), 5000 + i, np.uint16))
    (folder / "associations.txt").write_text(
        "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(count))
    )
    rows = []
    for i, T in enumerate(poses(count)[first:], first):
        quat_xyzw = Rotation.from_matrix(T[:3, :3]).as_quat()
        rows.append(" ".join(map(repr, [i, *T[:3, 3].tolist(), *quat_xyzw.tolist()])))
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(rows) + "\n\n")
    return folder


def test_icl_nuim(icl: ModuleType, tmp_path: Path) -> None:
    source, output = make_icl(tmp_path / "traj0"), tmp_path / "out"
    assert icl.main([str(source), str(output)]) == 0
    dataset = open_dataset(output)
    camera = dataset.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (481.2, 480.0, 319.5, 239.5)
    assert (camera.depth_factor, camera.distortion) == (5000.0, (0.0,) * 5)
    np.testing.assert_array_equal(dataset.timestamps_s, np.arange(3) / 30)
    frame = dataset.read(2, with_depth=True)
    assert (frame.image_rgb == 80).all()
    assert frame.depth_m is not None
    assert (frame.depth_m == np.float32(5002 / 5000)).all()

    assert dataset.ground_truth is not None
    np.testing.assert_array_equal(dataset.ground_truth.timestamps_s, np.array([1, 2]) / 30)
    # Written out: y of the world and of the camera change sign.
    signs = np.array([[1, -1, 1, 1], [-1, 1, -1, -1], [1, -1, 1, 1], [1, -1, 1, 1]])
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera, poses(3)[1:] * signs, atol=2e-9)


def test_icl_nuim_seen_through_the_flip(icl: ModuleType, tmp_path: Path) -> None:
    # A camera of the y-up world that moves up must move along -y once y points down.
    source = make_icl(tmp_path / "traj0")
    (source / "livingRoom0.gt.freiburg").write_text("0 0 0 0 0 0 0 1\n1 0 1 0 0 0 0 1\n")
    ground_truth = icl.read_ground_truth(source)
    np.testing.assert_array_equal(ground_truth.T_world_camera[1, :3, 3], [0, -1, 0])
    np.testing.assert_array_equal(ground_truth.T_world_camera[:, :3, :3], np.tile(np.eye(3), (2, 1, 1)))
    (source / "livingRoom0.gt.freiburg").unlink()
    assert icl.read_ground_truth(source) is None


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", "associations.txt: lists no images"),
        ("0 depth/0.png 0\n", "associations.txt:1: expected 'N depth/N.png N rgb/N.png'"),
        ("0 depth/0.png 0 depth/1.png\n", "associations.txt:1: expected"),
        ("0.5 depth/0.png 0.5 rgb/0.png\n", "associations.txt:1: expected"),
        (
            "0 depth/0.png 0 rgb/0.png\n0 depth/1.png 0 rgb/1.png\n",
            "associations.txt:2: frame 0 does not come after 0",
        ),
        ("0 depth/0.png 0 rgb/9.png\n", "associations.txt:1: "),
    ],
)
def test_icl_nuim_bad_input(icl: ModuleType, tmp_path: Path, text: str, where: str) -> None:
    source = make_icl(tmp_path / "traj0")
    (source / "associations.txt").write_text(text)
    with pytest.raises(DatasetError) as caught:
        icl.convert(source, tmp_path / "out")
    assert where in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_icl_nuim_missing_parts(icl: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        icl.convert(tmp_path / "none", tmp_path / "out")
    source = make_icl(tmp_path / "traj0")
    shutil.copy(source / "livingRoom0.gt.freiburg", source / "b.gt.freiburg")
    with pytest.raises(DatasetError, match="several ground truths"):
        icl.convert(source, tmp_path / "out")
