# SPDX-License-Identifier: Apache-2.0
"""Base class of depth models that are one network."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from slamdepth.depth.card import ModelCard
from slamdepth.depth.preprocess import check_size, focal_px_at
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo


class NetworkDepth(ABC):
    """A :class:`~slamdepth.depth.base.DepthModel` around a network; a subclass runs it in :meth:`infer`.

    Attributes:
        name: the registered name, from the card.
        kind: what the values of its predictions mean, from the card.
        card: what it was trained on and at which size and focal length.
        weights: the files.
        device: where it runs.
    """

    def __init__(self, card: ModelCard, weights: tuple[WeightsInfo, ...], device: str = "cpu") -> None:
        self.name: str = card.name
        self.kind: DepthKind = card.kind
        self.card = card
        self.weights = weights
        self.device = device

    def focal_px(self, camera: Camera, size: tuple[int, int]) -> float:
        """Focal length in pixels of ``camera``'s image resized to ``size`` (rows, columns): the geometric
        mean over both axes."""
        return focal_px_at(camera, *size)

    @abstractmethod
    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Run the network on an RGB image ``(H, W, 3)``.

        Returns:
            The network's values ``(H, W)`` at the image's own resolution, and the rows and columns that the
            image was resized to (without padding).
        """

    def predict(self, frame: Frame) -> DepthPrediction:
        """Values of :attr:`kind` for every raw (not undistorted) pixel of ``frame``.

        Metric depth of a network trained at focal length f0 is multiplied by f / f0 for a camera of focal
        length f, both in pixels of the network's input.

        Raises:
            CameraError: the image is too small or too narrow for the network.
        """
        check_size(frame)
        values, size = self.infer(frame.image_rgb)
        if self.kind is DepthKind.METRIC and self.card.native_focal_px is not None:
            values = values * np.float32(self.focal_px(frame.camera, size) / self.card.native_focal_px)
        return DepthPrediction(np.ascontiguousarray(values, dtype=np.float32), self.kind)
