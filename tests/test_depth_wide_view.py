# SPDX-License-Identifier: Apache-2.0
"""Wide views take over the depth scale of their middle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamdepth.depth.wide_view import middle_view, with_scale_of
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame


def frame(width: int, height: int, view_deg: float) -> Frame:
    focal = max(width, height) / 2.0 / math.tan(math.radians(view_deg) / 2.0)
    camera = Camera(width, height, focal, focal, 0.52 * width, 0.49 * height)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Frame(3, 0.1, image, camera, rng.uniform(1, 2, (height, width)).astype(np.float32))


@pytest.mark.parametrize("view_deg", [30.0, 63.0, 82.0, 89.0])
def test_usual_views_have_no_middle(view_deg: float) -> None:
    assert middle_view(frame(640, 480, view_deg)) is None


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (500, 500), (640, 200)])
def test_the_middle_is_the_image_of_a_usual_camera_with_the_same_axis(size: tuple[int, int]) -> None:
    whole = frame(*size, 100.0)
    found = middle_view(whole)
    assert found is not None
    middle, at = found
    camera = middle.camera
    longer = max(camera.width / camera.fx, camera.height / camera.fy)
    assert math.degrees(2.0 * math.atan(longer / 2.0)) == pytest.approx(63.0, abs=0.5)
    assert (camera.width > camera.height) == (size[0] >= size[1])
    assert camera.cx + at[1].start == whole.camera.cx
    assert camera.cy + at[0].start == whole.camera.cy
    np.testing.assert_array_equal(middle.image_rgb, whole.image_rgb[at])
    assert middle.depth_m is not None
    assert whole.depth_m is not None
    np.testing.assert_array_equal(middle.depth_m, whole.depth_m[at])


def test_the_whole_view_takes_over_the_scale_of_its_middle() -> None:
    rng = np.random.default_rng(1)
    depth = rng.uniform(1.0, 3.0, (100, 120)).astype(np.float32)
    depth[:10] = 0.0
    at = slice(5, 60), slice(20, 90)
    error = np.exp(rng.normal(0.0, 0.05, (55, 70))).astype(np.float32)
    middle = DepthPrediction(1.9 * depth[at] * error, DepthKind.METRIC, scale_sigma_log=0.2)
    whole = DepthPrediction(depth, DepthKind.METRIC, sigma_log=depth, scale_sigma_log=np.inf)
    found = with_scale_of(whole, middle, at)
    np.testing.assert_allclose(found.values, 1.9 * depth, rtol=0.01)
    assert found.scale_sigma_log == 0.2
    assert found.sigma_log is whole.sigma_log
    nothing = DepthPrediction(np.zeros_like(middle.values), DepthKind.METRIC)
    assert with_scale_of(whole, nothing, at) is whole
