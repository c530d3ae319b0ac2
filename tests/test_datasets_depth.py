# SPDX-License-Identifier: Apache-2.0
"""Sensor depth that cannot be is one clear error before tracking; what can be is read as it is meant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import call, copy_of
from sequences import CAMERA, make_sevenscenes, make_tum, write_image

from slamdepth.datasets import open_dataset
from slamdepth.datasets.sensor_depth import check_sensor_depth, lack_of_depth
from slamdepth.datasets.sequence import ImageSequence
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_m, read_depth_raw

Change = Callable[[np.ndarray], np.ndarray]


def with_depth(folder: Path, change: Change, ending: str = ".png") -> ImageSequence:
    """A TUM folder whose depth, 1 to 4 m in units of 1/5000 m, went through ``change``."""
    make_tum(folder)
    for path in sorted((folder / "depth").iterdir()):
        rng = np.random.default_rng(int(path.stem))
        raw = rng.integers(5000, 20000, (CAMERA.height, CAMERA.width), dtype=np.uint16)
        path.unlink()
        target = path.with_suffix(ending)
        if ending == ".npy":
            np.save(target, change(raw))
        else:
            write_image(target, change(raw))
    text = (folder / "depth.txt").read_text()
    (folder / "depth.txt").write_text(text.replace(".png", ending))
    dataset = open_dataset(folder)
    assert isinstance(dataset, ImageSequence)
    return dataset


def eight(raw: np.ndarray) -> np.ndarray:
    return (raw / 256).astype(np.uint8)


def refusal(dataset: ImageSequence) -> str:
    with pytest.raises(DatasetError) as caught:
        check_sensor_depth(dataset, range(len(dataset)))
    assert "\n" not in str(caught.value)
    return str(caught.value)


IMPOSSIBLE: dict[str, tuple[Change, str, str]] = {
    "8 bits": (eight, ".png", "have 8 bits"),
    "8 bits, three channels": (lambda d: np.repeat(eight(d)[..., None], 3, 2), ".png", "3 equal channels"),
    "JPEG": (eight, ".jpg", "are JPEG"),
    "colour JPEG": (
        lambda d: cv2.applyColorMap(eight(d), cv2.COLORMAP_JET),
        ".jpg",
        "are JPEG of 3 channels",
    ),
    "colour map": (lambda d: cv2.applyColorMap(eight(d), cv2.COLORMAP_JET), ".png", "a colour map"),
    "16 bits, three channels": (lambda d: np.repeat(d[..., None], 3, 2), ".png", "have 3 channels"),
    "half the size": (lambda d: d[::2, ::2], ".png", "are 8x6, the colour images 16x12, but each depth must"),
    "three dimensions": (lambda d: np.stack([d, d]), ".npy", "have 16 channels"),
    "bits": (lambda d: d > 5, ".npy", "have 8 bits"),
}


@pytest.mark.parametrize("kind", IMPOSSIBLE)
def test_images_that_hold_no_depth_are_named_with_what_is_needed(tmp_path: Path, kind: str) -> None:
    change, ending, says = IMPOSSIBLE[kind]
    message = refusal(with_depth(tmp_path, change, ending))
    assert f"depth/0{ending}: the depth images " in message
    assert says in message
    assert "needed is one channel of 16 bits (PNG, TIFF) in units of depth_factor" in message


NO_SCENE: dict[str, tuple[Change, str, str]] = {
    "all zero": (lambda d: d * 0, ".png", "none of the pixels in 4 depth images looked at has a depth"),
    "all NaN": (lambda d: d.astype(np.float32) * np.nan, ".tiff", "none of the pixels"),
    "saturated": (lambda d: d * 0 + 65535, ".png", "all pixels of 4 depth images looked at are 65535"),
    "millimetres as metres": (lambda d: (d / 5).astype(np.float32), ".tiff", "divide them by 1000"),
    "metres as raw units": (lambda d: d // 5000, ".png", "0.0006 m by depth_factor 5000"),
}


@pytest.mark.parametrize("kind", NO_SCENE)
def test_distances_that_no_scene_has_are_refused(tmp_path: Path, kind: str) -> None:
    change, ending, says = NO_SCENE[kind]
    assert says in refusal(with_depth(tmp_path, change, ending))


def test_hundreds_of_metres_by_the_depth_factor_are_refused(tmp_path: Path) -> None:
    make_tum(tmp_path)
    text = (tmp_path / "camera.yaml").read_text()
    (tmp_path / "camera.yaml").write_text(text.replace("depth_factor: 5000.0", "depth_factor: 1"))
    dataset = open_dataset(tmp_path)
    assert isinstance(dataset, ImageSequence)
    message = refusal(dataset)
    assert "m by depth_factor 1 (raw units per metre)" in message
    assert "1000 for millimetres, 5000 for TUM" in message


def test_damaged_depth_is_refused_only_where_all_of_it_is(tmp_path: Path) -> None:
    dataset = with_depth(tmp_path, lambda d: d)
    for number in (0, 1, 2):
        (tmp_path / f"depth/{number}.png").write_bytes(b"no image")
    assert check_sensor_depth(dataset, range(4)) == []
    (tmp_path / "depth/3.png").write_bytes(b"")
    assert "none of 4 depth images looked at can be read; the first: " in refusal(dataset)


def test_sound_depth_gets_no_note(tmp_path: Path) -> None:
    assert check_sensor_depth(with_depth(tmp_path / "tum", lambda d: d), range(4)) == []
    assert check_sensor_depth(open_dataset(make_sevenscenes(tmp_path / "seq-01")), range(3)) == []
    assert check_sensor_depth(with_depth(tmp_path / "none", lambda d: d), []) == []


def in_metres(raw: np.ndarray) -> Any:
    depth_m = raw / np.float32(5000.0)
    depth_m[0, :4] = np.nan, np.inf, -1.0, 0.0
    return depth_m


@pytest.mark.parametrize("ending", [".tiff", ".npy"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floats_are_metres(tmp_path: Path, ending: str, dtype: type) -> None:
    dataset = with_depth(tmp_path, lambda d: in_metres(d).astype(dtype), ending)
    (note,) = check_sensor_depth(dataset, range(4))
    assert note == "depth images hold floats and are read as metres; depth_factor is not applied to them"
    depth_m = dataset.read(2, with_depth=True).depth_m
    assert depth_m is not None
    assert depth_m.dtype == np.float32
    assert depth_m[0, :4].tolist() == [0.0, 0.0, 0.0, 0.0]
    raw = np.random.default_rng(2).integers(5000, 20000, (CAMERA.height, CAMERA.width), dtype=np.uint16)
    np.testing.assert_array_equal(depth_m[1:], raw[1:] / np.float32(5000.0))


def test_whole_numbers_in_a_numpy_file_are_raw_units(tmp_path: Path) -> None:
    values = np.array([[5000, 0, 65535], [-1, 10000, 1]], np.int32)
    np.save(tmp_path / "d.npy", values)
    expected = [[1.0, 0.0, 0.0], [0.0, 2.0, np.float32(0.0002)]]
    np.testing.assert_allclose(read_depth_m(tmp_path / "d.npy", 5000.0, unknown_raw=(65535,)), expected)
    with pytest.raises(ImageDecodeError, match="one channel of 16 bits"):
        read_depth_raw(tmp_path / "d.npy")


def test_depth_that_looks_normalised_is_noted(tmp_path: Path) -> None:
    dataset = with_depth(tmp_path, lambda d: (d / d.max()).astype(np.float32), ".tiff")
    assert "are they metres, or normalised?" in check_sensor_depth(dataset, range(4))[1]


def test_an_exr_that_opencv_does_not_read_says_what_to_write(tmp_path: Path) -> None:
    (tmp_path / "d.exr").write_bytes(b"\x76\x2f\x31\x01 no image")
    with pytest.raises(ImageDecodeError, match=r"does not decode; not every OpenCV reads EXR: write 32-bit"):
        read_depth_m(tmp_path / "d.exr", 5000.0)
    np.save(tmp_path / "d.npy", np.array([None], dtype=object), allow_pickle=True)
    with pytest.raises(ImageDecodeError, match=r"d\.npy: cannot be read"):
        read_depth_m(tmp_path / "d.npy", 5000.0)


def test_depth_that_never_pairs_shows_both_ranges(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "depth.txt").write_text("".join(f"{99 + i} depth/{i}.png\n" for i in range(4)))
    dataset = open_dataset(folder)
    why = (
        "depth.txt: 4 depth images, none within 0.02 s of a colour image: colour from 10.000 to 10.300 s, "
        "depth from 99.000 to 102.000 s"
    )
    assert dataset.notes == [why]
    assert lack_of_depth(dataset) == f"has no sensor depth ({why})"


@pytest.mark.parametrize("command", [("run", "--depth", "sensor"), ("scale",), ("eval-depth", "dinov2")])
def test_commands_refuse_it_before_any_work(
    tiny_room: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    folder = copy_of(tiny_room, tmp_path / "room")
    for path in (folder / "depth").iterdir():
        raw = read_depth_raw(path)
        path.unlink()
        cv2.imwrite(str(path), eight(raw))
    name, *rest = command
    where = [*rest, folder] if name == "eval-depth" else [folder, *rest]
    done = call(name, *where, "-o", tmp_path / "out.json" if name == "eval-depth" else tmp_path / "out.yaml")
    assert done.returncode == 2, done.stderr
    assert "the depth images have 8 bits" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out.yaml").exists()


def test_a_run_without_pairs_says_why(tiny_room: Path, tmp_path: Path) -> None:
    folder = copy_of(tiny_room, tmp_path / "room")
    lines = (folder / "depth.txt").read_text().splitlines()
    later = [f"{float(line.split()[0]) + 50:.6f} {line.split()[1]}" for line in lines if line[0] != "#"]
    (folder / "depth.txt").write_text("\n".join(later))
    done = call("run", folder, "--depth", "sensor", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "40 depth images, none within 0.02 s of a colour image: colour from 0.000 to" in done.stderr
    assert "run it with predicted depth: --depth dinov2" in done.stderr
