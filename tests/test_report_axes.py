# SPDX-License-Identifier: Apache-2.0
"""The axes of a report's plots: level where gravity is known, otherwise the first camera's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_data import full_data

from slamdepth.geometry import so3_exp
from slamdepth.report import build_html, build_summary
from slamdepth.report.axes import about_views, drawing_views, level_axes
from slamdepth.report.plots import map_plot, trajectory_plot

GRAVITY_W = np.array([0.0, 1.0, 0.0])


def test_a_table_seen_by_a_tipped_camera_is_level_from_the_side() -> None:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-1, 1, 50), np.full(50, 0.7), rng.uniform(1, 3, 50)])
    for tipped in ([0.8, 0.0, 0.0], [0.5, 0.2, -0.4]):
        R_camera_level = so3_exp(np.array(tipped))
        above, side = drawing_views(R_camera_level @ GRAVITY_W)
        seen = table @ R_camera_level.T
        np.testing.assert_allclose(side.flat(seen)[:, 1], -0.7, atol=1e-12)
        turned = above.flat(seen) - above.flat(seen).mean(axis=0)
        flat = table[:, [0, 2]] - table[:, [0, 2]].mean(axis=0)
        np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(flat, axis=1), atol=1e-12)
        # not mirrored: right is to the right of forward
        assert np.linalg.det(turned[:2]) * np.linalg.det(flat[:2]) > 0
        assert "gravity-aligned" in above.title
        assert "gravity-aligned" in side.title


@pytest.mark.parametrize("pitch", [-1.57, -1.4, -0.7, 0.0, 0.7, 1.4, 1.57])
def test_forward_is_where_the_first_camera_looks(pitch: float) -> None:
    R_camera_level = so3_exp(np.array([pitch, 0.0, 0.0]))
    np.testing.assert_allclose(level_axes(R_camera_level @ GRAVITY_W), R_camera_level.T, atol=1e-12)


def test_without_gravity_the_axes_are_the_first_cameras_and_named_so() -> None:
    points = np.array([[1.0, 2.0, 3.0]])
    above, side = drawing_views(None)
    np.testing.assert_array_equal(above.flat(points), [[1.0, 3.0]])
    np.testing.assert_array_equal(side.flat(points), [[3.0, -2.0]])
    assert (above.title, side.title) == ("first camera's x–z", "first camera's z–y")
    assert all("(m)" in label for view in (above, side) for label in view.labels)


def test_the_report_says_which_axes_it_draws() -> None:
    data = full_data()
    known = replace(data.reconstruction, gravity_w=GRAVITY_W)
    for run in (data.reconstruction, known):
        page = build_html(replace(data, reconstruction=run), build_summary(data))
        assert ("from above (gravity-aligned)" in page) is (run is known)
        assert ("first camera's x–z" in page) is (run is not known)
        assert page.count(about_views(run.gravity_w)) == 2
    for draw in (map_plot, lambda run: trajectory_plot(run, data.trajectory_score)):
        assert draw(known) != draw(replace(known, gravity_w=so3_exp(np.array([0.5, 0.0, 0.0])) @ GRAVITY_W))
