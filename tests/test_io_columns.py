# SPDX-License-Identifier: Apache-2.0
"""Trajectory files of other tools: columns and units as the header says, or one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import call
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sequences import poses

from slamdepth.errors import DatasetError
from slamdepth.io import read_trajectory_pair, read_tum_trajectory, write_tum_trajectory
from slamdepth.io.columns import find_columns, stated_unit
from slamdepth.io.times import TimeUnit
from slamdepth.types import Trajectory

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60
)
START_NS = 1403636579763555584
QUAT_XYZW = (0.1, 0.2, 0.3, 0.9273618495495703)
XYZW = "0.1 0.2 0.3 0.9273618495495703"
WXYZ = "0.9273618495495703 0.1 0.2 0.3"
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
)
MOCAP = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
ROS = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,"
    "field.pose.position.y,field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
    "field.pose.orientation.z,field.pose.orientation.w\n"
)


def lines(text: str, separator: str = " ", stamp: str = "seconds") -> str:
    """Ten lines of ``text`` with the time and x of each in it."""
    times = {"seconds": lambda i: f"{i / 20:.6f}", "ns": lambda i: f"{START_NS + i * 50_000_000}"}
    return "".join(
        text.replace("T", times[stamp](i)).replace("X", str(i)).replace(" ", separator) + "\n"
        for i in range(10)
    )


FILES = {
    "EuRoC's state": (EUROC + lines(f"T X 2 3 {WXYZ} 0 0 0 0 0 0 0 0 0", ",", "ns"), True),
    "TUM-VI's mocap": (MOCAP + lines(f"T X 2 3 {WXYZ}", ",", "ns"), True),
    "TUM with w first": ("# timestamp tx ty tz qw qx qy qz\n" + lines(f"T X 2 3 {WXYZ}"), False),
    "a table with names": ("timestamp,tx,ty,tz,qw,qx,qy,qz\n" + lines(f"T X 2 3 {WXYZ}", ","), False),
    "rostopic": (ROS + lines(f"T 7 T map X 2 3 {XYZW}", ",", "ns"), True),
    "semicolons": ("Time [s];X;Y;Z;QX;QY;QZ;QW\n" + lines(f"T X 2 3 {XYZW}", ";"), False),
    "nanoseconds without a header": (lines(f"T X 2 3 {XYZW}", " ", "ns"), True),
    "a header in another order": ("# tx ty tz qx qy qz qw time_s\n" + lines(f"X 2 3 {XYZW} T"), False),
    "millimetres": (
        "timestamp x[mm] y[mm] z[mm] qx qy qz qw\n" + lines(f"T X000 2000 3000 {XYZW}"),
        False,
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_are_read_as_their_header_says(tmp_path: Path, kind: str) -> None:
    text, since_1970 = FILES[kind]
    plain, other = tmp_path / "plain.txt", tmp_path / "other.csv"
    plain.write_text(lines(f"T X 2 3 {XYZW}"))
    other.write_text(text)
    expected, notes = read_tum_trajectory(plain)
    assert notes == []
    found, notes = read_tum_trajectory(other)
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-12)
    start_s = 1403636579.763555584 if since_1970 else 0.0
    np.testing.assert_allclose(found.timestamps_s, start_s + expected.timestamps_s, atol=3e-7)
    assert any("nanoseconds" in note for note in notes) == since_1970
    assert all(note.startswith("other.csv: ") for note in notes)


def test_tum_s_own_headers_change_nothing(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    write_tum_trajectory(path, Trajectory(np.arange(5) / 30 + 1305031229.5, poses(5)))
    ours, notes = read_tum_trajectory(path)
    assert notes == []
    path.write_text("# ground truth trajectory\n# file: 'a.bag'\n# timestamp tx ty tz qx qy qz qw\n")
    with path.open("a") as file:
        file.write(lines(f"T X 2 3 {XYZW}"))
    _, notes = read_tum_trajectory(path)
    assert notes == []
    assert len(ours) == 5


def test_other_columns_in_the_header_are_said(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(FILES["EuRoC's state"][0])
    _, notes = read_tum_trajectory(path)
    assert "columns are read as its header says: time x y z qw qx qy qz; 9 further columns are" in notes[0]


def test_nanoseconds_and_commas_without_a_header_are_doubtful(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(lines(f"T X 2 3 {WXYZ}", ",", "ns"))
    _, notes = read_tum_trajectory(path)
    assert "no header names the columns; quaternions are read as x y z w" in notes[0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("# timestamp x y z roll pitch yaw w\n" + lines("T X 2 3 0 0 0 1"), "names no quaternion"),
        ("# t x[ft] y[ft] z[ft] qx qy qz qw\n" + lines(f"T X 2 3 {XYZW}"), "positions in 'ft'"),
        (lines("1 0 0 0 0 1 0 0 0 0 1 0"), "expected eight numbers .*twelve are a pose of KITTI"),
        (lines(f"T X 2 3 {WXYZ} 0 0 0 0 0 0 0 0 0", ","), "more are read where a first line names them"),
        (MOCAP + lines(f"T X 2 3 {WXYZ}", ",", "ns") + "1,2\n", ":12: expected 8 columns as the header says"),
        (lines(f"T X 2 3 {XYZW}").replace("0.", "130000000000000000."), "neither seconds, milliseconds"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match=says) as caught:
        read_tum_trajectory(path)
    assert "\n" not in str(caught.value)


def test_units_stated_by_lists_of_images() -> None:
    assert stated_unit(["#timestamp [ns],filename"]) is TimeUnit.NANOSECONDS
    assert stated_unit(["# timestamp_ms filename"]) is TimeUnit.MILLISECONDS
    assert stated_unit(["# color images", "# file: 'a.bag'", "# timestamp filename"]) is None
    assert stated_unit([]) is None


def test_a_pair_shares_its_unit_where_one_is_not_clear(tmp_path: Path) -> None:
    truth, estimate = tmp_path / "truth.txt", tmp_path / "estimate.txt"
    truth.write_text("".join(f"{10 * i} {i} 2 3 {XYZW}\n" for i in range(130)))
    estimate.write_text("".join(f"{round(i * 1000 / 30)} {i} 2 3 {XYZW}\n" for i in range(40)))
    (first, _), (second, _) = read_trajectory_pair(truth, estimate)
    assert first.timestamps_s[-1] == pytest.approx(1.29)
    assert second.timestamps_s[-1] == pytest.approx(1.3)


@RELAXED
@given(st.text(max_size=120), st.integers(0, 12))
def test_any_header_is_understood_or_refused(header: str, count: int) -> None:
    try:
        columns = find_columns(Path("t.txt"), [header], count)
    except DatasetError:
        return
    assert columns is None or (columns.count == count and max(columns.indices) < count)
    stated_unit([header])


@RELAXED
@given(st.permutations(["timestamp [ns]", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z", "v_x", "seq"]))
def test_columns_in_any_order_give_the_same_poses(tmp_path: Path, names: list[str]) -> None:
    x, y, z, w = QUAT_XYZW
    values = {"p_x": "X", "p_y": 2, "p_z": 3, "q_w": w, "q_x": x, "q_y": y, "q_z": z, "v_x": 9, "seq": 5}
    values["timestamp [ns]"] = "T"
    path = tmp_path / "t.csv"
    row = " ".join(str(values[name]) for name in names)
    path.write_text("#" + ",".join(names) + "\n" + lines(row, ",", "ns"))
    plain = tmp_path / "plain.txt"
    plain.write_text(lines(f"T X 2 3 {XYZW}", " ", "ns"))
    found, expected = read_tum_trajectory(path)[0], read_tum_trajectory(plain)[0]
    np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
    np.testing.assert_array_equal(found.timestamps_s, expected.timestamps_s)


def test_evaluate_gives_the_same_figures_in_every_unit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.normal(size=(60, 3)), np.tile(QUAT_XYZW, (60, 1))])
    estimate = truth + np.column_stack([rng.normal(0, 0.01, (60, 3)), np.zeros((60, 4))])

    def written(name: str, values: np.ndarray, unit: str) -> Path:
        stamps = {
            "s": lambda i: f"{START_NS // 10**9}.{START_NS % 10**9 // 1000 + i * 33333:06d}",
            "us": lambda i: str(START_NS // 1000 + i * 33333),
            "ns": lambda i: str(START_NS // 1000 * 1000 + i * 33333000),
        }
        rows = (" ".join([stamps[unit](i), *map(str, row)]) for i, row in enumerate(values[:7]))
        path = tmp_path / f"{name}_{unit}.txt"
        path.write_text("\n".join(rows) + "\n")
        return path

    tables = {}
    for unit in ("s", "us", "ns"):
        done = call("evaluate", written("truth", truth, unit), written("estimate", estimate, unit), "-q")
        assert done.returncode == 0, done.stderr
        tables[unit] = done.stdout.splitlines()[1:]
    mixed = call("evaluate", written("truth", truth, "ns"), written("estimate", estimate, "s"))
    assert tables["s"] == tables["us"] == tables["ns"]
    assert [line for line in mixed.stdout.splitlines()[1:] if "note: " not in line] == tables["s"]
    assert "note: truth_ns.txt: times are in nanoseconds" in mixed.stdout


def test_evaluate_names_a_conversion_also_where_nothing_pairs(tmp_path: Path) -> None:
    (tmp_path / "truth.txt").write_text(lines(f"T X 2 3 {XYZW}", " ", "ns"))
    (tmp_path / "estimate.txt").write_text(lines(f"T X 2 3 {XYZW}"))
    done = call("evaluate", tmp_path / "truth.txt", tmp_path / "estimate.txt")
    assert done.returncode == 2
    assert "their clocks start 1403636579.764 s apart" in done.stderr
    assert "truth.txt: times are in nanoseconds" in done.stderr
    assert "divided by 1e9" in done.stderr
