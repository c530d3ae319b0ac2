# SPDX-License-Identifier: Apache-2.0
"""Colours and scale bars of depth maps; PLY and PNG files; intrinsics of single images."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from slamdepth.datasets.image_files import natural_key
from slamdepth.datasets.intrinsics import Certainty, exif_focal_35mm, intrinsics_of
from slamdepth.io import encode_ply, read_depth_raw, read_image_rgb, write_depth_mm, write_png
from slamdepth.report import depth_map
from slamdepth.report.depth_map import Scale, coloured, nice_ticks, scale_bar, side_by_side, value_range
from slamdepth.report.keyframe_images import NEAR_TO_FAR, UNKNOWN, rgb_of
from slamdepth.types import DepthKind

METRIC, INVERSE = DepthKind.METRIC, DepthKind.AFFINE_INVERSE_DEPTH


@given(st.floats(0.0, 1e3), st.floats(1e-3, 1e3), st.integers(1, 9))
def test_ticks_are_round_and_inside(low: float, span: float, most: int) -> None:
    ticks = nice_ticks(low, low + span, most)
    assert len(ticks) <= most
    assert all(low - 1e-6 * span <= tick <= low + span * (1 + 1e-6) for tick in ticks)
    steps = np.diff(ticks)
    if len(steps):
        np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
        mantissa = steps[0] / 10 ** math.floor(math.log10(steps[0]) + 1e-9)
        assert min(abs(mantissa - round_one) for round_one in (1, 2, 2.5, 5, 10)) < 1e-6


def test_near_is_dark_blue_and_far_is_yellow_for_every_kind() -> None:
    near, far = rgb_of(NEAR_TO_FAR[0]), rgb_of(NEAR_TO_FAR[-1])
    metres = np.array([[1.0, 3.0, 0.0, np.nan]], np.float32)
    shown = coloured(metres, Scale(1.0, 3.0, METRIC))[0].tolist()
    assert shown == [list(near), list(far), list(rgb_of(UNKNOWN)), list(rgb_of(UNKNOWN))]
    disparity = np.array([[9.0, 0.0, -1.0, np.nan]], np.float32)
    shown = coloured(disparity, Scale(9.0, 0.0, INVERSE))[0].tolist()
    assert shown == [list(near), list(far), list(far), list(rgb_of(UNKNOWN))]


def test_the_range_of_inverse_depth_runs_from_large_to_small() -> None:
    values = np.linspace(1, 101, 1001, dtype=np.float32)[None]
    assert value_range(values, METRIC) == pytest.approx((2.0, 100.0), abs=0.01)
    assert value_range(values, INVERSE) == pytest.approx((100.0, 2.0), abs=0.01)
    assert value_range(np.zeros((2, 2), np.float32), METRIC) is None


def test_metres_are_named_for_metric_depth_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import ImageDraw

    drawn: list[str] = []
    draw_text = ImageDraw.ImageDraw.text

    def listen(self: ImageDraw.ImageDraw, xy: object, text: str, *rest: object, **options: object) -> None:
        drawn.append(text)
        draw_text(self, xy, text, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", listen)
    scale_bar.cache_clear()
    scale_bar(640, Scale(5.0, 1.0, INVERSE))
    assert drawn == ["depth", "unknown", "near", "far", depth_map.RELATIVE]
    drawn.clear()
    scale_bar(640, Scale(0.5, 3.2, METRIC, "metres rest on a guess"))
    assert drawn == [
        "depth (m)",
        "unknown",
        "0.5",
        "1.0",
        "1.5",
        "2.0",
        "2.5",
        "3.0",
        "metres rest on a guess",
    ]


@pytest.mark.parametrize("width", [1, 28, 63, 200, 1920, 6000])
@pytest.mark.parametrize("kind", list(DepthKind))
def test_a_bar_fits_any_width(width: int, kind: DepthKind) -> None:
    bar = scale_bar(width, Scale(1.0, 1.0 if width == 28 else 2.0, kind))
    assert bar.shape[1:] == (width, 3)


@pytest.mark.parametrize("size", [(47, 63), (48, 64), (1080, 1921)])
def test_frames_of_a_video_have_even_sides(size: tuple[int, int]) -> None:
    image, values = np.zeros((*size, 3), np.uint8), np.ones(size, np.float32)
    shown = side_by_side(image, values, Scale(0.5, 2.0, METRIC))
    assert shown.shape[0] % 2 == shown.shape[1] % 2 == 0
    assert shown.shape[1] <= 2 * 960 + 4


def test_millimetres_are_rounded_and_what_does_not_fit_is_unknown(tmp_path: Path) -> None:
    depth_m = np.array([[0.0005, 1.2344, 65.535, 65.536, np.nan, -1.0, 0.0, np.inf]])
    assert write_depth_mm(tmp_path / "d.png", depth_m) == 1
    assert read_depth_raw(tmp_path / "d.png").tolist() == [[0, 1234, 65535, 0, 0, 0, 0, 0]]


def test_colour_images_come_back(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "c.png", image)
    np.testing.assert_array_equal(read_image_rgb(tmp_path / "c.png"), image)


def test_a_cloud_is_read_by_open3d(tmp_path: Path) -> None:
    from slamdepth.open3d_loader import import_open3d

    points = np.array([[0, 1, 2], [3, 4, 5.5]], np.float32)
    colors = np.array([[255, 0, 51], [0, 102, 204]], np.uint8)
    (tmp_path / "p.ply").write_bytes(encode_ply(points, colors, comments=["focal: 60°"]))
    cloud = import_open3d().io.read_point_cloud(str(tmp_path / "p.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), points)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, colors)
    with pytest.raises(ValueError, match="one line"):
        encode_ply(points, colors, comments=["a\nend_header"])
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        encode_ply(points, colors[:1])


def test_a_guess_is_60_degrees_across_the_longer_side() -> None:
    for width, height in ((640, 480), (480, 640)):
        found = intrinsics_of(width, height)
        camera = found.camera
        assert math.degrees(2 * math.atan(320 / camera.fx)) == pytest.approx(60)
        assert (camera.cx, camera.cy) == ((width - 1) / 2, (height - 1) / 2)
        assert found.certainty is Certainty.GUESSED


def test_exif_gives_a_nominal_focal_length(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    exif[0x0112] = 6  # taken with the camera on its side
    Image.new("RGB", (360, 240)).save(tmp_path / "a.jpg", exif=exif)
    assert exif_focal_35mm(tmp_path / "a.jpg") == 26.0
    assert read_image_rgb(tmp_path / "a.jpg").shape == (360, 240, 3)
    assert read_image_rgb(tmp_path / "a.jpg", upright=False).shape == (240, 360, 3)
    found = intrinsics_of(360, 240, 26.0)
    assert found.camera.fx == pytest.approx(260.0)  # 36 mm are 360 pixels
    assert found.certainty is Certainty.NOMINAL
    Image.new("RGB", (36, 24)).save(tmp_path / "b.png")
    (tmp_path / "c.jpg").write_bytes(b"nothing")
    assert exif_focal_35mm(tmp_path / "b.png") is exif_focal_35mm(tmp_path / "c.jpg") is None


@given(st.lists(st.text(max_size=8), max_size=8), st.integers(0, 99), st.integers(0, 99))
def test_any_names_can_be_sorted_and_numbers_count(names: list[str], a: int, b: int) -> None:
    sorted(names, key=natural_key)
    assert (natural_key(f"x{a}y") < natural_key(f"x{b}y")) == (a < b)
