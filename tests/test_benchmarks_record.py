# SPDX-License-Identifier: Apache-2.0
"""The JSON file of a benchmark, and the comparison of trajectories between versions."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from benchmarks import same_trajectories
from benchmarks.record import compact_json, environment, machine_line, read_benchmark, write_benchmark
from benchmarks.same_trajectories import differences
from slamdepth.errors import InputError

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"


def test_what_is_written_is_read_with_rounded_figures(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    rows = [{"name": "a {b}  c", "figures": {"ate": 0.012345678, "none": math.nan}, "spread": {}}]
    write_benchmark(file, environment(), {"factor": 0.123456789}, rows=rows)
    read = read_benchmark(file)
    assert read["rows"] == [{"name": "a {b}  c", "figures": {"ate": 0.012346, "none": None}, "spread": {}}]
    assert read["settings"] == {"factor": 0.123456789}
    assert {"cpu", "cores", "instructions"} <= read["environment"]["hardware"].keys()


@pytest.mark.parametrize(
    ("used", "shown"),
    [
        ([], "(instructions unknown)"),
        (["avx2", "avx512_f"], "(AVX2, AVX-512, no bfloat16)"),
        (["avx2", "avx512_f", "avx512_bf16"], "(AVX2, AVX-512, bfloat16 by AVX-512)"),
    ],
)
def test_a_table_says_what_it_was_measured_on(used: list[str], shown: str) -> None:
    begun = environment()
    begun["hardware"] |= {"cpu": "A", "cores": 4, "gpu": None, "instructions": used}
    begun["versions"] |= {"commit": "0123456789abc", "numba": "0.61"}
    assert machine_line(begun) == f"4 cores of A {shown}, numba 0.61; 012345678"
    del begun["versions"]["numba"]
    assert machine_line(begun) == f"4 cores of A {shown}; 012345678"


def test_text_is_the_same_json_on_few_lines() -> None:
    value = {"rows": [{str(n): [n, str(n)] for n in range(60)}, {}, []], "long": "x" * 200, "after": 1}
    text = compact_json(value)
    assert json.loads(text) == value
    assert len(text.splitlines()) < 25
    assert max(len(line) for line in text.splitlines() if "xxx" not in line) <= 110


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ('{"format": 1, "rows": []}', "not a benchmark of this program"),
        (None, "read"),
    ],
)
def test_a_file_of_something_else_is_one_line(tmp_path: Path, text: str | None, message: str) -> None:
    file = tmp_path / "other.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_benchmark(file)


@pytest.mark.parametrize("name", ["slam", "ablation", "robustness"])
def test_committed_results_can_be_read(name: str) -> None:
    assert all("sequence" in row for row in read_benchmark(RESULTS / f"{name}.json")["rows"])


def test_differences_name_the_run_and_the_file() -> None:
    old = {"room/sensor": {"a": "1", "b": "2"}, "desk/dinov2": {"a": "3"}}
    assert differences(old, old) == []
    new = {"room/sensor": {"a": "1", "b": "x", "c": "9"}, "rpy/dinov2": {"a": "3"}}
    assert differences(old, new) == [
        "desk/dinov2: only one side has it",
        "rpy/dinov2: only one side has it",
        "room/sensor: b differs",
    ]


def test_the_same_trajectories_are_recorded_and_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = b"0.0 0 0 0 0 0 0 1\n"
    commands: list[tuple[str, ...]] = []

    def run(command: str, sequence: str, *arguments: str) -> None:
        commands.append((command, *arguments))
        if command == "synth":
            Path(sequence).mkdir()
            return
        output = Path(arguments[arguments.index("--output") + 1])
        output.mkdir(parents=True, exist_ok=True)
        for name in (*same_trajectories.FILES, "mesh.ply"):
            (output / name).write_bytes(content)

    monkeypatch.setattr(same_trajectories, "slamdepth", run)
    data, file = tmp_path / "data", tmp_path / "digests.json"
    (data / "rgbd_dataset_freiburg1_desk").mkdir(parents=True)
    arguments = [str(file), "--data", str(data)]
    assert same_trajectories.main(["record", *arguments]) == 0
    assert [command for command, *_ in commands] == ["synth", "run", "run", "run"]
    assert "7scenes_redkitchen_seq-01: absent in data/, left out" in capsys.readouterr().err
    assert same_trajectories.main(["check", *arguments]) == 0
    assert "3 runs, the same bytes" in capsys.readouterr().out
    content += b"1.0 0 0 0 0 0 0 1\n"
    assert same_trajectories.main(["check", *arguments, "--work", str(tmp_path / "work")]) == 1
    assert "room/sensor: trajectory.txt differs" in capsys.readouterr().out
