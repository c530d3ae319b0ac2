# SPDX-License-Identifier: Apache-2.0
"""The plots and images of a report."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from report_data import CAMERA, bare_data, full_data, keyframe

from slamdepth.mapping.dense_depth import DenseDepth, store_dense_depth
from slamdepth.mapping.spill_file import SpillFile
from slamdepth.report import (
    build_html,
    build_summary,
)
from slamdepth.report import plots as report_plots
from slamdepth.report.gaps import with_gaps
from slamdepth.report.keyframe_images import NEAR_TO_FAR, UNKNOWN, colour_depth, keyframe_gallery
from slamdepth.report.speed import speed_plot, stage_times
from slamdepth.types import (
    StepResult,
    TrackingStatus,
    Trajectory,
)


def test_plots_are_valid_svg_in_the_colours_of_the_page() -> None:
    data = full_data()
    run, score = data.reconstruction, data.trajectory_score
    drawn = {
        "trajectory": report_plots.trajectory_plot(run, score),
        "map": report_plots.map_plot(run),
        "tracking": report_plots.tracking_plot(data.steps),
        "ate": report_plots.ate_plot(score),
        "rpe": report_plots.rpe_plot(score),
        "position": report_plots.position_plot(run, score),
        "timings": speed_plot(stage_times(run.statistics.timings_ms, run.statistics.timing_calls, 6.4)),
        "scale": report_plots.scale_plot(run.keyframes),
    }
    ids: list[str] = []
    for name, svg in drawn.items():
        assert svg is not None, name
        root = ElementTree.fromstring(svg)
        assert root.get("aria-label")
        assert "var(--rule)" in svg
        assert "var(--muted)" in svg
        assert "var(--estimate)" in svg
        assert not re.search(r"#0[1-9]0[1-9]0[1-9]", svg)
        ids += [element.get("id", "") for element in root.iter() if element.tag.endswith("clipPath")]
    assert len(ids) == len(set(ids))


def test_plots_without_data_are_none() -> None:
    data = bare_data()
    run = data.reconstruction
    assert report_plots.trajectory_plot(run, None) is None
    assert report_plots.map_plot(run) is None
    assert report_plots.tracking_plot(()) is None
    assert report_plots.ate_plot(None) is None
    assert report_plots.rpe_plot(None) is None
    assert report_plots.position_plot(run, None) is None
    assert speed_plot(stage_times({}, {}, None)) is None
    assert report_plots.scale_plot(()) is None
    assert report_plots.scale_plot(tuple(keyframe(i, is_sensor=True) for i in range(3))) is None


def test_a_single_pose_can_be_drawn() -> None:
    one = Trajectory(np.array([5.0]), np.eye(4)[None])
    run = replace(bare_data().reconstruction, trajectory=one, points_m=np.full((3, 3), np.nan))
    steps = (StepResult(0, 5.0, TrackingStatus.INITIALISING, np.eye(4), is_keyframe=True),)
    data = replace(bare_data(), reconstruction=run, steps=steps)
    page = build_html(data, build_summary(data))
    assert page.count("<svg") == 2


def test_drawing_leaves_no_global_state() -> None:
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "import slamdepth.report\n"
        "heavy = {'matplotlib', 'cv2', 'torch', 'evo', 'rich', 'open3d', 'gtsam'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "import matplotlib\n"
        "def settings(): return {k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != 'backend'}\n"
        "before = settings()\n"
        "from report_data import full_data\n"
        "slamdepth.report.build_html(full_data(), slamdepth.report.build_summary(full_data()))\n"
        "assert settings() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    root = Path(__file__).resolve().parents[1]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, env={**os.environ})


def test_lost_frames_break_the_curves() -> None:
    times = np.array([0.0, 1.0, 2.0, 7.0, 8.0])
    values = with_gaps(times, np.arange(5.0)[:, None])[:, 0]
    np.testing.assert_array_equal(values, [0, 1, 2, np.nan, 3, 4])
    np.testing.assert_array_equal(report_plots._gap_times(times, 0.0), [0, 1, 2, np.nan, 7, 8])
    np.testing.assert_array_equal(report_plots._gap_times(np.array([3.0])), [0])


def test_depth_runs_from_dark_blue_over_green_to_yellow() -> None:
    colours = colour_depth(np.array([[1.0, 2.0, 3.0, 0.0, np.nan, 0.5, 9.0]], np.float32), 1.0, 3.0)[0]
    as_hex = ["#{:02x}{:02x}{:02x}".format(*colour) for colour in colours]
    assert as_hex[0] == as_hex[5] == NEAR_TO_FAR[0]
    assert as_hex[2] == as_hex[6] == NEAR_TO_FAR[-1]
    assert as_hex[3] == as_hex[4] == UNKNOWN
    assert colours[1][1] > colours[1][0]
    assert colours[1][1] > colours[1][2]


def test_the_gallery_spreads_over_the_run_and_shows_the_sensor_next_to_a_prediction() -> None:
    predicted = keyframe_gallery(tuple(keyframe(i) for i in range(7)), count=3)
    assert predicted is not None
    assert [keyframe.id for keyframe in predicted.keyframes] == [0, 3, 6]
    assert all([*shown.images] == ["image", "depth", "sensor depth"] for shown in predicted.keyframes)
    assert predicted.is_wide
    assert 0.5 <= predicted.near_m < predicted.far_m <= 4.0
    sensor = keyframe_gallery((keyframe(0, is_sensor=True),))
    assert sensor is not None
    assert [[*shown.images] for shown in sensor.keyframes] == [["image", "depth"]]
    assert not sensor.is_wide
    depth = np.full((12, 16), 2.0, np.float32)
    image = np.zeros((12, 16, 3), np.uint8)
    dense = DenseDepth(CAMERA.scaled(16, 12), image, depth, depth, np.ones((12, 16), np.bool_))
    measured = keyframe_gallery((replace(keyframe(0), dense=store_dense_depth(dense, SpillFile())),))
    assert measured is not None
    assert "depth from many views" in measured.keyframes[0].images
    unknown = replace(keyframe(0), in_metres=lambda prediction: np.zeros_like(prediction.values))
    assert keyframe_gallery((unknown,)) is not None
    assert keyframe_gallery(()) is None
