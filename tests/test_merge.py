# SPDX-License-Identifier: Apache-2.0
"""Maps of several recordings joined by places they have in common."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from saved_walk import tracked
from tracking_scene import CAMERA, COUNT, frames, walk

from slamdepth import Map, MapLocaliser, merge
from slamdepth.errors import ConfigError
from slamdepth.geometry import invert

FIRST, SECOND = range(36), range(24, COUNT)


@pytest.fixture(scope="module")
def halves() -> tuple[Map, Map]:
    return tracked(frames(FIRST))[2], tracked(frames(SECOND))[2]


def test_maps_that_share_a_place_become_one(halves: tuple[Map, Map], tmp_path: Path) -> None:
    first, second = halves
    result = merge([first, second])
    assert result.meetings >= 3
    assert result.apart == ()
    assert len(result.map) == len(first) + len(second)
    assert [session.frames for session in result.map.sessions] == [len(FIRST), len(SECOND)]
    for number, given in enumerate((FIRST, SECOND)):
        trajectory = result.map.trajectory(number)
        assert len(trajectory) == len(given)
        truth = walk()[1][list(given)]
        off = np.linalg.norm(trajectory.T_world_camera[:, :3, 3] - truth[:, :3, 3], axis=1)
        assert off.max() < 0.04
    result.save(tmp_path / "both")
    again = Map.load(tmp_path / "both")
    assert len(again) == len(result.map)
    with MapLocaliser(again) as localiser:
        for index in (4, COUNT - 4):
            found = localiser.place(frames([index])[0]).T_world_camera
            assert found is not None
            assert np.linalg.norm(found[:3, 3] - walk()[1][index][:3, 3]) < 0.04


def test_maps_of_different_rooms_stay_apart(halves: tuple[Map, Map]) -> None:
    from slamdepth.synth.sequence import SynthSettings, render_frames

    settings = SynthSettings(frames=64, width=320, height=240, seed=11)
    given = [replace(frame, camera=CAMERA) for frame, _ in render_frames(settings, range(30))]
    other = tracked(given)[2]
    with pytest.raises(ConfigError, match="the maps never meet"):
        merge([halves[0], other])
    result = merge([halves[0], other, halves[1]])
    assert result.apart == (1,)
    assert np.isfinite(invert(result.map.T_world_camera)).all()


def test_the_command_joins_run_folders(halves: tuple[Map, Map], tmp_path: Path) -> None:
    for name, one in zip("ab", halves, strict=True):
        one.save(tmp_path / name / "map")
    done = call("merge", tmp_path / "a", tmp_path / "b", "--output", tmp_path / "both")
    assert done.returncode == 0, done.stderr
    assert "joined by" in done.stdout
    assert (tmp_path / "both" / "sessions" / "2" / "trajectory.txt").is_file()
    again = call("merge", tmp_path / "a", tmp_path / "b", "--output", tmp_path / "both")
    assert (again.returncode, "--overwrite" in again.stderr) == (2, True)
    alone = call("merge", tmp_path / "a", "--output", tmp_path / "one")
    assert (alone.returncode, "takes two maps or more" in alone.stderr) == (2, True)
    nothing = call("merge", tmp_path / "a", tmp_path, "--output", tmp_path / "none")
    assert (nothing.returncode, "holds no map" in nothing.stderr) == (2, True)
