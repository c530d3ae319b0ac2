# SPDX-License-Identifier: Apache-2.0
"""A recording of two places with darkness between them, as the command line runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import slamdepth
from sequences import imread, write_image

from slamdepth.io import read_tum_trajectory

FIRST, DARK, SECOND = 20, 60, 16


@pytest.fixture(scope="module")
def two_places(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room, two seconds of darkness, and the mirror image of the room, which is another place."""
    folder = tmp_path_factory.mktemp("two") / "places"
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for kind in lines:
        names = sorted((tiny_room / kind).iterdir())
        for n in range(FIRST + DARK + SECOND):
            source = names[n if n < FIRST else max(0, n - FIRST - DARK) + FIRST]
            image: Any = imread(source, cv2.IMREAD_UNCHANGED)
            image = image[..., ::-1] if image.ndim == 3 else image  # written as RGB
            if n >= FIRST + DARK:
                image = np.ascontiguousarray(image[:, ::-1])
            elif n >= FIRST:
                image = np.zeros_like(image)
            write_image(folder / kind / f"{n:03d}.png", image)
            lines[kind].append(f"{n / 30:.6f} {kind}/{n:03d}.png\n")
        (folder / f"{kind}.txt").write_text("".join(lines[kind]))
    (folder / "camera.yaml").write_text((tiny_room / "camera.yaml").read_text())
    return folder


def run(sequence: Path, folder: Path, *options: object) -> dict[str, Any]:
    done = slamdepth("run", sequence, "-o", folder, "--depth", "sensor", "--no-mesh", *options)
    assert done.returncode == 0, done.stderr
    (folder / "stdout.txt").write_text(done.stdout)
    return dict(json.loads((folder / "report.json").read_text()))


def test_a_second_place_becomes_a_second_map(two_places: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    report = run(two_places, folder)
    assert [one["frames"] for one in report["maps"]] == [FIRST, SECOND]
    second, _ = read_tum_trajectory(folder / "maps" / "2" / "trajectory.txt")
    assert second.timestamps_s[0] >= (FIRST + DARK) / 30 - 1e-6
    online, _ = read_tum_trajectory(folder / "trajectory_online.txt")
    assert len(online) == FIRST + SECOND
    assert "in the world frame of map 2" in (folder / "trajectory_online.txt").read_text()
    assert "2 that never met" in (folder / "stdout.txt").read_text()
    assert report["health"]["verdict"] == "not trustworthy"
    assert all("too short to judge" in one["headline"] for one in report["health"]["maps"])


def test_with_a_single_map_the_camera_stays_lost(two_places: Path, tmp_path: Path) -> None:
    report = run(two_places, tmp_path / "run", "--single-map")
    assert [one["frames"] for one in report["maps"]] == [FIRST]
    assert not (tmp_path / "run" / "maps").exists()
