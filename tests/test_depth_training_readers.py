# SPDX-License-Identifier: Apache-2.0
"""Training data of every layout: found, opened, read exactly; lens distortion undone."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from training_places import (
    DISTANCE_M,
    NORMAL,
    make_hypersim,
    make_place,
    make_sevenscenes,
    make_tum,
    plane_frame,
)

from slamdepth.errors import ConfigError, DatasetError
from slamdepth.pipeline.training_data import sequence_readers
from slamdepth.synth.sequence import SynthSettings, render_sequence
from slamdepth.training import data
from slamdepth.training.augment import turned_view, unaugmented_view
from slamdepth.training.caches import benchmarks_seen, plan_caches
from slamdepth.training.config import TrainConfig
from slamdepth.training.data import data_folder, known_readers, open_place, register_reader
from slamdepth.training.lens import raw_pixels, turning_point
from slamdepth.training.readers.hypersim import planar_depth_m, read_distance_m
from slamdepth.training.readers.pairs import PairReader
from slamdepth.types import Camera

FR1 = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
DISTORTED = Camera(160, 120, 129.3, 129.1, 79.7, 63.8, FR1)


def open_any(folder: Path, reader: str | None = None) -> data.Place:
    return open_place(folder, reader, sequence_readers())


def assert_shows_the_plane(depth_m: np.ndarray, focal_px: float, rtol: float = 0.012) -> None:
    """``depth_m (rows, columns)`` is that of a centred pinhole looking at the plane."""
    rows, columns = depth_m.shape
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    rays = np.stack(
        [(u - (columns - 1) / 2) / focal_px, (v - (rows - 1) / 2) / focal_px, np.ones_like(u)], -1
    )
    known = depth_m > 0
    assert known.mean() > 0.7
    np.testing.assert_allclose(depth_m[known], (DISTANCE_M / (rays @ NORMAL))[known], rtol=rtol)


INTRINSICS = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"depth_unit_m": 0}, "depth_unit_m: Input should be greater than 0, got 0"),
        ({"depth_unit_m": -0.001}, "depth_unit_m: Input should be greater than 0"),
        ({"depth_unit_m": float("nan")}, "depth_unit_m: Input should be a finite number"),
        ({"depth_unit_m": float("inf")}, "depth_unit_m: Input should be a finite number"),
        (
            {"depth_unit": 0.001},
            "unknown key 'depth_unit'; known are .*, depth_unit_m, distortion",
        ),
        ({"width": float("inf")}, "width: Input should be a finite number"),
        ({"width": 64.5}, "width: Input should be a valid integer"),
        ({"height": 0}, "height: Input should be greater than"),
        ({"fx": -5}, "fx: Input should be greater than 0, got -5"),
        ({"cx": float("nan")}, "cx: Input should be a finite number"),
        ({"fy": "wide"}, "fy: Input should be a valid number"),
        ({"distortion": [0.1, 0, 0, 0]}, r"distortion: needs five finite numbers \[k1, k2, p1, p2, k3\]"),
        ({"distortion": [0.1] * 6}, "distortion: needs five finite numbers"),
        ({"distortion": 0.1}, "distortion: needs five finite numbers"),
        ({"distortion": [0, 0, 0, 0, float("nan")]}, "distortion: needs five finite numbers"),
    ],
)
def test_a_camera_of_pairs_is_whole_or_named(tmp_path: Path, change: dict[str, object], says: str) -> None:
    folder = make_place(tmp_path / "room")
    (folder / "camera.json").write_text(json.dumps({**INTRINSICS, **change}))
    with pytest.raises(DatasetError, match=f"room/camera.json: {says}") as error:
        open_place(folder)
    assert "\n" not in str(error.value)
    for text in ("[]", "3", "{", ""):
        (folder / "camera.json").write_text(text)
        with pytest.raises(DatasetError, match=r"room/camera\.json: not readable: "):
            open_place(folder)


def test_pairs_through_a_lens(tmp_path: Path) -> None:
    folder = make_place(tmp_path / "room")
    without = open_place(folder)
    said = {**INTRINSICS, "distortion": [0.3, -0.1, 0.01, 0.02, 0.0]}
    (folder / "camera.json").write_text(json.dumps(said), encoding="utf-8-sig")
    place = open_place(folder)
    assert place.camera.distortion == (0.3, -0.1, 0.01, 0.02, 0.0)
    assert place.fingerprint != without.fingerprint
    _, depth = plane_frame(place.camera)
    cv2.imwrite(str(folder / "00000.png"), np.round(depth * 1000).astype(np.uint16))
    view = unaugmented_view(place.read(0), 28, 42)
    assert_shows_the_plane(view.depth_m, view.focal_px, rtol=0.02)


def test_a_folder_of_pairs_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_place(tmp_path / "room")

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(DatasetError, match="room: cannot be read: Permission denied"):
        PairReader().open(folder)


def test_tum_pairs_by_time_and_undoes_the_lens(tmp_path: Path) -> None:
    place = open_any(make_tum(tmp_path / "own_room", DISTORTED))
    assert len(place) == 2  # the first image has no depth near it
    assert place.benchmark == "sequences in the TUM RGB-D layout"
    frame = place.read(1)
    assert frame.index == 1
    assert frame.camera.is_distorted
    view = unaugmented_view(frame, 84, 112)
    assert_shows_the_plane(view.depth_m, view.focal_px)
    # the lens matters: taken for a pinhole's, the same image is wrong by more than the tolerance
    pinhole = type(frame)(0, 0.0, frame.image_rgb, frame.camera.without_distortion(), frame.depth_m)
    with pytest.raises(AssertionError):
        assert_shows_the_plane(unaugmented_view(pinhole, 84, 112).depth_m, view.focal_px)


def test_image_and_depth_stay_together_through_the_lens(tmp_path: Path) -> None:
    frame = open_any(make_tum(tmp_path / "room", DISTORTED)).read(0)
    image, depth, _ = turned_view(frame, 84, 112, 30.0, 4.0, -3.0, 1.2, True)
    known = depth > 0
    assert known.mean() > 0.6
    # brightness is 60 grey levels a metre of the depth before the turn; pan and tilt change depth by
    # the ray's z, so compare with an unturned view of the same roll
    image, depth, _ = turned_view(frame, 84, 112, 30.0, 0.0, 0.0, 1.2, True)
    known = depth > 0
    np.testing.assert_allclose(image[..., 0][known], 60 * depth[known], atol=2.5)


def test_7scenes(tmp_path: Path) -> None:
    place = open_any(make_sevenscenes(tmp_path / "kitchen"))
    assert (len(place), place.benchmark) == (2, "7-Scenes sequences")
    assert place.gravity(0) is None
    depth_m = place.read(0).depth_m
    assert depth_m is not None
    assert (depth_m[:10] == 0).all()
    view = unaugmented_view(place.read(0), 112, 154)
    assert_shows_the_plane(view.depth_m, view.focal_px)


def test_synth_is_distinguished_from_tum(tmp_path: Path) -> None:
    room = render_sequence(tmp_path / "room", SynthSettings(frames=2, width=64, height=48))
    place = open_any(room)
    assert (len(place), place.benchmark) == (2, None)
    assert place.read(0).depth_m is not None
    assert open_any(room, "tum").benchmark is not None
    with pytest.raises(DatasetError, match=r"no synth\.yaml here"):
        open_any(make_tum(tmp_path / "tum", DISTORTED), "synth")


def test_hypersim(tmp_path: Path) -> None:
    place = open_any(make_hypersim(tmp_path / "ai_001_001"))
    assert (place.name, len(place), place.benchmark) == ("ai_001_001", 3, None)
    assert place.gravity(0) is None
    assert place.camera.fx == pytest.approx(886.81 / 8)
    assert "1 of 4 frames have no image" in place.notes
    frame = place.read(2)  # of the second camera
    assert frame.depth_m is not None
    assert (frame.depth_m[0, :3] == 0).all()
    assert_shows_the_plane(frame.depth_m, place.camera.fx, rtol=2e-3)  # the files are half precision


def test_bad_hypersim_files_are_named(tmp_path: Path) -> None:
    scene = make_hypersim(tmp_path / "ai_001_001")
    h5py = pytest.importorskip("h5py")
    files = sorted(scene.glob("images/scene_cam_00_geometry_hdf5/*.hdf5"))
    files[0].write_bytes(files[0].read_bytes()[:200])
    with pytest.raises(DatasetError, match=r"frame\.0000\.depth_meters\.hdf5: not readable as HDF5"):
        read_distance_m(files[0])
    with h5py.File(files[1], "w") as file:
        file["other"] = np.ones((2, 2))
    with pytest.raises(DatasetError, match="has no data set named 'dataset'"):
        read_distance_m(files[1])
    with h5py.File(files[1], "w") as file:
        file["dataset"] = np.ones((5, 5), np.float16)
    with pytest.raises(DatasetError, match=r"\(5, 5\) pixels, the scene's first image has"):
        open_any(scene).read(1)
    with h5py.File(files[1], "w") as file:
        file["dataset"] = np.ones((5, 5, 3), np.float16)
    with pytest.raises(DatasetError, match="expected rows and columns of metres"):
        read_distance_m(files[1])


def test_hypersim_without_h5py_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ai_001_001" / "images" / "scene_cam_00_geometry_hdf5").mkdir(parents=True)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DatasetError, match=r"needs h5py: .*pip install 'slamdepth\[hypersim\]'"):
        open_any(tmp_path / "ai_001_001")


@given(focal=st.floats(50, 2000), u=st.integers(0, 63), v=st.integers(0, 47), z=st.floats(0.1, 80))
@settings(max_examples=50, deadline=None)
def test_distance_along_a_ray_becomes_depth(focal: float, u: int, v: int, z: float) -> None:
    camera = Camera(64, 48, focal, focal, 31.5, 23.5)
    point = z * np.array([(u - 31.5) / focal, (v - 23.5) / focal, 1.0])
    distance = np.zeros((48, 64), np.float32)
    distance[v, u] = np.linalg.norm(point)
    depth = planar_depth_m(distance, camera)
    assert depth[v, u] == pytest.approx(z, rel=1e-5)
    assert np.count_nonzero(depth) == 1


@given(
    k1=st.floats(-0.3, 0.3), k2=st.floats(-0.1, 0.1), p=st.floats(-0.005, 0.005),
    u=st.floats(0, 159), v=st.floats(0, 119),
)  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_rays_meet_the_image_where_the_lens_bends_them(
    k1: float, k2: float, p: float, u: float, v: float
) -> None:
    """Brown's model, written out: its inverse in OpenCV is iterative and off by tenths of a pixel."""
    camera = Camera(160, 120, 150.0, 150.0, 80.0, 60.0, (k1, k2, p, -p, 0.0))
    x, y = (u - 80) / 150, (v - 60) / 150
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    bent_x = x * radial + 2 * p * x * y - p * (r2 + 2 * x * x)
    bent_y = y * radial + p * (r2 + 2 * y * y) - 2 * p * x * y
    found = raw_pixels(3.0 * np.array([[x, y, 1.0]]), camera)[0]
    np.testing.assert_allclose(found, [80 + 150 * bent_x, 60 + 150 * bent_y], atol=1e-6)


