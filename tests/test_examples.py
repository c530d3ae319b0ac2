# SPDX-License-Identifier: Apache-2.0
"""The programs of docs/examples run as they stand."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

import slamdepth
from slamdepth.datasets import write_camera

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


def program(name: str) -> Callable[[Sequence[str]], int]:
    """The ``main`` of an example."""
    main: Callable[[Sequence[str]], int] = runpy.run_path(str(EXAMPLES / name))["main"]
    return main


def reach_m(trajectory: slamdepth.Trajectory) -> float:
    """Largest distance from the first position."""
    positions_m = trajectory.T_world_camera[:, :3, 3]
    return float(np.linalg.norm(positions_m - positions_m[0], axis=1).max())


class DepthOfRoom:
    """True depth of the rendered room by frame number, as if predicted: a video file has no depth."""

    name = "room"
    kind = slamdepth.DepthKind.METRIC
    weights: tuple[slamdepth.WeightsInfo, ...] = ()

    def __init__(self, room: Path) -> None:
        self.dataset = slamdepth.open_dataset(room)

    def predict(self, frame: slamdepth.Frame) -> slamdepth.DepthPrediction:
        depth_m = self.dataset.read(frame.index, with_depth=True).depth_m
        assert depth_m is not None
        return slamdepth.DepthPrediction(depth_m, self.kind, np.full_like(depth_m, 0.05))


def test_a_sequence_becomes_a_mesh(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = tmp_path / "mesh.ply"
    assert program("video_to_mesh.py")([str(tiny_room), str(mesh), "--depth", "sensor"]) == 0
    assert mesh.stat().st_size > 10_000
    assert capsys.readouterr().out.splitlines()[-1].endswith("keyframes of 40 frames")


def test_a_missing_video_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program("video_to_mesh.py")([str(tmp_path / "none.mp4"), "mesh.ply"]) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_the_webcam_loop_tracks_a_video(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = slamdepth.open_dataset(tiny_room)
    camera = room.camera
    writer = cv2.VideoWriter(
        str(tmp_path / "room.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (camera.width, camera.height)
    )
    for index in range(len(room)):
        writer.write(cv2.cvtColor(room.read(index).image_rgb, cv2.COLOR_RGB2BGR))
    writer.release()
    write_camera(tmp_path / "camera.yaml", camera)
    monkeypatch.setattr(slamdepth, "create_depth_model", lambda name: DepthOfRoom(tiny_room))

    output = tmp_path / "trajectory.txt"
    arguments = [
        str(tmp_path / "room.avi"),
        "--camera",
        str(tmp_path / "camera.yaml"),
        "--output",
        str(output),
    ]
    assert program("webcam_loop.py")(arguments) == 0
    found, _ = slamdepth.read_tum_trajectory(output)
    assert len(found) == 40
    assert room.ground_truth is not None
    assert reach_m(found) == pytest.approx(reach_m(room.ground_truth), rel=0.1)


def test_an_own_depth_model_tracks_a_room(tiny_room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program("own_depth_model.py")([str(tiny_room)]) == 0
    poses, keyframes = capsys.readouterr().out.splitlines()[-1].split(", ")
    assert poses == "40 poses"
    assert int(keyframes.split()[0]) >= 1
