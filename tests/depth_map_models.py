# SPDX-License-Identifier: Apache-2.0
"""Depth models and images made up for the tests of depth maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sequences import write_image

from slamdepth.depth import registry
from slamdepth.pipeline.depth_maps import DepthMapOptions, make_depth_maps
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

SEEN: list[int] = []


class Ramp:
    """Depth from 1 m at the left to 3 m at the right, 70 m in one corner; counts its calls."""

    def __init__(self, name: str, kind: DepthKind) -> None:
        self.name, self.kind = name, kind
        self.weights = (WeightsInfo(f"{name}-weights", "ab" * 32, "nothing", "none"),)

    def predict(self, frame: Frame) -> DepthPrediction:
        SEEN.append(frame.index)
        height, width = frame.image_rgb.shape[:2]
        values = np.tile(np.linspace(1.0, 3.0, width, dtype=np.float32), (height, 1))
        values[0, 0] = 70.0
        values[0, 1] = 0.0
        return DepthPrediction(values, self.kind)


def register_ramps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A :class:`Ramp` for each kind of depth, by the name ``ramp <kind>``."""
    SEEN.clear()
    for kind in DepthKind:
        name = f"ramp {kind.value}"
        factory: Any = lambda *, device, seed, n=name, k=kind: Ramp(n, k)  # noqa: E731
        monkeypatch.setitem(registry.MODELS.parts, name, factory)


METRIC = f"ramp {DepthKind.METRIC.value}"


INVERSE = f"ramp {DepthKind.AFFINE_INVERSE_DEPTH.value}"


def make(source: Path, output: Path, depth: str = METRIC, **options: Any) -> dict[str, Any]:
    return make_depth_maps(DepthMapOptions(source, output, depth, **options)).about


def photos(folder: Path, count: int = 3, side: tuple[int, int] = (64, 48)) -> Path:
    for i in range(count):
        rng = np.random.default_rng(i)
        write_image(folder / f"p{i + 8}.png", rng.integers(0, 256, (side[1], side[0], 3), dtype=np.uint8))
    return folder


def video(path: Path, count: int = 6) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    return path


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