def test_rays_beyond_the_lens_do_not_fold_back_into_the_image() -> None:
    camera = Camera(160, 120, 150.0, 150.0, 80.0, 60.0, (-0.4, 0.0, 0.0, 0.0, 0.0))
    limit = turning_point(camera)
    assert limit == pytest.approx(np.sqrt(1 / 1.2), abs=2e-3)
    assert turning_point(camera.without_distortion()) == np.inf
    far = raw_pixels(np.array([[1.5 * limit, 0.0, 1.0]]), camera)[0]
    assert far[0] > camera.width  # the polynomial alone would say 85 px, inside
    folded, _ = cv2.projectPoints(
        np.array([[1.5 * limit, 0.0, 1.0]]), np.zeros(3), np.zeros(3), camera.K, camera.distortion_array
    )
    assert folded[0, 0, 0] < camera.width


def test_layouts_are_found_or_named(tmp_path: Path) -> None:
    pairs = make_place(tmp_path / "pairs")
    assert open_any(pairs).name == open_any(pairs, "pairs").name == "pairs"
    with pytest.raises(
        DatasetError, match=r"unknown reader 'tun'.*choose from: hypersim, pairs, synth, 7scenes, .*, tum"
    ):
        open_any(pairs, "tun")
    with pytest.raises(DatasetError, match=r"no rgb\.txt|rgb\.txt: missing"):
        open_any(pairs, "tum")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"no known layout of training data; known are: hypersim \(images"):
        open_any(tmp_path / "empty")
    with pytest.raises(DatasetError, match="no such folder"):
        open_any(tmp_path / "absent")


