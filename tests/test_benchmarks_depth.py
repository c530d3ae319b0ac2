# SPDX-License-Identifier: Apache-2.0
"""The depth benchmarks: baselines with known answers, leave-one-out bookkeeping, stage timing."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks.depth_ablation import VARIANTS, variant_config
from benchmarks.depth_baseline_models import ConstantDepth, MeanImageDepth, PixelMlp
from benchmarks.depth_baselines import main as baselines
from benchmarks.depth_places import DEFAULT_CONFIG, config_without, leave_one_out, places_of, unmixed
from benchmarks.depth_rows import judged_row, mean_row, table
from slamdepth.depth.dinov2_mlp import MlpHead
from slamdepth.errors import ConfigError
from slamdepth.training.config import TrainConfig
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame


def frame_of(focal_px: float = 60.0) -> Frame:
    image = np.zeros((48, 64, 3), np.uint8)
    return Frame(0, 0.0, image, Camera(64, 48, focal_px, focal_px, 31.5, 23.5))


def make_place(folder: Path, depth_mm: int, count: int = 3) -> Path:
    folder.mkdir(parents=True)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:05d}.jpg"), np.full((48, 64, 3), 20 * k, np.uint8))
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
        for layer in head.layers:
            layer.weight.zero_()
            layer.bias.zero_()
    prediction = PixelMlp(head, focal_px=np.sqrt(210 * 280)).predict(frame_of(60.0))
    assert prediction.values.shape == (48, 64)
    np.testing.assert_allclose(prediction.values, np.log(2.0), rtol=1e-5)  # softplus of 0


def test_simple_baselines_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained, judged = make_place(tmp_path / "trained", 1000), make_place(tmp_path / "judged", 2000)
    arguments = [
        "--train", str(trained), "--judge", str(judged), "--models", "constant", "mean-image",
        "--output", str(tmp_path / "out"),
    ]  # fmt: skip
    assert baselines(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| constant", "| mean-image"]
    files = [tmp_path / "out" / f"{name}@judged.json" for name in ("constant", "mean-image")]
    rows = [json.loads(file.read_text()) for file in files]
    constant, mean_image = (row["ways"]["as_predicted"]["abs_rel"]["value"] for row in rows)
    assert constant == pytest.approx((abs(1.25 - 2.0) / 2.0 + abs(1.25 - 2.5) / 2.5) / 2, abs=0.02)
    assert mean_image == pytest.approx((1.0 / 2.0 + 1.0 / 2.5) / 2, abs=0.02)
    assert rows[1]["ways"]["frame_affine"]["abs_rel"]["value"] == pytest.approx(0.0, abs=0.02)
    arguments[3] = str(tmp_path / "nowhere")
    assert baselines(arguments) == 2
    assert "nowhere" in capsys.readouterr().err


def test_what_was_judged_is_not_judged_again(tmp_path: Path) -> None:
    data, file = make_place(tmp_path / "place", 2000), tmp_path / "out" / "row.json"
    first = judged_row(file, "two metres", lambda: ConstantDepth(2.0), data, {"seed": 0})
    again = judged_row(file, "two metres", lambda: pytest.fail("made again"), data, {"seed": 0})
    assert again == first
    other = judged_row(file, "one metre", lambda: ConstantDepth(1.0), data, {"seed": 1})
    assert other["model"] == "one metre"
    file.write_text("{")  # damaged: made anew
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
    config = config_without(base, "near", tmp_path / "x", samples=8, overruled={"coarse_epochs": 1})
    assert [(s.places[0].name, s.places[0].samples) for s in config.sources] == [("far", 8), ("rooms", 8)]
    assert (config.coarse_epochs, config.fine_epochs) == (1, base.fine_epochs)
    whole = config_without(base, None, tmp_path / "x")
    # the limit of 30 of 60 views halves the places of its source
    assert [s.places[0].samples for s in whole.sources] == [20, 10, 10]
    assert all(source.limit is None and not source.held_out for source in whole.sources)
    with pytest.raises(ConfigError, match="'rooms' cannot be left out; there are: near, far"):
        config_without(base, "rooms", tmp_path / "x")


def test_leave_one_out_trains_each_once(tmp_path: Path) -> None:
    for name, depth_mm in (("near", 1000), ("far", 3000), ("rooms", 2000), ("unseen", 2000)):
        make_place(tmp_path / "data" / name, depth_mm)
    trainings: list[list[str]] = []

    def train(config: TrainConfig) -> None:
        trainings.append([place.name for source in config.sources for place in source.places])
        Path(config.output).write_text("2.0")

    def run(**more: object) -> tuple[list[dict], list[dict]]:
        return leave_one_out(
            base_config(tmp_path / "data"), tmp_path / "out", leave_out=("near", "far"),
            zero_shot=(tmp_path / "data" / "unseen",), samples=4, overruled={"seed": 1, **more},
            train=train, load=lambda head: ConstantDepth(float(head.read_text())),
        )  # fmt: skip

    (tmp_path / "out").mkdir()
    places, sequences = run()
    assert trainings == [["far", "rooms"], ["near", "rooms"], ["near", "far", "rooms"]]
    assert [row["model"] for row in places] == ["without-near", "without-far"]
    assert [row["settings"]["data"] for row in sequences] == ["unseen"]
    errors = [rows[0]["ways"]["as_predicted"]["abs_rel"]["value"] for rows in (places, sequences)]
    assert errors == pytest.approx([(1 / 1 + 0.5 / 1.5) / 2, (0 + 0.5 / 2.5) / 2], abs=0.02)
    run()
    assert len(trainings) == 3  # nothing made again
    run(coarse_epochs=2)
    assert len(trainings) == 6  # other settings, other heads


def test_stages_add_up_and_the_vit_is_found() -> None:
    from test_depth_models import tiny_model

    from benchmarks.depth_latency_stages import frame_of as noise
    from benchmarks.depth_latency_stages import stage_times, vit_of

    model = tiny_model()
    times = stage_times(model, noise("48x64"), "cpu", repeats=3, warm_up=1)
    assert set(times) == {"resize_ms", "vit_ms", "head_ms", "together_ms", "cpu_ms"}
    assert all(value > 0 for value in times.values())
    assert not vit_of(model)._forward_hooks  # nothing is left hanging on the model
    with pytest.raises(ConfigError, match="no DINOv2 inside"):
        stage_times(ConstantDepth(1.0), noise("48x64"), "cpu", 1, 0)
    with pytest.raises(ConfigError, match="--frame 48"):
        noise("48")


def test_a_model_that_looks_twice_has_its_looks_added_up() -> None:
    from test_depth_models import tiny_model

    from benchmarks.depth_latency_stages import frame_of as noise
    from benchmarks.depth_latency_stages import stage_times

    class Twice:
        name, kind, weights = "twice", DepthKind.METRIC, ()

        def __init__(self) -> None:
            self._model = tiny_model()
            self.vit = self._model._backbone

        def predict(self, frame: Frame) -> DepthPrediction:
            self._model.predict(frame)
            return self._model.predict(frame)

    times = stage_times(Twice(), noise("48x64"), "cpu", repeats=1, warm_up=1)
    assert times["resize_ms"] + times["vit_ms"] + times["head_ms"] == pytest.approx(times["together_ms"])
    assert min(times.values()) > 0


def test_forms_of_the_vit_are_measured_against_eager() -> None:
    from benchmarks.depth_latency_variants import VARIANTS, variant_row
    from slamdepth.depth.dinov2 import DinoV2

    def vit(device: str) -> DinoV2:
        torch.manual_seed(0)
        return DinoV2(dim=24, depth=12, heads=3, grid=5).eval().requires_grad_(False).to(device)

    def row(variant: str) -> dict:
        return variant_row(variant, "cpu", (28, 42), 2, 1, vit)

    exact = row("eager")
    assert (exact["error"], exact["size"]) == (0.0, "28x42")
    assert exact["wall_ms"] > 0
    assert row("channels-last")["error"] < 1e-5
    for rough in ("bfloat16", "bfloat16-autocast", "int8"):
        assert 1e-5 < row(rough)["error"] < 0.2, rough
    assert row("float16")["failed"] == "float16 is for GPUs"
    assert {"compile", "onnx", "onnx-int8"} <= set(VARIANTS)


def test_latency_tables_say_what_could_not_be_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from benchmarks import depth_latency

    good = {"variant": "eager", "device": "cpu", "size": "28x28", "threads": 1}
    monkeypatch.setattr(
        depth_latency, "variant_row", lambda *_: {**good, "wall_ms": 2.0, "cpu_ms": 1.5, "error": 0.0}
    )
    arguments = [
        "--models",
        "sensor",
        "--variants",
        "eager",
        "--threads",
        "1",
        "--sizes",
        "28x28",
        "--no-cuda",
    ]
    threads = torch.get_num_threads()
    try:
        assert depth_latency.main([*arguments, "-o", str(tmp_path / "latency.json")]) == 0
    finally:
        torch.set_num_threads(threads)
    shown = capsys.readouterr().out
    assert "| sensor | cpu | 1 | depth model 'sensor' has no DINOv2 inside" in shown
    assert "| eager | cpu | 28x28 | 1 | 2.0 | 1.5 | 0.0000 |" in shown
    written = json.loads((tmp_path / "latency.json").read_text())
    assert written["environment"]["versions"]["torch"]
    assert written["variants"][0]["wall_ms"] == 2.0
    assert depth_latency.main(["--sizes", "30x30"]) == 2
    assert "multiples of 14" in capsys.readouterr().err
    assert depth_latency.main(["--variants", "int3"]) == 2


def test_each_variant_of_the_ablation_changes_what_it_says() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    real = base.sources[0].folder
    made = {label: variant_config(base, change, samples=5, steps=20) for label, change in VARIANTS.items()}
    whole = made["as shipped"]
    assert whole.members == 1
    assert all(source.members is None for source in whole.sources)
    assert {s.folder == real for s in whole.sources} == {True, False}
    assert {s.folder == real for s in made["real places only"].sources} == {True}
    assert {s.folder == real for s in made["synthetic rooms only"].sources} == {False}
    assert not any(s.augment and s.augment.mixed for s in made["no mixing of scenes"].sources)
    assert made["last block only"].head.taps == (11,)
    assert (made["likelihood only"].loss.gradient, made["likelihood only"].loss.scale_invariant) == (0, 0)
    unlike = [config.model_dump() for config in made.values()]
    assert all(a != b for k, a in enumerate(unlike) for b in unlike[:k])


def test_a_left_out_place_is_left_out_of_every_source() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    config = config_without(base, "cafe_nyu", Path("head.safetensors"))
    names = [place.name for source in config.sources for place in source.places]
    assert "cafe_nyu" not in names
    assert "desk_kinect" in names


def test_one_head_of_what_is_not_mixed() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    plain = unmixed(base)
    assert [(source.folder, source.teaches) for source in plain.sources] == [
        ("depth_training", "level"), ("synth", "relief"), ("synth", "both"),
        ("depth_training", "down"), ("synth", "down"), ("synth", "down"),
    ]  # fmt: skip
    config = config_without(plain, "cafe_nyu", Path("head.safetensors"))
    assert config.members == 1
    assert all(source.members is None and not source.augment.mixed for source in config.sources)
    mixed = [source for source in base.sources if source.augment.mixed]
    with pytest.raises(ConfigError, match="no source whose views are not mixed"):
        unmixed(base.model_copy(update={"sources": tuple(mixed)}))


def test_fewer_members_leave_out_what_only_the_others_learn_from() -> None:
    base = TrainConfig.from_yaml(DEFAULT_CONFIG)
    of = [(1,) if source.augment is None or not source.augment.mixed else (0, 1) for source in base.sources]
    told = [s.model_copy(update={"members": m}) for s, m in zip(base.sources, of, strict=True)]
    base = base.model_copy(update={"members": 2, "sources": tuple(told)})
    config = config_without(base, None, Path("head.safetensors"), overruled={"members": 1})
    assert {source.members for source in config.sources} == {(0,)}
    assert all(source.augment.mixed for source in config.sources)
