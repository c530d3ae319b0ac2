# SPDX-License-Identifier: Apache-2.0
"""Dense depth of a keyframe with its deviation, as a pinhole camera with a global shutter would see it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.codec import encode_half_precision, encode_image
from slamdepth.types import Camera

if TYPE_CHECKING:
    from slamdepth.mapping.spill_file import SpilledArray, SpillFile
    from slamdepth.typing import Bools, Bytes, Floats32


@dataclass(frozen=True)
class DenseDepth:
    """Dense depth with its deviation.

    Attributes:
        camera: pinhole, of the size of the maps.
        image_rgb: ``(h, w, 3)`` uint8.
        depth_m: ``(h, w)`` float32 metres of the map, 0 where unknown.
        sigma_log: ``(h, w)`` float32 standard deviation of the natural log of the depth.
        is_measured: ``(h, w)`` where several views or a sensor measured it; elsewhere it is completed.
    """

    camera: Camera
    image_rgb: Bytes
    depth_m: Floats32
    sigma_log: Floats32
    is_measured: Bools


@dataclass(frozen=True)
class StoredDenseDepth:
    """Handle of dense depth in a temporary file.

    Attributes:
        camera: as for :class:`DenseDepth`; always in memory.
        measured_share: of the pixels, those that several views or a sensor measured.
        unit: factor on the depth.
    """

    camera: Camera
    measured_share: float
    _image: SpilledArray
    _depth: SpilledArray
    _sigma: SpilledArray
    unit: float = 1.0

    def load(self) -> DenseDepth:
        """The dense depth, read from the file each time."""
        signed = self._sigma.load()
        depth_m = self._depth.load() * np.float32(self.unit)
        return DenseDepth(self.camera, self._image.load(), depth_m, np.abs(signed), signed > 0)

    def rescaled(self, factor: float) -> StoredDenseDepth:
        """The same depth in a map whose lengths are multiplied by ``factor``."""
        return replace(self, unit=self.unit * factor)


def store_dense_depth(depth: DenseDepth, file: SpillFile) -> StoredDenseDepth:
    """Write dense depth to ``file``, depth and deviation to three digits, colours as a JPEG."""
    sigma = np.where(depth.is_measured, depth.sigma_log, -depth.sigma_log)
    return StoredDenseDepth(
        depth.camera,
        float(depth.is_measured.mean()),
        file.spill(encode_image(depth.image_rgb)),
        file.spill(encode_half_precision(depth.depth_m)),
        file.spill(encode_half_precision(sigma.astype(np.float32))),
    )