def test_a_sequence_without_depth_is_refused(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "room", DISTORTED)
    (folder / "depth.txt").unlink()
    with pytest.raises(DatasetError, match="has no sensor depth"):
        open_any(folder)


def test_a_damaged_image_of_a_sequence_is_named(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "room", DISTORTED)
    place = open_any(folder)
    (folder / "depth" / "1.png").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"1\.png: the image does not decode"):
        place.read(0)


def test_an_image_of_another_size_is_named(tmp_path: Path) -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    folder = make_tum(tmp_path / "fr", camera, 4)
    place = open_any(folder)
    cv2.imwrite(str(folder / "rgb" / "2.png"), np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"2\.png: the image is 32x24, the camera says 64x48"):
        place.read(1)


def test_a_reader_is_one_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known_readers()
    monkeypatch.setattr(data.READERS, "parts", dict(data.READERS.parts))
    pairs = open_place(make_place(tmp_path / "room"))

    @register_reader
    class Mine:
        name = "mine"
        needs = "a file called mine"

        def matches(self, folder: Path) -> bool:
            return (folder / "mine").exists()

        def open(self, folder: Path) -> data.Place:
            return pairs

    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").touch()
    assert open_place(tmp_path / "other") is pairs
    with pytest.raises(ValueError, match="two readers of training data are named 'mine'"):
        register_reader(Mine)


