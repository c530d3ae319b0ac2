# SPDX-License-Identifier: Apache-2.0
"""``slamdepth.pipeline.run`` as Python calls it."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from command_line import copy_of, leave_out_plots

from slamdepth.config import Config
from slamdepth.errors import ConfigError, DatasetError, OutputError
from slamdepth.io import read_tum_trajectory
from slamdepth.pipeline import RunInterrupted, RunProgress, RunStage, run


@pytest.fixture(autouse=True)
def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)


def test_a_run_returns_what_it_wrote_and_prints_nothing(
    tiny_room: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    states: list[RunProgress] = []
    result = run(
        str(tiny_room),
        tmp_path / "run",
        depth="sensor",
        config=Config.from_dict({"seed": 5, "map": {"voxel_size_m": 0.08}}),
        max_frames=6,
        progress=states.append,
    )
    assert result.folder == tmp_path / "run"
    assert not result.interrupted
    written, _ = read_tum_trajectory(result.folder / "trajectory.txt")
    assert len(result.trajectory) == len(written) == 6
    np.testing.assert_allclose(result.trajectory.T_world_camera, written.T_world_camera, atol=1e-6)
    assert result.summary["keyframes"] == len(result.reconstruction.keyframes)
    assert result.summary["depth_is_measured"] is True
    assert result.summary["settings"]["seed"] == 5
    assert (result.folder / "mesh.ply").is_file()
    assert result.summary["surface"]["se3"]["within"]["10cm"]["f_score"] > 0.9
    stages = list(dict.fromkeys(state.stage for state in states))
    assert stages == [
        RunStage.TRACKING, RunStage.OPTIMISING, RunStage.MESHING, RunStage.DRAWING, RunStage.SCORING,
        RunStage.COMPARING, RunStage.REPORTING,
    ]  # fmt: skip
    assert capfd.readouterr() == ("", "")
    assert "RunResult(" in repr(result)
    assert "keyframes=(" not in repr(result)


def test_settings_come_from_a_file_and_the_depth_model_from_the_call(tiny_room: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text("seed: 7\ndepth: {name: dinov2, max_m: 5.0}\n")
    camera = tiny_room / "camera.yaml"
    result = run(
        tiny_room,
        tmp_path / "run",
        depth="sensor",
        camera=str(camera),
        config=tmp_path / "settings.yaml",
        stride=2,
        max_frames=3,
        mesh=False,
    )
    settings = result.summary["settings"]
    assert (settings["seed"], settings["depth"]["name"], settings["depth"]["max_m"]) == (7, "sensor", 5.0)
    assert not (result.folder / "mesh.ply").exists()
    assert result.summary["options"] == {
        "max_frames": 3,
        "stride": 2,
        "mesh": False,
        "camera_file": True,
        "start_map": False,
        "map_images": False,
        "exports": (),
        "view_deg": None,
        "interrupted": False,
    }


def test_bad_input_is_an_error_and_leaves_nothing(tiny_room: Path, tmp_path: Path) -> None:
    colour = copy_of(tiny_room, tmp_path / "colour")
    (colour / "depth.txt").unlink()
    out = tmp_path / "out"
    with pytest.raises(DatasetError, match="no sensor depth"):
        run(colour, out, depth="sensor")
    with pytest.raises(DatasetError, match="no such folder"):
        run(tmp_path / "nothing", out)
    with pytest.raises(ConfigError, match="unknown depth model 'depht'"):
        run(tiny_room, out, depth="depht")
    with pytest.raises(ConfigError, match="stride"):
        run(tiny_room, out, stride=0)
    with pytest.raises(OutputError, match="is a file"):
        run(tiny_room, tiny_room / "rgb.txt", depth="sensor")
    stop = threading.Event()
    stop.set()
    with pytest.raises(RunInterrupted):
        run(tiny_room, out, depth="sensor", stop=stop)
    assert not out.exists()
