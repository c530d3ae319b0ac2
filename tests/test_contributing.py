# SPDX-License-Identifier: Apache-2.0
"""The examples of CONTRIBUTING.md work as they stand."""

from __future__ import annotations

import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamdepth.config import FeatureConfig
from slamdepth.datasets import open_dataset, registry, write_camera
from slamdepth.depth import registry as depth_registry
from slamdepth.frontend import features
from slamdepth.types import Camera, Frame

TEXT = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)


@pytest.fixture(autouse=True)
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What an example registers is gone after its test."""
    registry.known_readers()
    monkeypatch.setattr(registry.READERS, "parts", dict(registry.READERS.parts))
    monkeypatch.setattr(depth_registry.MODELS, "parts", dict(depth_registry.MODELS.parts))
    features.feature_names()
    monkeypatch.setattr(features.EXTRACTORS, "parts", dict(features.EXTRACTORS.parts))
    yield
    sys.modules.pop("example_of_contributing", None)


def run_example(heading: str) -> None:
    section = TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]
    found = re.search(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    assert found is not None
    module = types.ModuleType("example_of_contributing")
    sys.modules[module.__name__] = module
    exec(compile(found[1], "CONTRIBUTING.md", "exec"), module.__dict__)


def noise_image() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))


def test_the_depth_model() -> None:
    run_example("Add a depth model")
    model = depth_registry.create_depth_model("wall")
    prediction = model.predict(Frame(0, 0.0, noise_image(), CAMERA))
    assert prediction.values.shape == (240, 320)
    assert "wall" in depth_registry.depth_model_names()


def test_the_dataset(tmp_path: Path) -> None:
    run_example("Add a dataset")
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"numbered-{number:03d}.png"), noise_image())
    write_camera(tmp_path / "own.yaml", CAMERA)
    dataset = open_dataset(tmp_path, tmp_path / "own.yaml")
    assert len(dataset) == 3
    assert dataset.read(2).timestamp_s == pytest.approx(2 / 30)


def test_the_feature() -> None:
    run_example("Add a feature")
    extractor = features.create_extractor(FeatureConfig(name="sift-fine", count=200))
    found = extractor.extract(np.asarray(cv2.cvtColor(noise_image(), cv2.COLOR_RGB2GRAY)), CAMERA)
    assert len(found) > 20
    assert set(found.octave.tolist()) <= {0, 1, 2, 3}
    assert "sift-fine" in features.feature_names()
