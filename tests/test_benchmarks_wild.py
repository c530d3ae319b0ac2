# SPDX-License-Identifier: Apache-2.0
"""The benchmark of recordings from outside: what is found, scored, kept and shown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks import wild
from benchmarks.excerpt import readable_excerpts, write_excerpt
from benchmarks.record import environment
from benchmarks.resume import RowFile
from benchmarks.wild_recordings import find_recordings
from benchmarks.wild_scores import count_leaps, figures, read_maps, score_piece, score_spans, verdict
from slamdepth.datasets import open_dataset
from slamdepth.errors import DatasetError, InputError, OutputError
from slamdepth.io import write_tum_trajectory
from slamdepth.types import Trajectory


def along(x: Any, start_s: float = 0.0) -> Trajectory:
    """A path with ``x`` given, at ten poses a second."""
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = x
    T[:, 1, 3] = np.sin(np.asarray(x, dtype=float))
    return Trajectory(start_s + 0.1 * np.arange(len(x), dtype=np.float64), T)


@pytest.fixture
def data(tmp_path: Path, tiny_room: Path) -> Path:
    """A folder with one video in two pieces of truth, one without truth, and one rendered room."""
    for name, pieces in (("beer_phone", (along(range(5)), along(range(4), 1.0))), ("bare", ())):
        folder = tmp_path / "wild" / name
        folder.mkdir(parents=True)
        video = cv2.VideoWriter(str(folder / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
        for n in range(20):
            video.write(np.full((48, 64, 3), n, np.uint8))
        video.release()
        (folder / "camera.yaml").write_text("{width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5}\n")
        for k, piece in enumerate(pieces, start=1):
            write_tum_trajectory(folder / f"groundtruth_{k}.txt", piece)
    (tmp_path / "room").symlink_to(tiny_room)
    (tmp_path / "notes").mkdir()
    return tmp_path


def test_videos_and_sequences_are_found_with_what_is_known_of_them(data: Path) -> None:
    found = {recording.name: recording for recording in find_recordings(data)}
    assert list(found) == ["bare", "beer_phone", "room"]
    assert [len(found[name].truths) for name in found] == [0, 2, 1]
    assert not found["beer_phone"].is_metric
    assert found["room"].is_metric
    assert found["room"].camera_file is None
    assert [r.name for r in find_recordings(data, only=["room"])] == ["room"]


def test_wrong_names_and_folders_are_one_line(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no recording 'beer'.*there are: bare, beer_phone, room"):
        find_recordings(data, only=["beer"])
    with pytest.raises(InputError, match="holds no recording"):
        find_recordings(tmp_path / "absent")
    with pytest.raises(DatasetError):
        find_recordings(data, also=[data / "notes"])


def test_leaps_are_steps_far_over_the_median_speed() -> None:
    assert count_leaps(along(np.arange(20.0))) == 0
    x = np.arange(20.0)
    x[10:] += 40.0
    assert count_leaps(along(x)) == 1
    assert count_leaps(along([0.0, 1.0])) == 0


def test_a_gap_in_time_is_no_leap() -> None:
    path = along(np.arange(40.0))
    kept = np.r_[0:10, 38:40]
    assert count_leaps(Trajectory(path.timestamps_s[kept], path.T_world_camera[kept])) == 0


def test_a_piece_is_scored_in_its_own_frame_and_scale() -> None:
    truth = along(np.linspace(0, 6, 30))
    T = truth.T_world_camera.copy()
    T[:, :3, 3] = 2.0 * T[:, :3, 3] + 5.0
    score = score_piece(truth, Trajectory(truth.timestamps_s, T), is_metric=True)
    assert score["sim3"] < 1e-6
    assert score["scale"] == pytest.approx(0.5)
    assert score["extent"] == pytest.approx(np.hypot(6, 2), rel=0.02)
    assert score["is_good"]
    assert score_piece(truth, Trajectory(truth.timestamps_s, T), is_metric=False)["scale"] is None
    assert "error" in score_piece(truth, along(range(9), 50.0), is_metric=True)


def test_the_worst_piece_and_every_map_count(tmp_path: Path) -> None:
    first, second = along(np.linspace(0, 6, 30)), along(np.linspace(0, 6, 20), 4.0)
    write_tum_trajectory(tmp_path / "trajectory.txt", first)
    (tmp_path / "maps" / "2").mkdir(parents=True)
    write_tum_trajectory(tmp_path / "maps" / "2" / "trajectory.txt", second)
    bent = first.T_world_camera[15:].copy()
    bent[:, 2, 3] += np.linspace(0, 2, 15) ** 2
    pieces = [
        Trajectory(first.timestamps_s[:15], first.T_world_camera[:15]),
        Trajectory(first.timestamps_s[15:], bent),
        along(range(5), 90.0),
    ]
    row = figures(tmp_path, {"loop_closures": 2}, 60, pieces, is_metric=False)
    assert (row["maps"], row["loops"], row["verdict"]) == (2, 2, "-")
    assert row["posed"] == pytest.approx(50 / 60)
    assert row["largest"] == pytest.approx(30 / 60)
    assert row["sim3"] == row["pieces"][1]["sim3"] > 0.1
    assert row["is_good"] is False
    assert len(row["unscored"]) == 1


def test_the_verdict_is_that_of_the_report() -> None:
    assert verdict({}) == "-"
    assert verdict({"health": {"verdict": "not trustworthy"}}) == "not trustworthy"
    assert verdict({"health": "good"}) == "good"


def test_verdicts_on_runs_maps_and_stretches_are_compared_with_the_truth() -> None:
    nothing: dict[str, Any] = {"spans": [], "each_map": []}
    maps = [{"verdict": "good", "is_good": True}, {"verdict": "doubtful", "is_good": False}]
    rows: list[dict[str, Any]] = [
        {"verdict": "good", "is_good": True, "each_map": maps,
         "spans": [{"is_good": True}, {"is_good": None}]},
        {"verdict": "good", "is_good": False, "each_map": maps[:1], "spans": [{"is_good": False}]},
        {"verdict": "bad", "is_good": None, **nothing}, {"verdict": "-", "is_good": True, **nothing},
        {"error": "too dark"},
    ]  # fmt: skip
    assert wild.verdicts(rows) == [
        "verdict 'good': 1 of 2 runs are truly good",
        "verdict 'doubtful': 0 of 1 maps of runs in several are truly good",
        "verdict 'good': 1 of 1 maps of runs in several are truly good",
        "verdict 'good': 1 of 2 stretches are truly good",
    ]


def test_a_stretch_is_scored_in_the_frame_of_its_own_map() -> None:
    truth = along(np.linspace(0, 12, 200), 100.0)
    bent = truth.T_world_camera.copy()
    bent[100:, 2, 3] += np.linspace(0, 3, 100) ** 2
    bent[:, 0, 3] += 7.0
    maps = [Trajectory(truth.timestamps_s, bent), along(range(5), 300.0)]
    stretches = [[0.0, 9.8], [10.0, 19.9]]
    summary = {
        "first_timestamp_s": 100.0,
        "health": {"maps": [{"good_spans_s": stretches}, {"good_spans_s": [[200.0, 206.0]]}]},
    }
    spans = score_spans(summary, maps, [truth, along(range(30), 102.0)], is_metric=False)
    assert [span["is_good"] for span in spans] == [True, False, None]
    assert [span["map"] for span in spans] == [1, 1, 2]
    assert spans[0]["path"] == pytest.approx(7.1, abs=0.1)
    assert spans[0]["sim3"] < 1e-6 < spans[1]["sim3"]


def test_maps_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    write_tum_trajectory(tmp_path / "trajectory.txt", along(range(20)))
    for number in (10, 2):
        (tmp_path / "maps" / str(number)).mkdir(parents=True)
        write_tum_trajectory(tmp_path / "maps" / str(number) / "trajectory.txt", along(range(20 - number)))
    assert [len(one) for one in read_maps(tmp_path)] == [20, 18, 10]


def test_an_excerpt_is_the_rest_of_the_sequence(tmp_path: Path, tiny_room: Path) -> None:
    with readable_excerpts():
        whole, rest = open_dataset(tiny_room), open_dataset(write_excerpt(tmp_path, tiny_room, None, 30))
    assert len(rest) == 10
    assert (rest.name, rest.camera, rest.has_depth) == (whole.name, whole.camera, True)
    read, same = rest.read(4, with_depth=True), whole.read(34, with_depth=True)
    assert (read.index, read.timestamp_s) == (4, same.timestamp_s)
    np.testing.assert_array_equal(read.image_rgb, same.image_rgb)
    assert read.depth_m is not None
    with pytest.raises(IndexError):
        rest.read(10)
    with readable_excerpts(), pytest.raises(DatasetError, match="has 40 frames, none from 40 on"):
        open_dataset(write_excerpt(tmp_path, tiny_room, None, 40))


def test_finished_rows_are_not_computed_again(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "wild.json"
    wanted = ["--data", str(data), "--only", "room", "--depth", "sensor", "--output", str(output)]
    assert wild.main([*wanted, "--single-start"]) == 0
    rows = json.loads(output.read_text(encoding="utf-8"))["rows"]
    assert [(row["recording"], row["start"]) for row in rows] == [("room", 0)]
    assert rows[0]["posed"] == 1.0
    assert rows[0]["se3_m"] < 0.02
    assert "| room | 1 | 40 | 100.0 | 100.0 | 1 |" in capsys.readouterr().out

    runs: list[int] = []

    def counted(recording: Any, start: int, *_: Any) -> dict[str, Any]:
        runs.append(start)
        return {"recording": recording.name, "start": start, "error": "too dark", "wall_s": 1.0}

    monkeypatch.setattr(wild, "run_recording", counted)
    assert wild.main(wanted) == 0
    assert runs == [10, 20]
    printed = capsys.readouterr().out
    assert "| room | 1 (2 failed) |" in printed
    assert "room from 10: too dark" in printed
    assert wild.main([*wanted, "--loops", "off"]) != 0
    assert "loops differ" in capsys.readouterr().err


def test_rows_of_other_source_are_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, path = environment(), tmp_path / "rows.json"
    RowFile(path, begun, {"depth": "x"}, ["name"]).add({"name": "a", "value": 1})
    again = RowFile(path, begun, {"depth": "x"}, ["name"])
    assert again.find(name="a") == {"name": "a", "value": 1}
    assert again.find(name="b") is None
    monkeypatch.setattr("benchmarks.resume.code_sha256", lambda: "other")
    with pytest.raises(OutputError, match="source_sha256 differ"):
        RowFile(path, begun, {"depth": "x"}, ["name"])
