# SPDX-License-Identifier: Apache-2.0
"""The report of a run: its figures, its page, its tables."""

from __future__ import annotations

import getpass
import json
import re
import socket
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from command_line import leave_out_plots
from report_data import SCALE, bare_data, full_data
from rich.console import Console

from slamdepth.config import Config
from slamdepth.errors import OutputError
from slamdepth.report import (
    ReportData,
    ScaleSource,
    build_html,
    build_summary,
    run_table,
    trajectory_table,
    write_report,
)
from slamdepth.report.text import count, fixed, percent

VOID_TAGS = {"meta", "img", "br", "hr", "link", "input"}


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
    assert summary["depth"]["sequence_median"]["abs_rel"] == pytest.approx(0.0, abs=5e-4)  # half precision
    scale = summary["scale"]
    assert (scale["source"], scale["factor"], scale["uncertainty_log"]) == ("camera-height", 1.2, 0.03)
    assert (scale["keyframes"], scale["spread"], scale["sentence"]) == (6, 0.1, SCALE.sentence)
    assert [part["source"] for part in scale["parts"]] == ["network", "camera-height", "marker"]
    assert summary["dense"] == {"keyframes": 0, "measured": None}
    assert summary["mesh"] == {"vertices": 1234, "triangles": 5678}
    assert summary["surface"]["sim3"]["accuracy"]["median_m"] == pytest.approx(0.03, abs=1e-4)
    assert [summary["surface"][key]["within"]["5cm"]["f_score"] for key in ("se3", "sim3")] == [0.0, 1.0]
    assert summary["weights"][0] == {
        "name": "head & backbone",
        "sha256": "ab" * 32,
        "trained_on": "some rooms",
        "licence": "Apache-2.0",
        "precision": "",
    }
    assert summary["settings"] == Config().model_dump(mode="json")
    assert summary["notes"] == ["3 rows dropped", "the tracker's <note>"]
    assert summary["versions"]["numpy"] == np.__version__
    assert summary["hardware"]["cores"] >= 1


def test_the_verdict_is_in_the_figures_with_reasons_spans_and_numbers() -> None:
    health = json.loads(json.dumps(build_summary(full_data())["health"]))
    assert list(health) == ["verdict", "headline", "reasons", "spans", "numbers", "maps"]
    assert health["verdict"] == "doubtful"
    assert [span["kind"] for span in health["spans"]] == ["no map yet", "lost"]
    assert health["numbers"]["tracked_share"] == 70 / 80
    assert health["numbers"].keys() == build_summary(bare_data())["health"]["numbers"].keys()


def test_the_verdict_comes_first_on_the_page_and_in_the_table() -> None:
    for data in (full_data(), bare_data()):
        summary = build_summary(data)
        headline = summary["health"]["headline"]
        page = build_html(data, summary)
        assert page.index(headline) < page.index('class="tiles"')
        table = run_table(summary)
        names, values = ([str(cell) for cell in column.cells] for column in table.columns)
        assert names[0] == "verdict"
        assert values[:2] == [headline, summary["health"]["reasons"][0]]
        assert values[1] in page


def test_reasons_of_a_good_result_stay_out_of_the_table() -> None:
    summary = build_summary(full_data())
    good = {**summary["health"], "verdict": "good"}
    table = run_table({**summary, "health": good})
    assert [str(cell) for cell in table.columns[0].cells][1] == "frames"


def leaves(value: object, prefix: str = "") -> dict[str, object]:
    if not isinstance(value, dict):
        return {prefix: value}
    return {
        key: leaf for name, item in value.items() for key, leaf in leaves(item, f"{prefix}.{name}").items()
    }


def test_what_is_unknown_is_null_under_the_same_keys() -> None:
    full, bare = build_summary(full_data()), build_summary(bare_data())
    for section in ("ate", "rpe", "depth", "mesh", "surface"):
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


def test_write_report_writes_both_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
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
def test_page_is_whole_escaped_and_self_contained(make: Callable[[], ReportData]) -> None:
    data = make()
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


def test_the_same_run_gives_the_same_page() -> None:
    summary = build_summary(full_data())
    assert build_html(full_data(), summary) == build_html(full_data(), summary)


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
    damaged = rendered(run_table({**summary, "readable_frames": 82, "promised_frames": 120}))
    assert "2 could not be read; the video promises 120 and 82 can be read" in damaged
    assert "promises" not in text
    assert "not scored" in rendered(run_table(build_summary(bare_data())))
    assert f"{score.sim3.rmse_m:.6f} m" in rendered(trajectory_table(score.to_dict()))


def test_figures_are_written_honestly() -> None:
    assert percent(0.9999) == "99.9 %"
    assert percent(1.0) == "100.0 %"
    assert percent(None) == count(None) == fixed(None, 2, "m") == "–"
    assert count(1234567) == "1\u202f234\u202f567"
    assert fixed(1.23456, 2, "m") == "1.23 m"


def test_a_scale_from_ground_truth_is_no_metric_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
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


def test_the_mesh_is_scored_in_table_and_page_where_the_sensor_is_known() -> None:
    data = full_data()
    summary = build_summary(data)
    shown = rendered(run_table(summary))
    assert "mesh, SE(3)" in shown
    assert "F 0.00 at 2cm, 1.00 at 5cm, 1.00 at 10cm; accuracy 3.00 cm, completion 3.00 cm (medians)" in shown
    page = build_html(data, summary)
    assert "The mesh against what the sensor saw" in page
    assert "mesh, F at 5 cm" in page
    bare = bare_data()
    assert "mesh, SE(3)" not in rendered(run_table(build_summary(bare)))
    assert "The mesh against what the sensor saw" not in build_html(bare, build_summary(bare))
