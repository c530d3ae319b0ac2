# SPDX-License-Identifier: Apache-2.0
"""Predicted depth of whole sequences on disk, so that every system and every run gets the same.

Stored as float16, which rounds by 0.05 %; predictions err by about 20 %.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth import depth
from slamdepth.datasets import Dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.weights import cache_dir
from slamdepth.errors import ConfigError, ImageDecodeError
from slamdepth.io import replacing
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.types import DepthKind, DepthPrediction, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)


def default_cache() -> Path:
    """The default folder of predictions and vocabularies."""
    return cache_dir() / "benchmarks"


def _code_sha256() -> str:
    """Digest of the code of depth inference."""
    hashed = hashlib.sha256()
    for file in sorted(Path(depth.__file__).parent.glob("*.py")):
        hashed.update(file.read_bytes())
    return hashed.hexdigest()


@dataclass(frozen=True)
class DepthCache:
    """The predictions of one model for one sequence, one file per frame."""

    folder: Path

    @classmethod
    def of(cls, root: Path, dataset: Dataset, model: DepthModel) -> DepthCache:
        """The folder below ``root`` of these weights, camera, frames and inference code."""
        camera = dataset.camera
        identity = "\n".join(
            [
                *(f"{info.name} {info.sha256} {info.precision}" for info in model.weights),
                _code_sha256(),
                f"{camera}",
                sequence_id(dataset),
            ]
        )
        digest = hashlib.sha256(identity.encode()).hexdigest()[:12]
        return cls(root / f"{dataset.name}-{model.name}-{digest}")

    def fill(self, dataset: Dataset, model: DepthModel, indices: Iterable[int]) -> int:
        """Predict the frames that are missing; returns their number.

        Raises:
            ConfigError: the model predicts no metric depth, so its values cannot replace a sensor's.
            OutputError: the cache cannot be written.
        """
        if model.kind is not DepthKind.METRIC:
            raise ConfigError(
                f"depth model '{model.name}' is not metric: peers cannot take it for a sensor's"
            )
        made = 0
        for index in indices:
            if self.has(index):
                continue
            try:
                frame = dataset.read(index)
            except ImageDecodeError as error:
                logger.warning("no depth predicted: %s", error)
                continue
            self.write(index, model.predict(frame).values)
            made += 1
        return made

    def has(self, index: int) -> bool:
        """Whether the cache has the frame."""
        return self._path(index).is_file()

    def write(self, index: int, maps: NDArray[np.float32]) -> None:
        """Store depth ``(H, W)`` of a frame, or several maps of one shape.

        Raises:
            OutputError: the file cannot be written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self._path(index)) as temporary, open(temporary, "wb") as file:
            np.save(file, maps.astype(np.float16))

    def read(self, index: int) -> NDArray[np.float32]:
        """The array that :meth:`write` got, as float32.

        Raises:
            FileNotFoundError: the frame was not predicted.
        """
        return np.asarray(np.load(self._path(index)), dtype=np.float32)

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npy"


class CachedDepth:
    """A depth model that predicts each frame of a sequence once and keeps depth and sigma in a cache.

    Gravity is not kept.
    """

    def __init__(self, model: DepthModel, cache: DepthCache) -> None:
        self.name, self.kind, self.weights = model.name, model.kind, model.weights
        self._model = model
        self._cache = cache

    def predict(self, frame: Frame) -> DepthPrediction:
        """The prediction of the model, read from the cache where the cache has it.

        Raises:
            OutputError: the cache cannot be written.
        """
        if not self._cache.has(frame.index):
            predicted = self._model.predict(frame)
            maps = [predicted.values, predicted.sigma_log]
            self._cache.write(frame.index, np.stack([one for one in maps if one is not None]))
        values, *sigma = self._cache.read(frame.index)
        return DepthPrediction(values, self.kind, sigma[0] if sigma else None)
