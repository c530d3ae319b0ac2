# SPDX-License-Identifier: Apache-2.0
"""The report of a run that ended in several maps: each is stated and drawn by itself."""

from __future__ import annotations

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import leave_out_plots
from report_data import bare_data, full_data, several_maps_data, trajectory

from slamdepth.evaluation import score_trajectory
from slamdepth.report import build_html, build_summary, run_table
from slamdepth.report.maps import MAP_HEADS, about_maps, first_timestamp_s, map_rows, maps_plot


def rows_of(table: object) -> dict[str, str]:
    names, values = ([str(cell) for cell in column.cells] for column in table.columns)  # type: ignore[attr-defined]
    return dict(zip(names, values, strict=True))


def test_each_map_has_its_span_size_scale_and_verdict() -> None:
    summary = json.loads(json.dumps(build_summary(several_maps_data())))
    largest, second, third = summary["maps"]
    assert [one["folder"] for one in summary["maps"]] == [".", "maps/2", "maps/3"]
    assert [one["frames"] for one in summary["maps"]] == [70, 6, 4]
    assert second["share"] == pytest.approx(6 / 90)
    assert second["stretches_s"] == [[pytest.approx(81 / 30), pytest.approx(86 / 30)]]
    assert second["path_m"] == pytest.approx(4 * third["path_m"] * 5 / 3, rel=0.05)
    assert second["extent_m"] <= second["path_m"] + 1e-9
    assert (second["scale"]["uncertainty_log"], third["scale"]["uncertainty_log"]) == (0.03, None)
    assert largest["ate"] == summary["ate"]
    assert second["ate"]["se3"]["rmse_m"] is None
    assert [one["verdict"] for one in summary["maps"]] == [
        one["verdict"] for one in summary["health"]["maps"]
    ]
    assert (summary["tracked"], summary["tracked_in_all_maps"], summary["maps_joined"]) == (70, 80, 1)
    assert summary["first_timestamp_s"] == 100.0


def test_a_single_map_has_the_same_keys() -> None:
    for data in (full_data(), bare_data()):
        summary = build_summary(data)
        (one,) = summary["maps"]
        assert one.keys() == build_summary(several_maps_data())["maps"][1].keys()
        assert one["mesh"] == summary["mesh"]
        assert summary["tracked_in_all_maps"] == summary["tracked"]
    assert build_summary(bare_data())["first_timestamp_s"] is None
    assert first_timestamp_s(replace(full_data(), steps=())) == 100.0


def test_a_map_that_was_left_and_found_again_has_several_stretches() -> None:
    data = full_data()
    path = trajectory()
    late = replace(path, timestamps_s=path.timestamps_s + np.where(np.arange(len(path)) < 40, 0.0, 5.0))
    run = replace(data.reconstruction, trajectory=late)
    stretches = build_summary(replace(data, reconstruction=run))["maps"][0]["stretches_s"]
    assert stretches == [
        [0.0, pytest.approx(39 / 30)],
        [pytest.approx(5 + 40 / 30), pytest.approx(5 + 79 / 30)],
    ]


def test_the_table_names_every_map_only_where_there_are_several() -> None:
    shown = rows_of(run_table(build_summary(several_maps_data())))
    assert shown["tracked"].startswith("70 (77.8 %) in the largest map, 80 (88.9 %) in all maps")
    assert shown["maps"] == (
        "3 that never met: no common frame, each with its own scale; two maps met and were joined 1 time"
    )
    assert "2.7-2.9 s · 6 (6.7 %) frames" in shown["  map 2"]
    assert "scale × 1.2, 0.97 to 1.03 of true metres" in shown["  map 2"]
    assert "accuracy unknown" in shown["  map 3"]
    assert "ATE Sim(3)" in shown["  map 1, the largest"]
    assert "maps" not in rows_of(run_table(build_summary(full_data())))
    assert about_maps(1, 2) == "1; two maps met and were joined 2 times"


def test_the_page_has_every_map_with_its_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
    data = several_maps_data()
    summary = build_summary(data)
    page = build_html(data, summary)
    assert page.index("3 that never met") < page.index("<h2>Trajectory</h2>")
    for one in summary["health"]["maps"]:
        assert one["headline"] in page
    assert "A number." in page
    assert "in the largest map" in page
    assert "<h2>Maps</h2>" not in build_html(full_data(), build_summary(full_data()))
    assert all(len(row) == len(MAP_HEADS) for row in map_rows(summary["maps"]))


def test_maps_are_drawn_in_axes_of_their_own() -> None:
    data = several_maps_data()
    score = score_trajectory(trajectory(), data.reconstruction.trajectory)
    svg = maps_plot((data.maps[0], replace(data.maps[1], trajectory_score=score), data.maps[2]))
    assert svg is not None
    assert ElementTree.fromstring(svg).get("aria-label") == "3 maps, each in a frame of its own"
    assert svg.count('id="axes_') == 3
    assert "var(--truth)" in svg
    assert maps_plot(full_data().maps) is None
    assert maps_plot(bare_data().maps) is None
    many = maps_plot(data.maps * 4)
    assert many is not None
    assert many.count('id="axes_') == 9
