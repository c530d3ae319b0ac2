# SPDX-License-Identifier: Apache-2.0
"""``slamdepth scale`` and the scale options of ``slamdepth run``, on a small rendered room."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import call, copy_of, leave_out_plots
from tracking_scene import ConstantDepth

from slamdepth.depth import registry
from slamdepth.depth.scale_file import read_scale
from slamdepth.io import read_tum_trajectory
from slamdepth.types import DepthKind, WeightsInfo

SHORT = ("--max-frames", 20, "--no-mesh", "--quiet")


@pytest.fixture(autouse=True)
def flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth models: ``flat``, which takes a weights file, and a relative one; reports without plots."""
    leave_out_plots(monkeypatch)
    monkeypatch.setattr(registry.MODELS, "parts", dict(registry.MODELS.parts))

    @registry.register("flat")
    def make(*, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> ConstantDepth:
        model = ConstantDepth()
        model.name = "flat"
        model.weights = (WeightsInfo("flat", "0" * 64 if weights is None else weights.name, "-", "-"),)
        return model

    @registry.register("relative")
    def relative(*, device: str = "cpu", seed: int = 0) -> ConstantDepth:
        model = ConstantDepth()
        model.name, model.kind = "relative", DepthKind.AFFINE_INVERSE_DEPTH
        return model


@pytest.fixture(scope="module")
def without_depth(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_of(tiny_room, tmp_path_factory.mktemp("colour") / "room")
    (folder / "depth.txt").unlink()
    shutil.rmtree(folder / "depth")
    return folder


def run(room: Path, folder: Path, *arguments: object) -> dict[str, Any]:
    done = call("run", room, "--depth", "flat", *SHORT, "--output", folder, *arguments)
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    assert report["scale"]["sentence"].split()[0] in done.stdout
    assert report["scale"]["sentence"][:60] in (folder / "report.html").read_text()
    return report


def test_a_scale_is_fitted_kept_and_applied(tiny_room: Path, tmp_path: Path) -> None:
    file = tmp_path / "scale.yaml"
    done = call("scale", tiny_room, "--depth", "flat", "--stride", 5, "--output", file)
    assert done.returncode == 0, done.stderr
    fit = read_scale(file)
    assert (fit.model, fit.sequence, fit.frames) == ("flat", "room", 8)
    assert f"{fit.scale.scale:.4g}" in done.stdout
    assert str(file) in done.stdout.replace("\n", "")

    report = run(tiny_room, tmp_path / "one", "--depth-scale", file)
    scale = report["scale"]
    assert (scale["source"], scale["factor"]) == ("file", fit.scale.scale)
    assert scale["from_ground_truth"]  # the file is of this very sequence
    assert "SE(3) ATE is not a metric claim" in scale["sentence"]
    assert report["settings"]["scale"]["depth"] == "scale.yaml"
    again = tmp_path / "again"
    done = call("run", tiny_room, "--config", tmp_path / "one" / "config.yaml", *SHORT, "-o", again)
    assert done.returncode == 0, done.stderr
    assert (again / "trajectory.txt").read_bytes() == (tmp_path / "one" / "trajectory.txt").read_bytes()

    other = call("run", tiny_room, "--depth", "flat", "--depth-weights", "x", "--depth-scale", file)
    assert other.returncode == 2
    assert "was fitted with other weights of 'flat'" in other.stderr


def test_an_interrupted_fit_says_that_nothing_is_kept(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(model: ConstantDepth, frame: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ConstantDepth, "predict", interrupt)
    done = call("scale", tiny_room, "--depth", "flat", "--output", tmp_path / "scale.yaml")
    assert (done.returncode, done.stderr) == (130, "error: interrupted: nothing was written\n")
    assert list(tmp_path.iterdir()) == []


def test_a_scale_of_an_earlier_call_is_replaced(tiny_room: Path, tmp_path: Path) -> None:
    file = tmp_path / "scale.yaml"
    for frames in (1, 2):
        done = call("scale", tiny_room, "--depth", "flat", "--max-frames", frames, "--output", file)
        assert done.returncode == 0, done.stderr
        assert read_scale(file).frames == frames


def test_ground_truth_depth_is_fitted_first(tiny_room: Path, tmp_path: Path) -> None:
    report = run(tiny_room, tmp_path / "run", "--max-frames", 40, "--depth-scale", "groundtruth")
    assert report["scale"]["source"] == "groundtruth-depth"
    fitted = read_scale(tmp_path / "run" / "depth_scale.yaml").scale.scale
    assert fitted == report["scale"]["prediction_factor"]
    assert report["scale"]["factor"] == pytest.approx(fitted, rel=0.1)
    assert "the map was multiplied by" in report["scale"]["sentence"]
    assert report["ate"]["sim3"]["scale"] == pytest.approx(1.0, abs=0.02)
    assert "depth_scale.yaml" in (tmp_path / "run" / "report.html").read_text()


def test_without_sensor_the_ground_truth_trajectory_gives_the_scale(
    without_depth: Path, tmp_path: Path
) -> None:
    report = run(without_depth, tmp_path / "run", "--depth-scale", "groundtruth")
    assert report["scale"]["source"] == "groundtruth-trajectory"
    assert report["ate"]["sim3"]["scale"] == pytest.approx(1.0, abs=1e-6)
    assert report["scale"]["from_ground_truth"]


def test_a_number_and_a_known_baseline(tiny_room: Path, tmp_path: Path) -> None:
    given = run(tiny_room, tmp_path / "given")
    half = run(tiny_room, tmp_path / "half", "--depth-scale", 0.5)
    assert half["scale"]["source"] == "value"
    ratio = half["ate"]["sim3"]["scale"] / given["ate"]["sim3"]["scale"]
    assert ratio == pytest.approx(2.0, rel=0.03)

    from slamdepth.datasets import open_dataset

    truth = open_dataset(tiny_room).ground_truth
    assert truth is not None
    times, positions = truth.timestamps_s, truth.T_world_camera[:, :3, 3]
    length_m = float(((positions[19] - positions[0]) ** 2).sum() ** 0.5)
    between = ("--baseline-between", times[0], times[19])
    known = run(tiny_room, tmp_path / "known", "--baseline-m", length_m, *between)
    assert known["scale"]["source"] == "baseline"
    found, _ = read_tum_trajectory(tmp_path / "known" / "trajectory.txt")
    positions = found.T_world_camera[:, :3, 3]
    assert ((positions[19] - positions[0]) ** 2).sum() ** 0.5 == pytest.approx(length_m, rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("scale", "COLOUR", "--depth", "flat"),
            "has no sensor depth (no depth images), so no scale can be fitted",
        ),
        (("scale", "ROOM", "--depth", "sensor"), "in metres already"),
        (("scale", "ROOM", "--depth", "relative"), "fit both (--shift)"),
        (("scale", "ROOM", "--depth", "relative", "--shift"), "the same value everywhere"),
        (("scale", "ROOM", "--depth", "flat", "-o", "absent/scale.yaml"), "no such folder to write to"),
        (("run", "ROOM", "--depth", "sensor", "--depth-scale", "2"), "is for predicted depth"),
        (("run", "ROOM", "--depth", "sensor", "--depth-weights", "x"), "takes no weights file"),
        (("run", "ROOM", "--depth", "flat", "--depth-scale", "absent.yaml"), "cannot read the depth scale"),
        (("run", "ROOM", "--depth", "flat", "--depth-scale", "0"), "must be a positive number"),
        (("run", "ROOM", "--depth", "relative"), "'slamdepth scale SEQ --shift"),
        (("run", "ROOM", "--depth", "relative", "--depth-scale", "2"), "a scale alone does not make it"),
        (("run", "ROOM", "--depth", "flat", "--baseline-between", "0", "1"), "need its length"),
        (
            ("run", "ROOM", "--depth", "flat", "--baseline-m", "1", "--baseline-between", "0", "99"),
            "the frames run from",
        ),
    ],
)
def test_bad_calls(
    arguments: tuple[str, ...], message: str, tiny_room: Path, without_depth: Path, tmp_path: Path
) -> None:
    places = {"ROOM": str(tiny_room), "COLOUR": str(without_depth)}
    given = [places.get(a, a) for a in arguments]
    folder = ["--output", str(tmp_path / "run")] if arguments[0] == "run" else []
    done = call(*given, *folder)
    assert done.returncode == 2
    assert message in done.stderr.replace("\n", " ")
    assert done.stderr.count("error:") == 1
    assert list(tmp_path.iterdir()) == []
