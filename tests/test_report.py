# SPDX-License-Identifier: Apache-2.0
"""The report of a run: its figures, its page, its tables."""

from __future__ import annotations

import getpass
import json
import os
import re
import socket
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rich.console import Console

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given
from slamdepth.errors import OutputError
from slamdepth.evaluation import DepthScorer, score_trajectory
from slamdepth.geometry import se3_exp
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import (
    MeshCounts,
    ReportData,
    ScaleFacts,
    ScalePart,
    ScaleSource,
    build_html,
    build_summary,
    run_table,
    trajectory_table,
    write_report,
)
from slamdepth.report import plots as report_plots
from slamdepth.report.keyframe_images import NEAR_TO_FAR, UNKNOWN, colour_depth, keyframe_gallery
from slamdepth.report.speed import speed_plot, stage_times
from slamdepth.report.text import count, fixed, percent
from slamdepth.types import (
    Camera,
    DepthKind,
    DepthPrediction,
    Frame,
    RunStatistics,
    StepResult,
    TrackingStatus,
    Trajectory,
    WeightsInfo,
)

COUNT = 80
CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
SCALE = ScaleFacts(
    ScaleSource.CAMERA_HEIGHT,
    1.2,
    "Scale comes from the network.",
    uncertainty_log=0.03,
    keyframes=6,
    spread=0.1,
    parts=(
        ScalePart(ScaleSource.NETWORK, 1.0, 0.2, 0.02),
        ScalePart(ScaleSource.CAMERA_HEIGHT, 1.21, 0.03, 0.98),
    ),
)
VOID_TAGS = {"meta", "img", "br", "hr", "link", "input"}


def trajectory(noise: float = 0.0) -> Trajectory:
    t = np.arange(COUNT) / 30.0
    rng = np.random.default_rng(1)
    tangents = np.stack([np.sin(t), 0.1 * t, 0.5 * np.cos(t), 0.1 * t, 0.3 * t, 0 * t], axis=1)
    poses = se3_exp(tangents) @ se3_exp(noise * rng.normal(size=(COUNT, 6)))
    return Trajectory(100.0 + t, poses)


