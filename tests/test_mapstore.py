# SPDX-License-Identifier: Apache-2.0
"""Maps on disk: what is written is read back, and nothing damaged is."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import numpy as np
import pytest
from saved_walk import saved_walk

from slamdepth import Map
from slamdepth.errors import DatasetError, OutputError
from slamdepth.mapstore.format import ARRAYS, VERSION, check_arrays


@pytest.fixture(scope="module")
def saved() -> Map:
    return saved_walk()


def test_a_map_comes_back_to_the_bit(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    again = Map.load(tmp_path)
    assert set(again.groups) == set(saved.groups)
    for group, arrays in saved.groups.items():
        for name, array in arrays.items():
            found = again.groups[group][name]
            assert found.dtype == array.dtype, (group, name)
            np.testing.assert_array_equal(found, array, err_msg=f"{group}/{name}")
    assert again.camera == saved.camera
    assert again.sessions == saved.sessions
    assert dict(again.scale) == dict(saved.scale)
    again.save(tmp_path / "again")
    for file in sorted((tmp_path / "map").iterdir()):
        assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes(), file.name


def test_a_map_says_what_it_holds(saved: Map) -> None:
    assert len(saved) == len(saved.T_world_camera) > 2
    assert len(saved.points_m) > 100
    assert len(saved.trajectory()) == saved.sessions[0].frames > 30
    assert not saved.has_images
    assert check_arrays(saved.groups, "map")["K"] == len(saved)


def test_images_are_kept_where_asked_for(tmp_path: Path) -> None:
    saved_walk(with_images=True).save(tmp_path / "map")
    with_images = Map.load(tmp_path)
    assert with_images.has_images
    first = with_images.groups["images"]
    assert bytes(first["jpeg"][:2]) == b"\xff\xd8"
    assert len(first["keyframe"]) == len(with_images)
    assert not with_images.without_images().has_images


@pytest.mark.parametrize("group", sorted(set(ARRAYS) - {"images"}))
def test_a_flipped_byte_is_found_and_the_file_named(saved: Map, group: str, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    file = tmp_path / "map" / f"{group}.safetensors"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))
    with pytest.raises(DatasetError, match=rf"{group}\.safetensors: is damaged: its checksum"):
        Map.load(tmp_path)


def test_a_missing_or_short_file_is_named(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    file = tmp_path / "map" / "places.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(DatasetError, match=r"places\.safetensors: is damaged"):
        Map.load(tmp_path)
    file.unlink()
    with pytest.raises(DatasetError, match=r"places\.safetensors: is missing"):
        Map.load(tmp_path)


def test_another_version_is_refused_in_one_line(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    about = tmp_path / "map" / "map.json"
    text = json.loads(about.read_text())
    assert text["version"] == VERSION
    for version in (VERSION + 1, 0, None):
        about.write_text(json.dumps({**text, "version": version}))
        with pytest.raises(DatasetError, match=rf"has version {version} of the format") as caught:
            Map.load(tmp_path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "is damaged"),
        ("[" * 100_000, "is damaged"),
        ("[]", "is no map of slamdepth"),
        ('{"format": "slamdepth map", "version": 1}', "it lists no files"),
        ('{"format": "slamdepth map", "version": 1, "files": {}}', "is not listed"),
    ],
)
def test_a_damaged_description_is_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text(text)
    with pytest.raises(DatasetError, match=says):
        Map.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("files", {"keyframes.safetensors": "x"}),
        ("files", {"keyframes.safetensors": {}}),
        ("camera", []),
        ("features", [1]),
        ("metric", None),
        ("scale", None),
        ("starts", 3),
        ("starts", [99]),
        ("sessions", []),
        ("shutter", {"readout_s": "x", "sigma_s": None}),
        ("shutter", {"readout_s": 0.0, "sigma_s": "x"}),
    ],
)
def test_a_value_of_another_kind_in_the_description_is_refused(
    saved: Map, tmp_path: Path, name: str, value: object
) -> None:
    saved.save(tmp_path / "map")
    about = tmp_path / "map" / "map.json"
    about.write_text(json.dumps({**json.loads(about.read_text()), name: value}))
    with pytest.raises(DatasetError, match=r"map\.json: is damaged"):
        Map.load(tmp_path)


def test_arrays_of_another_shape_or_with_ids_that_point_nowhere_are_refused(saved: Map) -> None:
    for group, name, wrong in (
        ("keyframes", "T_camera_world", np.zeros((len(saved), 3, 4))),
        ("keyframes", "timestamp_s", np.zeros(len(saved), np.float32)),
        ("landmarks", "anchor_keyframe", saved.groups["landmarks"]["anchor_keyframe"] + len(saved)),
        ("keyframes", "first_feature", saved.groups["keyframes"]["first_feature"][::-1].copy()),
    ):
        arrays = {**saved.groups, group: {**saved.groups[group], name: wrong}}
        with pytest.raises(DatasetError, match=f"{group}.safetensors is damaged: {name}"):
            check_arrays(arrays, "map")


def test_where_there_is_no_map_the_error_says_so(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        Map.load(tmp_path / "nothing")
    with pytest.raises(DatasetError, match="holds no map"):
        Map.load(tmp_path)


def test_saving_replaces_a_map_and_nothing_else(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    saved.save(tmp_path / "map")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map"]
    other = tmp_path / "photos"
    other.mkdir()
    (other / "one.jpg").write_bytes(b"")
    with pytest.raises(OutputError, match="no map"):
        saved.save(other)
    assert [path.name for path in other.iterdir()] == ["one.jpg"]


def test_a_link_to_a_map_is_replaced_and_what_it_leads_to_stays(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "there" / "map")
    (tmp_path / "here").mkdir()
    link = tmp_path / "here" / "map"
    link.symlink_to(tmp_path / "there" / "map")
    saved.save(link)
    assert [path.name for path in link.parent.iterdir()] == ["map"]
    assert not link.is_symlink()
    assert len(Map.load(tmp_path / "there")) == len(Map.load(link)) == len(saved)


def test_a_place_that_cannot_be_written_keeps_what_was_there(saved: Map, tmp_path: Path) -> None:
    saved.save(tmp_path / "map")
    before = (tmp_path / "map" / "map.json").read_bytes()
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        if (tmp_path / "probe").parent.stat().st_uid == 0:
            pytest.skip("root may write everywhere")
        with pytest.raises(OutputError, match="cannot be written"):
            saved.save(tmp_path / "map")
    finally:
        tmp_path.chmod(stat.S_IRWXU)
    assert (tmp_path / "map" / "map.json").read_bytes() == before


def test_a_full_disk_keeps_what_was_there(
    saved: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved.save(tmp_path / "map")
    before = {file.name: file.read_bytes() for file in (tmp_path / "map").iterdir()}

    def full(path: Path, data: bytes) -> str:
        if path.name.startswith("places"):
            raise OutputError(f"{path}: cannot be written: No space left on device")
        path.write_bytes(data)
        return ""

    monkeypatch.setattr("slamdepth.mapstore.map.write_bytes", full)
    with pytest.raises(OutputError, match="No space left"):
        saved.save(tmp_path / "map")
    assert {file.name: file.read_bytes() for file in (tmp_path / "map").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
