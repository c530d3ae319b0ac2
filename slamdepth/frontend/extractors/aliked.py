# SPDX-License-Identifier: Apache-2.0
"""ALIKED, a network in an ONNX file, run by OpenCV; whole images matched by LightGlue where asked for."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.errors import WeightsError
from slamdepth.frontend.features import Features, ScaleLevels, register_extractor
from slamdepth.frontend.keypoints import cell_edge_px, pixels, responses, spread
from slamdepth.frontend.metric import UnitL2
from slamdepth.frontend.networks import LightGlue, clear_errors, network_class
from slamdepth.frontend.orb_descriptors import OrbDescriptors
from slamdepth.types import Camera
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


_METRIC = UnitL2(128, max_l2=0.8, strict_l2=0.7)
_MIN_SCORE = 0.2  # the authors' own


@register_extractor("aliked", needs_weights=True)
class AlikedExtractor:
    """ALIKED (Zhao et al. 2023), 128 numbers.

    Its graph takes ``image`` ``(1, 3, rows, columns)`` and gives ``keypoints`` ``(N, 2)``, -1 to 1 from
    the centre of the first pixel to that of the last, ``descriptors`` ``(N, 128)`` and ``scores`` ``(N,)``.
    An image is padded to the input's aspect, not stretched. The thresholds are guesses, not measured with
    a published file.

    Raises:
        WeightsError: the file is missing, unreadable or another network.
        ConfigError: this OpenCV lacks ALIKED.
    """

    def __init__(self, config: FeatureConfig) -> None:
        assert config.weights is not None
        self._path = Path(config.weights).expanduser()
        self._count = config.count
        # its keypoints have no size: those at most 2.8 times nearer or farther may match
        self.levels = ScaleLevels(2.0, 1)
        kind, parameters = network_class("ALIKED"), network_class("ALIKED_Params")()
        self._rows, self._columns = _input_size(self._path)
        parameters.inputSize = (self._columns, self._rows)
        with clear_errors(self._path, "ALIKED"):
            self._network = kind.create(str(self._path), parameters)
        self._run(np.zeros((self._rows, self._columns), np.uint8))
        self._glue = None if config.matcher is None else LightGlue(Path(config.matcher).expanduser())

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        """See :class:`slamdepth.frontend.features.FeatureExtractor`."""
        raw_px, score, described = self._run(gray)
        inside = (raw_px >= -0.5) & (raw_px < [gray.shape[1] - 0.5, gray.shape[0] - 0.5])
        at = np.flatnonzero(inside.all(axis=1) & (score > _MIN_SCORE))
        at = at[spread(np.maximum(raw_px[at], 0), score[at], self._count, cell_edge_px(gray, self._count))]
        glue = self._glue
        matcher = None if glue is None else partial(glue.match, side_px=float(max(gray.shape)))
        octave = np.zeros(len(at), dtype=np.int64)
        return Features(
            raw_px=raw_px[at],
            px=camera.undistort_points(raw_px[at]),
            octave=octave,
            sigma_px=self.levels.sigma_px(octave),
            descriptors=described[at],
            metric=_METRIC,
            orb_descriptors=OrbDescriptors(gray, self._count),
            matcher=matcher,
        )

    def _run(self, gray: NDArray[np.uint8]) -> tuple[Floats, Floats, NDArray[np.float32]]:
        """Pixels ``(N, 2)`` of the image, scores ``(N,)`` and descriptors ``(N, 128)`` of unit length."""
        import cv2

        zoom = max(gray.shape[0] / self._rows, gray.shape[1] / self._columns)
        rows, columns = (max(1, round(side * zoom)) for side in (self._rows, self._columns))
        bottom, right = max(0, rows - gray.shape[0]), max(0, columns - gray.shape[1])
        image = cv2.copyMakeBorder(gray, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        with clear_errors(self._path, "ALIKED"):
            keypoints, described = self._network.detectAndCompute(
                cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), None
            )
        if described is None or described.shape != (len(keypoints), _METRIC.size):
            shape = None if described is None else described.shape
            raise WeightsError(f"{self._path}: ALIKED's descriptors are {shape}, not (N, {_METRIC.size})")
        # OpenCV says (keypoint + 1) / 2 * size; the network means a share of size - 1
        whole = np.array([image.shape[1], image.shape[0]], dtype=np.float64)
        into = np.array([self._columns, self._rows], dtype=np.float64)
        px = (pixels(keypoints) / whole * (into - 1) + 0.5) * whole / into - 0.5
        length = np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-6)
        return px, responses(keypoints), np.ascontiguousarray(described / length, dtype=np.float32)


def _input_size(path: Path) -> tuple[int, int]:
    """Rows and columns of the graph's input ``image``.

    Raises:
        WeightsError: the file is no such graph.
    """
    import onnx

    try:
        graph = onnx.load(path, load_external_data=False).graph
    except Exception as error:  # protobuf's errors share no base class with the others
        raise WeightsError(f"{path}: not a readable ONNX file: {error}") from error
    for given in graph.input:
        shape = [dim.dim_value for dim in given.type.tensor_type.shape.dim]
        if given.name == "image" and len(shape) == 4 and min(shape[1:]) > 0 and shape[1] == 3:
            return shape[2], shape[3]
    inputs = ", ".join(given.name for given in graph.input)
    raise WeightsError(
        f"{path}: takes {inputs or 'nothing'}, not 'image' (1, 3, rows, columns) as ALIKED does"
    )