def test_folders_may_name_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_DATA", str(tmp_path))
    assert data_folder("$MY_DATA") == tmp_path


def source_config(folder: Path, **source: object) -> TrainConfig:
    return TrainConfig.from_dict(
        {
            "output": "x.safetensors",
            "sources": [{"folder": str(folder), **source}],
            "view": {"rows": 28, "columns": 42},
        }
    )


def test_benchmarks_trained_on_are_reported(tmp_path: Path) -> None:
    make_tum(tmp_path / "rgbd_dataset_freiburg1_desk", DISTORTED)
    make_place(tmp_path / "room")
    trained, held_out = [{"name": "rgbd_dataset_freiburg1_desk"}], ["rgbd_dataset_freiburg1_desk"]
    config = source_config(tmp_path, places=trained, held_out=["room"])
    planned = plan_caches(config, "given", sequence_readers())
    assert benchmarks_seen(planned) == {"sequences in the TUM RGB-D layout": ("rgbd_dataset_freiburg1_desk",)}
    config = source_config(tmp_path, places=[{"name": "room"}], held_out=held_out)
    assert benchmarks_seen(plan_caches(config, "given", sequence_readers())) == {}


def test_a_cache_is_named_by_what_its_files_are(tmp_path: Path) -> None:
    """Two folders with places of one name and length have different features."""
    first, second = make_place(tmp_path / "a" / "room"), make_place(tmp_path / "b" / "room")
    folders = [
        plan_caches(source_config(at.parent, places=[{"name": "room"}]), "given")[0].folder
        for at in (first, second)
    ]
    assert folders[0] == folders[1]  # the same files elsewhere
    image = second / "00002.jpg"
    image.write_bytes(image.read_bytes() + b"\0")
    other = plan_caches(source_config(second.parent, places=[{"name": "room"}]), "given")[0].folder
    assert other != folders[0]


def test_the_same_place_is_never_both_trained_on_and_held_out(tmp_path: Path) -> None:
    make_place(tmp_path / "room")
    with pytest.raises(ConfigError, match="room is held out and also trained on"):
        plan_caches(source_config(tmp_path, places=[{"name": "room"}], held_out=["room"]), "given")
    (tmp_path / "link").symlink_to(tmp_path / "room")
    with pytest.raises(ConfigError, match="room is held out and also trained on"):
        plan_caches(source_config(tmp_path, places=[{"name": "room"}], held_out=["link"]), "given")


def test_a_part_of_the_numbered_pairs_is_a_place_of_its_own(tmp_path: Path) -> None:
    make_place(tmp_path / "halls", 6)
    part = open_place(tmp_path / "halls[2-4]")
    assert (part.name, len(part)) == ("halls[2-4]", 3)
    whole = open_place(tmp_path / "halls")
    np.testing.assert_array_equal(part.read(0).image_rgb, whole.read(2).image_rgb)
    assert part.fingerprint != whole.fingerprint
    with pytest.raises(DatasetError, match="no pair is numbered 7 to 9"):
        open_place(tmp_path / "halls[7-9]")


def test_parts_that_overlap_are_not_both_trained_on_and_held_out(tmp_path: Path) -> None:
    make_place(tmp_path / "halls", 6)

    def planned(held_out: str) -> int:
        places = [{"name": "halls[0-2]", "samples": 2}]
        source = {"folder": str(tmp_path), "places": places, "held_out": [held_out]}
        config = TrainConfig.from_dict({"output": "head.safetensors", "sources": [source]})
        return len(plan_caches(config, "test"))

    assert planned("halls[3-5]") == 2
    for overlapping in ("halls[2-4]", "halls"):
        with pytest.raises(ConfigError, match="is held out and also trained on"):
            planned(overlapping)
