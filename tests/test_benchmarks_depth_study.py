# SPDX-License-Identifier: Apache-2.0
"""The study of baselines: blocks of pairs held out, the losses, pictures and times."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_benchmarks_depth import make_place

from benchmarks.depth import main
from benchmarks.depth_baselines import Baselines
from benchmarks.depth_blocks import every, held_out, open_pairs, without
from slamdepth.depth.dinov2_mlp import MlpHead
from slamdepth.errors import DatasetError
from slamdepth.training.mlp import MlpSettings
from slamdepth.training.readers.pairs import PairPlace
from slamdepth.typing import Floats32


def test_blocks_are_judged_together_and_left_out_of_training_with_their_neighbours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = make_place(tmp_path / "many", 1000, count=20), tmp_path / "out"
    for k in (4, 5, 12, 13):  # the blocks are farther away than the rest
        cv2.imwrite(str(folder / f"{k:05d}.png"), np.full((48, 64), 3000, np.uint16))
    blocks = ["--held-out", f"{folder}[4-5]", f"{folder}[12-13]"]
    arguments = [
        "accuracy", "--train", f"{folder}[0-17]", "--models", "constant", *blocks,
        "--margin", "2", "--pictures", "2", "--output", str(out),
    ]  # fmt: skip
    assert main(arguments) == 0
    (row,) = json.loads((out / "accuracy.json").read_text())["rows"]
    assert (row["data"], row["frames"]) == ("many-held-out", 4)
    error = row["ways"]["as_predicted"]["abs_rel"]["value"]
    assert error == pytest.approx((3.0 - 1.25) / 3.0, abs=0.02)  # trained on the near ones only
    assert 0 < row["predict_ms"]["low"] <= row["predict_ms"]["value"]
    picture = cv2.imread(str(out / "many-held-out.png"))
    assert picture is not None
    capsys.readouterr()
    assert main([*arguments[:2], str(folder), *arguments[3:]]) == 0  # trained on 18 and 19 too: judged again
    assert main(["accuracy", "--held-out", str(folder), "--models", "sensor", "--output", str(out)]) == 2
    assert "a block is NAME[FIRST-LAST]" in capsys.readouterr().err


def test_pairs_next_to_a_block_are_neither_trained_on_nor_judged(tmp_path: Path) -> None:
    place = open_pairs(make_place(tmp_path / "many", 1000, count=20))

    def numbers(part: PairPlace) -> list[int]:
        return [int(path.stem) for path in part.images]

    assert numbers(held_out(tmp_path / "many", [(4, 5), (12, 13)])) == [4, 5, 12, 13]
    left = without(place, [(4, 5), (12, 13)], margin=2)
    assert numbers(left) == [0, 1, 8, 9, 16, 17, 18, 19]
    assert numbers(every(left, 3)) == [0, 9, 18]
    assert without(place, [], margin=2) == place
    with pytest.raises(DatasetError, match="no pair is numbered 30 to 40"):
        held_out(tmp_path / "many", [(4, 5), (30, 40)])
    with pytest.raises(DatasetError, match="every pair is held out"):
        without(place, [(4, 15)], margin=4)


def test_the_network_is_trained_with_and_without_ssim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = open_pairs(make_place(tmp_path / "room", 1000))
    trained: list[MlpSettings] = []

    def train(features: NDArray[Any], depth_m: Floats32, settings: MlpSettings, **more: object) -> Any:
        trained.append(settings)
        return MlpHead(32, features.shape[1], hidden=2), [2.0, 1.0]

    monkeypatch.setattr("benchmarks.depth_baselines.train_mlp", train)
    monkeypatch.setattr(Baselines, "_tokens", np.zeros((3, 257 * 384), np.float16))
    monkeypatch.setattr("benchmarks.depth_baselines.Dinov2Mlp.load", lambda weights: weights)
    settings = {32: MlpSettings(epochs=2), 224: MlpSettings(epochs=1)}
    baselines = Baselines([place], settings, tmp_path)
    names = ("dinov2-mlp-32", "dinov2-mlp-32-mse", "dinov2-mlp-224-mse")
    for name in names:
        baselines.recipe(name).make()
    asked = [(settings.output, settings.ssim, settings.epochs) for settings in trained]
    assert asked == [(32, True, 2), (32, False, 2), (224, False, 1)]
    assert baselines.losses() == {name: [2.0, 1.0] for name in names}
    Baselines([place], MlpSettings(epochs=2), tmp_path).recipe("dinov2-mlp-32").make()
    assert len(trained) == 3  # found
