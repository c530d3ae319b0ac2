# SPDX-License-Identifier: Apache-2.0
"""Pages of runs in a headless Chromium: what is drawn, what moves, and that no request leaves the machine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import Page, browser
from numpy.typing import NDArray
from scene_data import BLUE, GREEN, RED, data_with_scene, several_maps_with_scene

from slamdepth.io import write_text
from slamdepth.report import ReportData, build_html, build_summary

STATE = "document.getElementById('scene')?.dataset.state"
CANVAS = "#scene canvas"


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with browser() as opened:
        yield opened


def write(folder: Path, data: ReportData) -> str:
    path = folder / "report.html"
    write_text(path, build_html(data, build_summary(data)))
    return path.as_uri()


def opened(page: Page, address: str, state: str = "drawn") -> None:
    page.errors.clear()
    page.requests.clear()
    page.size(1280, 900)
    page.dark(False)
    page.open(address)
    page.wait_for(f"{STATE} === '{state}'")


def settled(page: Page) -> None:
    """Wait until what was asked for is drawn."""
    page.run(
        "new Promise((done) => "
        "setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 120))"
    )


def choose(page: Page, selector: str, value: int, event: str) -> None:
    """Give an element another value, as a hand would."""
    page.run(
        f"(() => {{ const one = document.querySelector('{selector}'); one.value = {value}; "
        f"one.dispatchEvent(new Event('{event}')); }})()"
    )


def canvas(page: Page) -> NDArray[np.uint8]:
    box = page.box(CANVAS)
    settled(page)
    return page.picture(box)


def share_of(image: NDArray[np.uint8], colour: tuple[int, int, int]) -> float:
    """Share of the pixels of this hue, however bright."""
    bright = image.astype(float) / np.maximum(image.max(axis=2, keepdims=True), 1)
    wanted = np.array(colour) / max(colour)
    return float(np.mean(np.abs(bright - wanted).max(axis=2) < 0.08))


def quiet(page: Page, address: str) -> None:
    assert page.errors == []
    assert page.requests == [address]


def test_the_mesh_is_drawn_in_its_colours_without_errors_or_requests(page: Page, tmp_path: Path) -> None:
    address = write(tmp_path, data_with_scene())
    opened(page, address)
    image = canvas(page)
    for colour in (RED, GREEN, BLUE):
        assert share_of(image, colour) > 0.05
    background = np.array([0xE6, 0xE9, 0xEE])
    assert 0.05 < np.mean(np.abs(image.astype(int) - background).max(axis=2) < 6) < 0.8
    quiet(page, address)


def test_walls_seen_from_behind_are_left_out(page: Page, tmp_path: Path) -> None:
    opened(page, write(tmp_path, data_with_scene()))
    before = share_of(canvas(page), RED)
    left, top, width, height = page.box(CANVAS)
    for _ in range(2):  # half a turn
        page.drag((left + 0.2 * width, top + height / 2), (left + 0.575 * width, top + height / 2))
    assert share_of(canvas(page), RED) < 0.1 * before


def test_parts_can_be_switched_off(page: Page, tmp_path: Path) -> None:
    opened(page, write(tmp_path, data_with_scene()))
    page.run("document.querySelector('.part[value=mesh]').click()")
    assert share_of(canvas(page), RED) == 0.0
    names = page.run("[...document.querySelectorAll('.tools label:not([hidden]) .part')].map((e) => e.value)")
    assert names == ["mesh", "points", "path", "truth", "keyframes", "loops"]


def test_the_slider_moves_image_depth_time_and_place_together(page: Page, tmp_path: Path) -> None:
    address = write(tmp_path, data_with_scene())
    opened(page, address)
    state = """[document.querySelector('.images .image').src, document.querySelector('.images .depth').src,
        document.querySelector('.when').textContent]"""
    before, picture = page.run(state), canvas(page)
    left, top, width, height = page.box(".slider")
    page.drag((left + 8, top + height / 2), (left + 0.62 * width, top + height / 2))
    after = page.run(state)
    assert all(a != b for a, b in zip(before, after, strict=True))
    assert before[2] == "0.00 s · keyframe 0"
    assert after[2] == "1.00 s · keyframe 3"
    assert np.mean(np.abs(canvas(page).astype(int) - picture).max(axis=2) > 40) > 0.001
    page.run("document.querySelector('.follow').click()")
    close = canvas(page)
    assert np.mean(np.abs(close.astype(int) - picture).max(axis=2) > 40) > 0.2
    page.run("document.querySelector('.play').click()")
    page.wait_for("document.querySelector('.when').textContent.includes('keyframe 5')", 10)
    page.run("document.querySelector('.play').click()")
    quiet(page, address)


def test_maps_are_shown_one_at_a_time_and_the_slider_changes_them(page: Page, tmp_path: Path) -> None:
    address = write(tmp_path, several_maps_with_scene())
    opened(page, address)
    assert share_of(canvas(page), RED) > 0.05
    assert page.run("document.querySelectorAll('.map option').length") == 3
    choose(page, ".map", 1, "change")
    assert "map 2" in page.run("document.querySelector('.when').textContent")
    assert share_of(canvas(page), RED) == 0.0
    choose(page, ".map", 2, "change")
    assert page.run("document.querySelector('.map').value") == "2"  # a map without keyframes has a path
    quiet(page, address)


@pytest.mark.parametrize("is_dark", [False, True])
def test_a_phone_shows_it_within_its_width_by_day_and_by_night(
    page: Page, tmp_path: Path, is_dark: bool
) -> None:
    address = write(tmp_path, data_with_scene())
    opened(page, address)
    page.size(390, 844, is_phone=True)
    page.dark(is_dark)
    image = canvas(page)
    assert share_of(image, RED) > 0.03
    assert image.shape[1] > 300
    assert (
        image[3, image.shape[1] // 2].mean() < 60 if is_dark else image[3, image.shape[1] // 2].mean() > 200
    )
    assert page.run("document.documentElement.scrollWidth") <= 390
    quiet(page, address)


def test_without_webgl_a_line_says_so_and_the_slider_works(tmp_path: Path) -> None:
    address = write(tmp_path, data_with_scene())
    with browser(webgl=False) as page:
        opened(page, address, "no-webgl")
        assert page.run("document.querySelector('.missing').offsetHeight") > 0
        assert page.run("document.querySelector('.stage').offsetHeight") == 0
        choose(page, ".slider", 2, "input")
        assert "keyframe 2" in page.run("document.querySelector('.when').textContent")
        page.wait_for("document.querySelector('.images .image').naturalWidth === 256")
        quiet(page, address)


def test_a_scene_of_a_path_alone_is_drawn(page: Page, tmp_path: Path) -> None:
    data = data_with_scene()
    assert data.scene is not None
    one = data.scene.maps[0]
    bare = replace(one, mesh=None, thumbnails=(), truth=None, loops=one.loops[:0], points_m=one.points_m[:0])
    address = write(tmp_path, replace(data, scene=replace(data.scene, maps=(bare,))))
    opened(page, address)
    assert share_of(canvas(page), (23, 105, 212)) > 0.0005
    assert page.run("document.querySelector('.time').offsetHeight") == 0
    quiet(page, address)
