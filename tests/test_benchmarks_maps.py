# SPDX-License-Identifier: Apache-2.0
"""The benchmark of several maps: how recordings are spliced, and what its table says."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks import maps
from slamdepth.datasets import open_dataset


def test_pieces_are_spliced_at_the_pace_of_the_first(tiny_room: Path) -> None:
    room = open_dataset(tiny_room)
    splice = maps.there_and_back("back", room, 2, 5, 2)
    frames = list(splice.frames(with_depth=True))
    assert len(frames) == 2 + maps.DARK_FRAMES + 3
    assert [frame.index for frame, _, _ in frames] == list(range(len(frames)))
    steps_s = np.diff([frame.timestamp_s for frame, _, _ in frames])
    np.testing.assert_allclose(steps_s, 1.0 / room.camera.fps)
    dark = [frame for frame, dataset, _ in frames if dataset is None]
    assert len(dark) == maps.DARK_FRAMES
    assert not any(frame.image_rgb.any() or frame.depth_m is not None for frame in dark)
    assert [time_s for _, dataset, time_s in frames[-3:] if dataset is room] == [
        room.read(k).timestamp_s for k in (5, 4, 3)
    ]


def test_a_dark_second_leaves_one_map_that_is_scored(tiny_room: Path) -> None:
    """The room is so small that it is found again at once."""
    row = maps.run(maps.there_and_back("back", open_dataset(tiny_room), 20, 22, 40), "sensor")
    assert (row["visible"], row["maps"], row["joined"], row["wrong_joins"]) == (38, 1, 0, 0)
    assert row["placed"] == row["largest"] == 1.0
    assert row["errors_m"][0] < 0.05
    assert (row["found_again"], row["found_wrongly"]) == (1, 0)
    text = maps.table([{"recording": "back", "depth": "sensor", **row}])
    assert "| back | sensor | 98 | 38 | 100.0 | 100.0 | 1 | 0 | 0 | 1 | 0 |" in text
