# SPDX-License-Identifier: Apache-2.0
"""OpenCV's feature networks with clear errors, and LightGlue, which matches whole images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import ConfigError, WeightsError
from slamdepth.frontend.features import Features
from slamdepth.frontend.matching import best_matches
from slamdepth.frontend.metric import FARTHEST
from slamdepth.typing import Ints


class LightGlue:
    """LightGlue (Lindenberger et al. 2023), which matches all keypoints of two images jointly.

    Its graph takes ``kpts0`` and ``kpts1`` ``(1, N, 2)`` in -1 to 1, ``desc0`` and ``desc1``
    ``(1, N, D)``, and gives ``matches0`` ``(M, 2)`` int64 and ``mscores0`` ``(M,)``.

    Args:
        path: its ONNX file, which must fit the features.

    Raises:
        WeightsError: the file cannot be read.
        ConfigError: this OpenCV lacks LightGlue.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        create = network_class("LightGlueMatcher").create
        with clear_errors(path, "LightGlue"):
            self._network = create(str(path))

    def match(self, a: Features, b: Features, *, side_px: float) -> tuple[Ints, Ints]:
        """Pairs of keypoints ``(P,)`` of two images, one to one.

        Args:
            side_px: the length that -1 to 1 stands for.

        Raises:
            WeightsError: the graph has other inputs or outputs.
        """
        if len(a) == 0 or len(b) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        with clear_errors(self._path, "LightGlue"):
            self._network.setPairInfo(*((2.0 * f.raw_px / side_px - 1.0).astype(np.float32) for f in (a, b)))
            found = self._network.match(a.descriptors, b.descriptors)
        q = np.array([m.queryIdx for m in found], dtype=np.int64)
        t = np.array([m.trainIdx for m in found], dtype=np.int64)
        distance = np.clip([m.distance * FARTHEST for m in found], 0, FARTHEST).astype(np.int64)
        q, t, _ = best_matches(q, t, distance, max_distance=FARTHEST, ratio=1.0)
        return q, t


def network_class(name: str) -> Any:
    """OpenCV's class for a network.

    Raises:
        ConfigError: this version lacks it.
    """
    import cv2

    found = getattr(cv2, name, None)
    if found is None:
        raise ConfigError(
            f"{name} is not in this OpenCV ({cv2.__version__}): install opencv-python-headless 5 or later"
        )
    return found


@contextmanager
def clear_errors(path: Path, what: str) -> Iterator[None]:
    """Turn OpenCV's errors about a network into one line, and silence its warnings.

    Raises:
        WeightsError: OpenCV could not read or run the file ``path``.
    """
    import cv2

    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_ERROR)  # of an engine that has no other target than the CPU
    try:
        yield
    except cv2.error as error:
        reason = (error.err or str(error)).strip().splitlines()[0]
        raise WeightsError(f"{path}: not a network that OpenCV runs as {what}: {reason}") from error
    finally:
        log.setLogLevel(level)
