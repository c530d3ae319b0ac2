# SPDX-License-Identifier: Apache-2.0
"""Sequences without a camera file: intrinsics by metadata, or a guess that says so."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sequences import image_rgb, make_tum

from slamdepth.datasets import open_dataset
from slamdepth.datasets.intrinsics import Certainty, camera_of_view
from slamdepth.datasets.quicktime import video_focal_35mm
from slamdepth.errors import CameraError

KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"


def atom(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), name) + content


def metadata(value: bytes, kind: int, *, is_mp4: bool = False) -> bytes:
    """An atom ``meta`` with two entries, the second of which is the focal length."""
    names = (b"com.apple.quicktime.make", KEY)
    keys = bytes(4) + struct.pack(">I", len(names)) + b"".join(atom(b"mdta", name) for name in names)
    entries = (struct.pack(">II", 1, 0) + b"Phones", struct.pack(">II", kind, 0) + value)
    listed = b"".join(atom(struct.pack(">I", n + 1), atom(b"data", entry)) for n, entry in enumerate(entries))
    hdlr = atom(b"hdlr", bytes(8) + b"mdta" + bytes(12))
    return atom(b"meta", (bytes(4) if is_mp4 else b"") + hdlr + atom(b"keys", keys) + atom(b"ilst", listed))


def movie(meta: bytes, *, in_track: bool = False) -> bytes:
    inside = atom(b"trak", atom(b"tkhd", bytes(84)) + meta) if in_track else meta
    return (
        atom(b"ftyp", b"qt  ") + atom(b"mdat", bytes(100)) + atom(b"moov", atom(b"mvhd", bytes(100)) + inside)
    )


@pytest.mark.parametrize("in_track", [False, True])
@pytest.mark.parametrize("is_mp4", [False, True])
@pytest.mark.parametrize(
    ("kind", "value"),
    [(21, b"\x1a"), (22, b"\0\x1a"), (67, b"\0\0\0\x1a"), (23, struct.pack(">f", 26.0)), (1, b"26")],
)
def test_the_focal_length_of_a_phones_video_is_read(
    kind: int, value: bytes, is_mp4: bool, in_track: bool, tmp_path: Path
) -> None:
    path = tmp_path / "walk.mov"
    path.write_bytes(movie(metadata(value, kind, is_mp4=is_mp4), in_track=in_track))
    assert video_focal_35mm(path) == 26.0


def test_a_focal_length_that_no_lens_has_is_none(tmp_path: Path) -> None:
    path = tmp_path / "walk.mov"
    for kind, value in (
        (21, b"\0"),
        (23, struct.pack(">f", np.nan)),
        (1, b"wide"),
        (99, b"\x1a"),
        (23, b"1"),
    ):
        path.write_bytes(movie(metadata(value, kind)))
        assert video_focal_35mm(path) is None


def test_damaged_metadata_is_none_or_a_focal_length(tmp_path: Path) -> None:
    whole = movie(metadata(b"\x1a", 21), in_track=True)
    path = tmp_path / "walk.mov"
    rng = np.random.default_rng(0)
    for trial in range(400):
        data = bytearray(whole)
        if trial % 2:
            del data[int(rng.integers(len(data))) :]
        for _ in range(int(rng.integers(0, 8))):
            if data:
                data[int(rng.integers(len(data)))] = int(rng.integers(256))
        path.write_bytes(bytes(data))
        found = video_focal_35mm(path)
        assert found is None or 1.0 <= found <= 1000.0
    path.write_bytes(b"")
    assert video_focal_35mm(path) is None
    assert video_focal_35mm(tmp_path / "none.mov") is None


def test_a_folder_without_a_camera_has_a_guess_and_says_so(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path / "my_room", camera_file=False))
    assert dataset.camera_source.certainty is Certainty.GUESSED
    assert dataset.camera_source.how.endswith("60 degrees across the longer side, so 13.9 px at 16x12")
    camera = dataset.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (16, 12, 7.5, 5.5)
    assert camera.fx == camera.fy == pytest.approx(8 / np.tan(np.pi / 6))


def test_a_camera_file_and_a_known_folder_are_given(tmp_path: Path) -> None:
    for name in ("room", "freiburg1_x"):
        dataset = open_dataset(make_tum(tmp_path / name))
        assert dataset.camera_source.certainty is Certainty.GIVEN


def test_images_with_exif_are_nominal(tmp_path: Path) -> None:
    for n in range(2):
        image = Image.fromarray(image_rgb(n))
        exif = image.getexif()
        exif.get_ifd(0x8769)[0xA405] = 26
        image.save(tmp_path / f"{n}.jpg", exif=exif)
    dataset = open_dataset(tmp_path)
    assert dataset.camera_source.certainty is Certainty.NOMINAL
    assert dataset.camera.fx == pytest.approx(26 * 20 / np.hypot(36, 24))


@pytest.mark.parametrize("view_deg", [0.0, 0.5, 171.0, np.nan])
def test_a_view_that_no_image_has_is_refused(view_deg: float) -> None:
    with pytest.raises(CameraError, match="from 1 to 170"):
        camera_of_view(640, 480, view_deg)
