# SPDX-License-Identifier: Apache-2.0
"""ORB: the default feature, and the one that places are recognised by."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.compiled import loops
from slamdepth.frontend.compiled_orb import CompiledOrb
from slamdepth.frontend.features import Features, ScaleLevels, register_extractor
from slamdepth.frontend.keypoints import cell_edge_px, pixels, responses, spread
from slamdepth.frontend.metric import ORB
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


log = logging.getLogger(__name__)

_agreed: dict[tuple[float, int], bool] = {}


@register_extractor("orb")
class OrbExtractor:
    """ORB (Rublee et al. 2011), re-spread because OpenCV's own choice clusters.

    Clear corners first, which is faster; faint ones where an image has too few, as ORB-SLAM does.
    """

    candidates_per_keypoint = 4
    enough_per_keypoint = 1.5

    def __init__(self, config: FeatureConfig) -> None:
        import cv2

        self._count = config.count
        self.levels = ScaleLevels(config.scale_factor, config.levels)
        self._thresholds = sorted({config.fast_threshold, config.fast_threshold_low}, reverse=True)
        candidates = config.count * self.candidates_per_keypoint
        self._orbs = [
            cv2.ORB.create(
                nfeatures=candidates,
                scaleFactor=config.scale_factor,
                nlevels=config.levels,
                fastThreshold=threshold,
            )
            for threshold in self._thresholds
        ]
        fast = loops()
        self._compiled = None if fast is None else CompiledOrb(fast, config, candidates)
        if self._compiled is not None and not self._agrees(config.scale_factor, config.levels):
            self._compiled = None

    @property
    def is_compiled(self) -> bool:
        """Whether loops compiled here do what OpenCV's would."""
        return self._compiled is not None

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        """See :class:`slamdepth.frontend.features.FeatureExtractor`."""
        found_px, octave, descriptors = self.found(gray)
        raw_px = self._centred(found_px, octave, gray.shape)
        return Features(
            raw_px=raw_px,
            px=camera.undistort_points(raw_px),
            octave=octave,
            sigma_px=self.levels.sigma_px(octave),
            descriptors=descriptors,
        )

    def found(self, gray: NDArray[np.uint8]) -> tuple[Floats, Ints, NDArray[np.uint8]]:
        """Pixels ``(N, 2)``, levels ``(N,)`` and descriptors ``(N, 32)`` of the keypoints."""
        found = None
        if self._compiled is not None:
            found = self._compiled.extract(gray, self._thresholds, self.enough_per_keypoint * self._count)
        return found or self.found_by_opencv(gray)

    def found_by_opencv(self, gray: NDArray[np.uint8]) -> tuple[Floats, Ints, NDArray[np.uint8]]:
        """:meth:`found` by OpenCV alone."""
        for orb in self._orbs:
            keypoints = orb.detect(gray, None)
            if len(keypoints) >= self.enough_per_keypoint * self._count:
                break
        kept = spread(pixels(keypoints), responses(keypoints), self._count, cell_edge_px(gray, self._count))
        # ORB describes fast and detects many, so only those kept are described
        chosen, descriptors = orb.compute(gray, [keypoints[i] for i in kept])
        octave = np.array([k.octave for k in chosen], dtype=np.int64)
        return pixels(chosen), octave, np.ascontiguousarray(descriptors) if len(chosen) else ORB.empty()

    def _centred(self, px: Floats, octave: Ints, shape: tuple[int, ...]) -> Floats:
        """Where the keypoints ``(N, 2)`` really lie.

        OpenCV multiplies a pixel of a level by the level's nominal scale. Pixels of two levels have the same
        edge in common, not the same centre, and levels have whole numbers of pixels: its coarsest keypoints
        are up to two pixels off.
        """
        nominal = np.float32(self.levels.factor) ** np.arange(self.levels.count, dtype=np.float32)
        whole = np.array(shape[1::-1], dtype=np.float64)
        sizes = np.rint(whole * (np.float32(1.0) / nominal)[:, None])
        of_level = np.rint(px / nominal[octave][:, None])
        return np.asarray((of_level + 0.5) * (whole / sizes)[octave] - 0.5)

    def _agrees(self, scale_factor: float, levels: int) -> bool:
        """Whether OpenCV's ORB and the compiled one find the same in noise; asked once a process."""
        import cv2

        key = scale_factor, levels
        if key not in _agreed:
            noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
            image = np.asarray(cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
            fast, slow = self.found(image), self.found_by_opencv(image)
            _agreed[key] = all(np.array_equal(fast[n], slow[n]) for n in range(3))
            if not _agreed[key]:
                log.info("OpenCV's ORB differs from the compiled one here and is used in its place")
        return _agreed[key]