def keyframe(number: int, *, is_sensor: bool = False) -> Keyframe:
    rng = np.random.default_rng(number)
    image = rng.integers(0, 255, size=(24, 32, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 4.0, size=(24, 32)).astype(np.float32)
    depth[0] = 0.0
    frame = StoredFrame(Frame(number * 10, 100.0 + number / 3, image, CAMERA, depth))
    prediction = StoredPrediction(DepthPrediction(depth, DepthKind.METRIC, is_sensor=is_sensor))
    pose = trajectory().T_world_camera[number * 10]
    return Keyframe(number, frame, pose, np.zeros((1, 2)), 1.0 + 0.1 * number, prediction, as_given)


def full_data() -> ReportData:
    truth, estimate = trajectory(), trajectory(noise=0.01)
    kept = np.r_[0:30, 40:COUNT]
    estimate = Trajectory(estimate.timestamps_s[kept], estimate.T_world_camera[kept])
    keyframes = tuple(keyframe(i) for i in range(6))
    scorer = DepthScorer(stride=1)
    for k in keyframes:
        scorer.add(k.load_depth_m() * 1.1, k.frame.load().depth_m)
    states = [TrackingStatus.INITIALISING, *[TrackingStatus.TRACKING] * 29, *[TrackingStatus.LOST] * 10]
    states += [TrackingStatus.RELOCALISED, *[TrackingStatus.TRACKING] * 39]
    steps = tuple(
        StepResult(i, 100.0 + i / 30, state, None, inliers=i, is_keyframe=i % 10 == 0)
        for i, state in enumerate(states)
    )
    return ReportData(
        sequence="room <1>",
        depth_model="dinov2",
        depth_is_measured=False,
        reconstruction=Reconstruction(
            trajectory=estimate,
            keyframes=keyframes,
            points_m=np.random.default_rng(0).normal(size=(500, 3)),
            notes=("the tracker's <note>",),
            statistics=RunStatistics(
                frames=COUNT,
                tracked=70,
                loop_closures=1,
                relocalisations=1,
                timings_ms={"features": 7.5, "depth": 180.0},
                timing_calls={"features": 80, "depth": 6},
            ),
        ),
        fps=12.5,
        config=Config(),
        scale=SCALE,
        weights=(WeightsInfo("head & backbone", "ab" * 32, "some rooms", "Apache-2.0"),),
        steps=steps,
        trajectory_score=score_trajectory(truth, estimate),
        depth_score=scorer.score(),
        mesh=MeshCounts(1234, 5678),
        skipped_frames=2,
        notes=("3 rows dropped",),
        options={"stride": 1, "max_frames": None},
        files={"mesh.ply": "coloured mesh"},
    )


def bare_data() -> ReportData:
    """A run that was stopped before its first frame."""
    nothing = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    run = Reconstruction(nothing, (), np.empty((0, 3)))
    return ReportData(
        "empty", "sensor", True, run, 0.0, Config(), ScaleFacts(ScaleSource.SENSOR, 1.0, "The sensor's.")
    )


class BalancedTags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def rendered(table: object) -> str:
    stream = StringIO()
    Console(file=stream, width=120, color_system=None).print(table)
    return stream.getvalue()


def test_summary_has_the_promised_keys_and_values() -> None:
    summary = json.loads(json.dumps(build_summary(full_data())))
    expected = {"frames": 80, "tracked": 70, "keyframes": 6, "loop_closures": 1, "relocalisations": 1}
    assert {key: summary[key] for key in expected} == expected
    assert summary["tracked_fraction"] == 70 / 80
    assert summary["fps"] == 12.5
    assert summary["timings_ms"] == {"features": 7.5, "depth": 180.0}
    assert summary["timing_calls"] == {"features": 80, "depth": 6}
    assert summary["wall_s"] == pytest.approx(80 / 12.5)
    score = full_data().trajectory_score
    assert score is not None
    assert summary["ate"]["se3"]["rmse_m"] == score.se3.rmse_m
    assert summary["ate"]["sim3"]["scale"] == score.sim3.scale
    for span in ("per_frame", "per_second"):
        assert summary["rpe"][span]["trans_rmse_m"] > 0
        assert summary["rpe"][span]["rot_rmse_deg"] > 0
    assert summary["depth"]["metric"]["abs_rel"] == pytest.approx(0.1, rel=1e-4)
    assert summary["depth"]["sequence_median"]["abs_rel"] == pytest.approx(0.0, abs=1e-5)
    scale = summary["scale"]
    assert (scale["source"], scale["factor"], scale["uncertainty_log"]) == ("camera-height", 1.2, 0.03)
    assert (scale["keyframes"], scale["spread"], scale["sentence"]) == (6, 0.1, SCALE.sentence)
    assert [part["source"] for part in scale["parts"]] == ["network", "camera-height"]
    assert summary["mesh"] == {"vertices": 1234, "triangles": 5678}
    assert summary["weights"][0] == {
        "name": "head & backbone",
        "sha256": "ab" * 32,
        "trained_on": "some rooms",
        "licence": "Apache-2.0",
    }
    assert summary["settings"] == Config().model_dump(mode="json")
    assert summary["notes"] == ["3 rows dropped", "the tracker's <note>"]
    assert summary["versions"]["numpy"] == np.__version__
    assert summary["hardware"]["cores"] >= 1


def leaves(value: object, prefix: str = "") -> dict[str, object]:
    if not isinstance(value, dict):
        return {prefix: value}
    return {
        key: leaf for name, item in value.items() for key, leaf in leaves(item, f"{prefix}.{name}").items()
    }


def test_what_is_unknown_is_null_under_the_same_keys() -> None:
    full, bare = build_summary(full_data()), build_summary(bare_data())
    for section in ("ate", "rpe", "depth", "mesh"):
        assert leaves(full[section]).keys() == leaves(bare[section]).keys()
        assert None not in leaves(full[section]).values()
        assert set(leaves(bare[section]).values()) == {None}
    assert bare["tracked_fraction"] is None
    assert bare["depth"]["metric"]["delta1"] is None


def test_summary_names_no_host_user_or_folder() -> None:
    text = json.dumps({key: build_summary(full_data())[key] for key in ("versions", "hardware")})
    assert socket.gethostname() not in text
    assert str(Path.home()) not in text
    assert str(Path.cwd()) not in text
    if len(getpass.getuser()) > 4:
        assert getpass.getuser() not in text


def test_write_report_writes_both_files(tmp_path: Path) -> None:
    summary = write_report(tmp_path, full_data())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json"]
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == summary
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")


def test_write_report_into_no_folder_is_one_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_report(tmp_path / "absent", bare_data())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make", [full_data, bare_data])
def test_page_is_whole_escaped_and_self_contained(make: object) -> None:
    data = make()  # type: ignore[operator]
    page = build_html(data, build_summary(data))
    parser = BalancedTags()
    parser.feed(page)
    assert parser.open == []
    assert "<script" not in page
    assert "<1>" not in page
    assert "<note>" not in page
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert "url(http" not in page
    assert not re.search(r"\bnan\b", re.sub(r'base64,[^"]*', "", page), flags=re.IGNORECASE)


def test_page_states_figures_scale_and_weights() -> None:
    data = full_data()
    page = build_html(data, build_summary(data))
    score = data.trajectory_score
    assert score is not None
    for text in (
        f"{score.se3.rmse_m:.4f}",
        f"{score.sim3.scale:.4f}",
        "87.5",
        "Scale comes from the network.",
    ):
        assert text in page
    for text in ("head &amp; backbone", "some rooms", "ab" * 32, "map.voxel_size_m", "2 images could not be"):
        assert text in page
    assert page.count("<svg") == 8


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


def test_the_same_run_gives_the_same_page() -> None:
    summary = build_summary(full_data())
    assert build_html(full_data(), summary) == build_html(full_data(), summary)


def test_drawing_leaves_no_global_state() -> None:
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "import slamdepth.report\n"
        "heavy = {'matplotlib', 'cv2', 'torch', 'evo', 'rich', 'open3d', 'gtsam'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "import matplotlib\n"
        "def settings(): return {k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != 'backend'}\n"
        "before = settings()\n"
        "from test_report import full_data\n"
        "slamdepth.report.build_html(full_data(), slamdepth.report.build_summary(full_data()))\n"
        "assert settings() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    root = Path(__file__).resolve().parents[1]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, env={**os.environ})


def test_lost_frames_break_the_curves() -> None:
    times = np.array([0.0, 1.0, 2.0, 7.0, 8.0])
    values = report_plots._with_gaps(times, np.arange(5.0)[:, None])[:, 0]
    np.testing.assert_array_equal(values, [0, 1, 2, np.nan, 3, 4])
    np.testing.assert_array_equal(report_plots._gap_times(times, 0.0), [0, 1, 2, np.nan, 7, 8])
    np.testing.assert_array_equal(report_plots._gap_times(np.array([3.0])), [0])


def test_depth_runs_from_dark_blue_over_green_to_yellow() -> None:
    colours = colour_depth(np.float32([[1.0, 2.0, 3.0, 0.0, np.nan, 0.5, 9.0]]), 1.0, 3.0)[0]
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
    assert predicted.has_sensor
    assert 0.5 <= predicted.near_m < predicted.far_m <= 4.0
    sensor = keyframe_gallery((keyframe(0, is_sensor=True),))
    assert sensor is not None
    assert [[*shown.images] for shown in sensor.keyframes] == [["image", "depth"]]
    assert not sensor.has_sensor
    unknown = replace(keyframe(0), in_metres=lambda prediction: np.zeros_like(prediction.values))
    assert keyframe_gallery((unknown,)) is not None
    assert keyframe_gallery(()) is None


def test_console_tables() -> None:
    data = full_data()
    summary = build_summary(data)
    score = data.trajectory_score
    assert score is not None
    text = rendered(run_table({**summary, "sequence": "runs/[bold]x"}))
    for part in ("70 (87.5 %)", "12.5", "Scale comes from", f"{score.se3.rmse_m:.4f} m", "runs/[bold]x"):
        assert part in text
    assert "80 of 82 images; 2 could not be read" in text
    assert "70 (87.5 %); 85.4 % of all 82 images" in text
    assert "could not be read" not in rendered(run_table({**summary, "skipped_frames": 0}))
    assert "not scored" in rendered(run_table(build_summary(bare_data())))
    assert f"{score.sim3.rmse_m:.6f} m" in rendered(trajectory_table(score.to_dict()))


def test_figures_are_written_honestly() -> None:
    assert percent(0.9999) == "99.9 %"
    assert percent(1.0) == "100.0 %"
    assert percent(None) == count(None) == fixed(None, 2, "m") == "–"
    assert count(1234567) == "1\u202f234\u202f567"
    assert fixed(1.23456, 2, "m") == "1.23 m"


def test_a_scale_from_ground_truth_is_no_metric_claim() -> None:
    given = replace(
        SCALE, source=ScaleSource.GROUND_TRUTH_DEPTH, from_ground_truth=True, prediction_factor=1.2
    )
    for scale, is_claim in ((SCALE, True), (given, False)):
        data = replace(full_data(), scale=scale)
        page = build_html(data, build_summary(data))
        assert ("RMSE, scale as estimated" in page) is is_claim
        assert ("no metric claim" in page) is not is_claim
        assert ("depth scale applied" in page) is not is_claim
        assert scale.sentence in rendered(run_table(build_summary(data)))


def test_a_report_names_files_without_their_folders() -> None:
    config = Config.from_dict(
        {"depth": {"weights": "/some/where/head.st"}, "scale": {"depth": "/a/b/s.yaml"}}
    )
    settings = build_summary(replace(full_data(), config=config))["settings"]
    assert (settings["depth"]["weights"], settings["scale"]["depth"]) == ("head.st", "s.yaml")
