# SPDX-License-Identifier: Apache-2.0
"""Depth of the keyframes of a finished run against the sensor's: errors, edges, and stated deviations.

Edges are occluding contours as in Depth Pro (Bochkovskii et al., 2024): between direct neighbours, depth
jumps by more than 7 %, which is the same at any scale; the nearer pixel is the edge. At 320 pixels of width
an edge counts as found within one pixel of a true one. Precision, recall and F1 of edges are those of Hu et
al., "Revisiting single image depth estimation" (2019). Pixels next to an unknown depth are left out.
Unlike :func:`slamdepth.evaluation.depth_maps.edge_score`, which asks for the very pixel, this forgives the
registration of a Kinect, and sums pixels over all keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.dense.frames import FrameViews
from slamdepth.dense.rectify import Rectifier
from slamdepth.errors import ImageDecodeError
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.types import DepthKind, DepthPrediction
from slamdepth.typing import Bools, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

JUMP = 0.07
_EDGE_WIDTH_PX = 320
_STRIDE = 4  # of the pixels whose errors are kept


@dataclass
class EdgeCounts:
    """Pixels on edges, summed over images."""

    found: int = 0
    found_right: int = 0
    true: int = 0
    true_found: int = 0

    def add(self, depth_m: Floats32, truth_m: Floats32) -> None:
        """Count the edges of depth ``(H, W)`` against the true one; 0 is unknown in both."""
        step = max(1, truth_m.shape[1] // _EDGE_WIDTH_PX)
        ours, truth = (
            depth_m[step // 2 :: step, step // 2 :: step],
            truth_m[step // 2 :: step, step // 2 :: step],
        )
        judged = ~_grown((truth <= 0) | (ours <= 0))
        found, true = depth_edges(ours), depth_edges(truth)
        self.found += int((found & judged).sum())
        self.found_right += int((found & judged & _grown(true)).sum())
        self.true += int((true & judged).sum())
        self.true_found += int((true & judged & _grown(found)).sum())

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 0 where no edge was found."""
        if not self.found_right or not self.true_found:
            return 0.0
        precision, recall = self.found_right / self.found, self.true_found / self.true
        return 2 * precision * recall / (precision + recall)


def depth_edges(depth_m: Floats32) -> Bools:
    """Mask ``(H, W)`` of the pixels in front of a jump of depth of more than 7 % to a direct neighbour."""
    edge = np.zeros(depth_m.shape, bool)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        for near, far in ((a, b), (b, a)):
            edge[near] |= (depth_m[near] > 0) & (depth_m[far] > (1 + JUMP) * depth_m[near])
    return edge


def _grown(mask: Bools) -> Bools:
    """A mask with the eight neighbours of each pixel."""
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def score_keyframes(
    dataset: Dataset, reconstruction: Reconstruction, scale: float
) -> dict[str, float | int | None] | None:
    """Figures of the keyframes' final depth, multiplied by ``scale``; None without sensor depth.

    Returns:
        ``abs_rel`` and ``median``, mean and median relative error of all pixels with both depths;
        ``measured``, the share of the pixels that several views measured, and ``median_measured``, the median
        relative error there, None without dense depth; ``within_5``, the share within 5 %; ``edge_f1``;
        ``within_1_sigma`` and ``within_2_sigma``, shares of the pixels whose error of log depth is within the
        stated deviation, None where none is stated;
        ``keyframes``, their number.
    """
    errors: list[NDArray[np.float32]] = []
    whitened: list[NDArray[np.float32]] = []
    measured: list[NDArray[np.bool_]] = []
    edges, used = EdgeCounts(), 0
    for keyframe in reconstruction.keyframes:
        try:
            truth_m = dataset.read(keyframe.frame.index, with_depth=True).depth_m
        except ImageDecodeError:
            continue
        if truth_m is None:
            continue
        final = _final_depth(reconstruction, keyframe, truth_m)
        depth_m, truth_m = final.depth_m * np.float32(scale), final.truth_m
        edges.add(depth_m, truth_m)
        stride = max(1, _STRIDE * depth_m.shape[1] // dataset.camera.width)
        some = (slice(stride // 2, None, stride),) * 2
        ours, truth = depth_m[some], truth_m[some]
        known = (ours > 0) & (truth > 0)
        ratio = ours[known] / truth[known]
        errors.append(np.abs(ratio - 1))
        if final.sigma_log is not None:
            sigma_log = final.sigma_log[some][known]
            whitened.append(np.abs(np.log(ratio)) / np.maximum(sigma_log, np.float32(1e-6)))
        if final.is_measured is not None:
            measured.append(final.is_measured[some][known])
        used += 1
    if not used or not sum(map(len, errors)):
        return None
    error = np.concatenate(errors)
    inside = np.concatenate(whitened) if whitened else None
    chosen = np.concatenate(measured) if len(measured) == used else None
    return {
        "abs_rel": float(error.mean()),
        "median": float(np.median(error)),
        "measured": None if chosen is None else float(chosen.mean()),
        "median_measured": None if chosen is None or not chosen.any() else float(np.median(error[chosen])),
        "within_5": float((error <= 0.05).mean()),
        "edge_f1": edges.f1,
        "within_1_sigma": None if inside is None else float((inside <= 1).mean()),
        "within_2_sigma": None if inside is None else float((inside <= 2).mean()),
        "keyframes": used,
    }


@dataclass(frozen=True)
class _FinalDepth:
    """Depth of a keyframe and the true one at the same pixels ``(h, w)``, with what is stated of it."""

    depth_m: Floats32
    truth_m: Floats32
    sigma_log: Floats32 | None
    is_measured: Bools | None = None


def _final_depth(reconstruction: Reconstruction, keyframe: Keyframe, truth_m: Floats32) -> _FinalDepth:
    if keyframe.dense is None:
        depth_m = np.nan_to_num(keyframe.load_depth_m())
        return _FinalDepth(depth_m, truth_m, keyframe.prediction.load().sigma_log)
    dense, trajectory = keyframe.dense.load(), reconstruction.trajectory
    rectifier = Rectifier.of(
        keyframe.frame.camera,
        max(dense.camera.width, dense.camera.height),
        reconstruction.statistics.readout_s or 0.0,
    )
    row = int(np.searchsorted(trajectory.timestamps_s, keyframe.frame.timestamp_s))
    inverse_depth = 1.0 / float(np.median(dense.depth_m))
    positions = FrameViews(trajectory, lambda row: None, rectifier, inverse_depth).positions(row)
    return _FinalDepth(
        dense.depth_m, rectifier.nearest(truth_m, positions), dense.sigma_log, dense.is_measured
    )


def scaled_predictions(keyframes: Sequence[Keyframe]) -> tuple[Keyframe, ...]:
    """The keyframes with the network's own depth times one factor each, without what landmarks corrected.

    Raises:
        ValueError: the network predicts no metric depth.
    """
    if any(keyframe.prediction.kind is not DepthKind.METRIC for keyframe in keyframes):
        raise ValueError("a network that predicts no metric depth has no factor")
    return tuple(
        replace(keyframe, in_metres=partial(_times, factor=np.float32(keyframe.depth_scale)))
        for keyframe in keyframes
    )


def _times(prediction: DepthPrediction, factor: np.float32) -> Floats32:
    return np.asarray(prediction.values * factor, np.float32)
