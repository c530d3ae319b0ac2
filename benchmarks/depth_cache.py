# SPDX-License-Identifier: Apache-2.0
"""Predicted depth of whole sequences on disk, so that every peer gets the very same.

Stored as float16: rounding of 0.05 %, against errors of the predictions of some 20 %.
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
from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)


def default_cache() -> Path:
    """Where benchmarks keep predictions and vocabularies unless told another folder."""
    return cache_dir() / "benchmarks"


def _code_sha256() -> str:
    """Of all that makes depth of images, trainings apart."""
    hashed = hashlib.sha256()
    for file in sorted(Path(depth.__file__).parent.glob("*.py")):
        hashed.update(file.read_bytes())
    return hashed.hexdigest()


@dataclass(frozen=True)
class DepthCache:
    """One model's predictions for one sequence, a file a frame."""

    folder: Path

    @classmethod
    def of(cls, root: Path, dataset: Dataset, model: DepthModel) -> DepthCache:
        """The folder below ``root``; other weights, camera or frames, or other code that predicts, have
        another one."""
        camera = dataset.camera
        identity = "\n".join(
            [
                *(f"{info.name} {info.sha256}" for info in model.weights),
                _code_sha256(),
                f"{camera}",
                sequence_id(dataset),
            ]
        )
        digest = hashlib.sha256(identity.encode()).hexdigest()[:12]
        return cls(root / f"{dataset.name}-{model.name}-{digest}")

    def fill(self, dataset: Dataset, model: DepthModel, indices: Iterable[int]) -> int:
        """Predict the frames that are not there yet; returns how many.

        Raises:
            ConfigError: the model predicts no metric depth, which is all a peer can take.
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
        """Whether the frame was predicted."""
        return self._path(index).is_file()

    def write(self, index: int, maps: NDArray[np.float32]) -> None:
        """Keep what was predicted for a frame; errors as of :meth:`fill`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self._path(index)) as temporary, open(temporary, "wb") as file:
            np.save(file, maps.astype(np.float16))

    def read(self, index: int) -> NDArray[np.float32]:
        """What was kept: metres ``(H, W)``, 0 where unknown, unless more was written.

        Raises:
            FileNotFoundError: the frame was not predicted.
        """
        return np.load(self._path(index)).astype(np.float32)

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npy"
