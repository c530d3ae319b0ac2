# SPDX-License-Identifier: Apache-2.0
"""The depth benchmark: baselines with known answers, places left out, times of stages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from test_depth_models import tiny_model

from benchmarks.depth import main, parse
from benchmarks.depth_baselines import ConstantDepth, MeanImageDepth, PixelMlp
from benchmarks.depth_judged import judged_row, mean_row, table
from benchmarks.depth_latency import noise_frame, stage_times, vit_of
from benchmarks.depth_left_out import DEFAULT_CONFIG, config_without, left_out_rows, places_of, unmixed
from slamdepth.depth.base import DepthModel
from slamdepth.depth.dinov2_mlp import MlpHead
from slamdepth.depth.registry import create_depth_model
from slamdepth.depth.scale import DepthScale
from slamdepth.depth.scaled import ScaledDepth
from slamdepth.errors import ConfigError
from slamdepth.training.config import SourceConfig, TrainConfig
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo


def frame_of(focal_px: float = 60.0) -> Frame:
    image = np.zeros((48, 64, 3), np.uint8)
    return Frame(0, 0.0, image, Camera(64, 48, focal_px, focal_px, 31.5, 23.5))


def make_place(folder: Path, depth_mm: int, count: int = 3) -> Path:
    folder.mkdir(parents=True)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:05d}.jpg"), np.full((48, 64, 3), 10 * k, np.uint8))
        depth = np.full((48, 64), depth_mm, np.uint16)
        depth[:, 32:] += 500
        cv2.imwrite(str(folder / f"{k:05d}.png"), depth)
    camera = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "depth_unit_m": 0.001}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def base_config(root: Path) -> TrainConfig:
    return TrainConfig.from_dict({
        "output": "head.safetensors",
        "sources": [
            {"folder": str(root), "limit": 30, "places": [
                {"name": "near", "samples": 40}, {"name": "far", "samples": 20}]},
            {"folder": str(root), "places": [{"name": "rooms", "samples": 10}]},
        ],
    })  # fmt: skip


def is_mixed(source: SourceConfig) -> bool:
    return source.augment is not None and source.augment.mixed > 0


def test_a_constant_and_a_mean_image() -> None:
    assert (ConstantDepth(1.5).predict(frame_of()).values == np.float32(1.5)).all()
    mean = MeanImageDepth(np.full((224, 224), 2.0, np.float32), focal_px=240.0)
    # 60 px at 64 x 48 is 210 px along x and 280 along y at 224 x 224
    values = mean.predict(frame_of(60.0)).values
    np.testing.assert_allclose(values, 2.0 * np.sqrt(210 * 280) / 240.0, rtol=1e-6)
    np.testing.assert_allclose(mean.predict(frame_of(120.0)).values, 2 * values, rtol=1e-6)


def test_the_head_without_a_vit_sees_pixels() -> None:
    head = MlpHead(32, 3 * 224 * 224, hidden=2).eval()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.zero_()
    prediction = PixelMlp(head, focal_px=np.sqrt(210 * 280)).predict(frame_of(60.0))
    assert prediction.values.shape == (48, 64)
    np.testing.assert_allclose(prediction.values, np.log(2.0), rtol=1e-5)  # softplus of 0


def test_simple_baselines_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained, judged = make_place(tmp_path / "trained", 1000), make_place(tmp_path / "judged", 2000)
    arguments = [
        "accuracy", str(judged), "--train", str(trained), "--models", "constant", "mean-image",
        "--output", str(tmp_path / "out"),
    ]  # fmt: skip
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| constant", "| mean-image"]
    files = [tmp_path / "out" / f"{name}@judged.json" for name in ("constant", "mean-image")]
    rows = [json.loads(file.read_text())["rows"][0] for file in files]
    constant, mean_image = (row["ways"]["as_predicted"]["abs_rel"]["value"] for row in rows)
    assert constant == pytest.approx((abs(1.25 - 2.0) / 2.0 + abs(1.25 - 2.5) / 2.5) / 2, abs=0.02)
    assert mean_image == pytest.approx((1.0 / 2.0 + 1.0 / 2.5) / 2, abs=0.02)
    assert rows[1]["ways"]["frame_affine"]["abs_rel"]["value"] == pytest.approx(0.0, abs=0.02)
    whole = json.loads((tmp_path / "out" / "accuracy.json").read_text())
    assert [row["model"] for row in whole["rows"]] == ["constant", "mean-image"]
    assert whole["settings"]["train"] == ["trained"]
    assert str(tmp_path) not in (tmp_path / "out" / "accuracy.json").read_text()
    arguments[1] = str(tmp_path / "nowhere")
    assert main(arguments) == 2
    assert "nowhere" in capsys.readouterr().err


def test_a_model_by_name_needs_no_training_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    judged = make_place(tmp_path / "judged", 2000)
    assert main(["accuracy", str(judged), "--models", "sensor", "--output", str(tmp_path / "out")]) == 0
    assert "| sensor | judged | 3 | 0.000 " in capsys.readouterr().out


def test_what_was_judged_is_not_judged_again(tmp_path: Path) -> None:
    data, file = make_place(tmp_path / "place", 2000), tmp_path / "out" / "row.json"
    first = judged_row(file, "two metres", lambda: ConstantDepth(2.0), data, {"seed": 0})
    again = judged_row(file, "two metres", lambda: pytest.fail("made again"), data, {"seed": 0})
    assert again == first
    other = judged_row(file, "one metre", lambda: ConstantDepth(1.0), data, {"seed": 1})
    assert other["model"] == "one metre"
    file.write_text("{")  # damaged: computed again
    assert judged_row(file, "x", lambda: ConstantDepth(1.0), data, {"seed": 1})["model"] == "x"


def test_the_mean_counts_each_data_set_the_same(tmp_path: Path) -> None:
    rows = []
    for depth_mm, count in ((2000, 2), (4000, 9)):
        data = make_place(tmp_path / str(depth_mm), depth_mm, count)
        rows.append(judged_row(tmp_path / f"{depth_mm}.json", "c", lambda: ConstantDepth(2.0), data, {}))
    mean = mean_row("mean", rows)
    each = [row["ways"]["as_predicted"]["abs_rel"]["value"] for row in rows]
    assert mean["ways"]["as_predicted"]["abs_rel"]["value"] == pytest.approx(sum(each) / 2)
    assert mean["surest_half"] is None
    assert len(table([*rows, mean]).splitlines()) == 5


def test_a_place_is_left_out_and_nothing_else(tmp_path: Path) -> None:
    base = base_config(tmp_path)
    assert places_of(base) == ("near", "far")
    config = config_without(base, "near", tmp_path / "x", samples=8, changes={"coarse_epochs": 1})
    assert [(s.places[0].name, s.places[0].samples) for s in config.sources] == [("far", 8), ("rooms", 8)]
    assert (config.coarse_epochs, config.fine_epochs) == (1, base.fine_epochs)
    whole = config_without(base, None, tmp_path / "x")
    # the limit of 30 of 60 views halves the places of its source
    assert [s.places[0].samples for s in whole.sources] == [20, 10, 10]
    assert all(source.limit is None and not source.held_out for source in whole.sources)
    with pytest.raises(ConfigError, match="'rooms' cannot be left out; there are: near, far"):
        config_without(base, "rooms", tmp_path / "x")


def test_each_left_out_place_is_trained_once(tmp_path: Path) -> None:
    for name, depth_mm in (("near", 1000), ("far", 3000), ("rooms", 2000), ("unseen", 2000)):
        make_place(tmp_path / "data" / name, depth_mm)
    trainings: list[list[str]] = []

    def train(config: TrainConfig) -> None:
        trainings.append([place.name for source in config.sources for place in source.places])
        Path(config.output).write_text("2.0")

    def run(**more: object) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        return left_out_rows(
            base_config(tmp_path / "data"), tmp_path / "out", ("near", "far"), [tmp_path / "data" / "unseen"],
            train=train, load=lambda head: ConstantDepth(float(head.read_text())),
            samples=4, changes={"seed": 1, **more},
        )  # fmt: skip

    (tmp_path / "out").mkdir()
    places, sequences = run()
    assert trainings == [["far", "rooms"], ["near", "rooms"], ["near", "far", "rooms"]]
    assert [row["model"] for row in places] == ["without-near", "without-far"]
    assert [row["data"] for row in sequences] == ["unseen"]
    errors = [rows[0]["ways"]["as_predicted"]["abs_rel"]["value"] for rows in (places, sequences)]
    assert errors == pytest.approx([(1 / 1 + 0.5 / 1.5) / 2, (0 + 0.5 / 2.5) / 2], abs=0.02)
    run()
    assert len(trainings) == 3  # nothing made again
    run(coarse_epochs=2)
    assert len(trainings) == 6  # other settings, other heads


def test_stages_add_up_and_the_vit_is_found() -> None:
    model = tiny_model()
    times = stage_times(model, [noise_frame("48x64")], "cpu", repeats=3, warm_up=1)
    assert times.shape == (3, 5)
    assert (times > 0).all()
    np.testing.assert_allclose(times[:, :3].sum(axis=1), times[:, 3])
    assert not vit_of(model)._forward_hooks  # nothing is left on the model
    with pytest.raises(ConfigError, match="no DINOv2 inside"):
        stage_times(ConstantDepth(1.0), [noise_frame("48x64")], "cpu", 1, 0)
    with pytest.raises(ConfigError, match="--frame 48"):
        noise_frame("48")


def test_a_vit_that_runs_twice_has_its_times_added_up() -> None:
    class Twice:
        name, kind = "twice", DepthKind.METRIC
        weights: tuple[WeightsInfo, ...] = ()

        def __init__(self) -> None:
            self._model = tiny_model()
            self.vit = self._model._backbone

        def predict(self, frame: Frame) -> DepthPrediction:
            self._model.predict(frame)
            return self._model.predict(frame)

    (times,) = stage_times(Twice(), [noise_frame("48x64")], "cpu", repeats=1, warm_up=1)
    assert times[:3].sum() == pytest.approx(times[3])
    assert times.min() > 0


def test_latency_of_a_model_and_the_error_of_one_without_a_vit(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def model(name: str, device: str) -> DepthModel:
        return tiny_model() if name == "tiny" else create_depth_model(name, device=device)

    monkeypatch.setattr("benchmarks.depth_latency._model", model)
    arguments = [
        "latency",
        "--models",
        "tiny",
        "sensor",
        "--threads",
        "1",
        "--repeats",
        "2",
        "--warm-up",
        "0",
    ]
    threads = torch.get_num_threads()
    try:
        assert main([*arguments, "--data", str(tiny_room), "-o", str(tmp_path / "latency.json")]) == 0
    finally:
        torch.set_num_threads(threads)
    printed = capsys.readouterr().out
    assert "| tiny | cpu | 1 | 240x320 | " in printed
    assert "| sensor | cpu | 1 | 240x320 | depth model 'sensor' has no DINOv2 inside" in printed
    written = json.loads((tmp_path / "latency.json").read_text())
    assert written["environment"]["versions"]["torch"]
    low, high = written["rows"][0]["spread"]["vit_ms"]
    assert 0 < low <= written["rows"][0]["figures"]["vit_ms"] <= high


def test_bad_options_of_the_command_end_with_the_usage(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["latency", "--repeats", "0"],
        ["accuracy"],
        ["left-out", "--samples", "few"],
        ["fast"],
    ):
        with pytest.raises(SystemExit):
            parse(arguments)
    assert "'few' is no whole number from 1" in capsys.readouterr().err


def test_a_left_out_place_is_left_out_of_every_source() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    config = config_without(base, "cafe_nyu", Path("head.safetensors"))
    names = [place.name for source in config.sources for place in source.places]
    assert "cafe_nyu" not in names
    assert "desk_kinect" in names


def test_sources_that_mix_views_can_be_left_out() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    config = config_without(unmixed(base), "cafe_nyu", Path("head.safetensors"))
    assert config.members == 1
    assert all(source.members is None and not is_mixed(source) for source in config.sources)
    mixed = [source for source in base.sources if is_mixed(source)]
    assert len(unmixed(base).sources) == len(base.sources) - len(mixed)
    with pytest.raises(ConfigError, match="no source whose views are not mixed"):
        unmixed(base.model_copy(update={"sources": tuple(mixed)}))


def test_sources_of_members_that_are_not_trained_are_left_out() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    of = [(0, 1) if is_mixed(source) else (1,) for source in base.sources]
    sources = tuple(s.model_copy(update={"members": m}) for s, m in zip(base.sources, of, strict=True))
    base = base.model_copy(update={"members": 2, "sources": sources})
    config = config_without(base, None, Path("head.safetensors"), changes={"members": 1})
    assert {source.members for source in config.sources} == {(0,)}
    assert all(is_mixed(source) for source in config.sources)


def test_places_left_out_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("near", "far", "rooms"):
        make_place(tmp_path / "data" / name, 1000)
    settings = tmp_path / "settings.yaml"
    settings.write_text(json.dumps(base_config(tmp_path / "data").model_dump(mode="json", exclude_none=True)))
    monkeypatch.setattr(
        "benchmarks.depth.train_depth", lambda config, **more: Path(config.output).write_text("")
    )
    monkeypatch.setattr("benchmarks.depth.create_depth_model", lambda name, **more: ConstantDepth(1.0))
    (tmp_path / "out").mkdir()
    assert main(["left-out", "--config", str(settings), "--output", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == [
        "| without-near", "| without-far", "| each without the place",
    ]  # fmt: skip
    assert len(json.loads((tmp_path / "out" / "left-out.json").read_text())["rows"]) == 3


def test_depth_of_a_model_is_compared_with_that_of_the_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def model(name: str, device: str) -> DepthModel:
        return tiny_model() if name == "tiny" else ScaledDepth(tiny_model(), DepthScale(1.1))

    monkeypatch.setattr("benchmarks.depth_latency._model", model)
    threads = torch.get_num_threads()
    try:
        main(["latency", "--models", "tiny", "larger", "--one-pass", "--threads", "1", "--repeats", "2"])
    finally:
        torch.set_num_threads(threads)
    first, larger = capsys.readouterr().out.splitlines()[2:4]
    assert first.split("|")[-2].strip() == "0.0000"
    assert larger.split("|")[-2].strip() == "0.0953"


@pytest.mark.parametrize("name", ["dinov2:int7", "dinov2:int8:many"])
def test_a_precision_or_size_that_is_none_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main(["latency", "--models", name, "--threads", "1"])
    assert f"'{name.split(':')[-1]}' is no" in capsys.readouterr().out
