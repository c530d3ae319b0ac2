# SPDX-License-Identifier: Apache-2.0
"""The benchmark of frames placed in a map of earlier ones."""

from __future__ import annotations

from pathlib import Path

from benchmarks.localise import Study
from slamdepth.datasets import open_dataset


def test_every_way_to_place_frames_has_a_row(tiny_room: Path) -> None:
    rows = Study(open_dataset(tiny_room), "sensor", 30, 10).rows()
    assert len(rows) == 9
    names = [row[0] for row in rows]
    assert names[0] == "run over all frames at once"
    assert "recording, adjusted, images in the map" in names
    assert all(row[1] == "10 of 10" for row in rows if "recording" in row[0])
    errors = {row[0]: [float(cell) for cell in row[2:]] for row in rows}
    assert all(len(row) == 4 and max(row) < 60.0 for row in errors.values())
