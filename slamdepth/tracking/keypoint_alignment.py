# SPDX-License-Identifier: Apache-2.0
"""Keypoints of a finished map, aligned in the images to one view of each landmark.

A detector found a landmark's observations in each image on its own. Here the patch about one of them, of the
view nearest to the middle of all, is found again in the others to a fraction of a pixel. Keypoint adjustment
is that of Lindenberger et al., "Pixel-Perfect Structure-from-Motion" (ICCV 2021), by grey values here.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.patch_alignment import (
    ImagePyramid,
    Templates,
    align_near,
    central_views,
    facing_warp,
)
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import in_parallel
from slamdepth.typing import Bools, Floats, Ints

log = logging.getLogger(__name__)

ALIGNED_SHARE = 0.25
"""An aligned keypoint's deviation over a detected one's."""
FARTHEST = 2.5
"""Deviations of a detected keypoint, within which it is aligned."""
_TEMPLATES = 30_000  # in memory at a time, 1 kB each


def align_keypoints(map_: Map, shutter: RollingShutter, levels: ScaleLevels) -> int:
    """Move the keypoints of all landmarks that several keyframes see; each becomes more certain.

    Args:
        levels: of the detector.

    Returns:
        How many observations were aligned.
    """
    references = References.of(map_)
    keypoints = [_Keypoints.of(keyframe) for keyframe in map_.keyframes]
    count = 0
    for landmark_ids in references.batches():
        batch = _Batch.of(map_, references, landmark_ids)
        with in_parallel(batch.aligned, keypoints) as aligning:
            keypoints = [aligned.result() for aligned in aligning]
    for found in keypoints:
        keyframe, features = found.keyframe, found.features
        sigma_px = levels.sigma_px(features.octave) * np.where(found.is_aligned, ALIGNED_SHARE, 1.0)
        px = keyframe.frame.camera.undistort_points(found.raw_px)
        map_.set_features(keyframe, replace(features, raw_px=found.raw_px, px=px, sigma_px=sigma_px))
        count += int(np.count_nonzero(found.is_aligned))
    shutter.correct_keyframes()
    log.info("%d of %d observations aligned in the images", count, references.observations)
    return count


@dataclass(frozen=True)
class References:
    """The view of each landmark that the others are aligned to.

    Attributes:
        keyframe, feature: ``(P,)`` of the view, -1 where too few keyframes see the landmark.
        observations: number of all views of these landmarks.
    """

    keyframe: Ints
    feature: Ints
    observations: int

    @classmethod
    def of(cls, map_: Map, views: int = 2) -> References:
        """The view of each landmark nearest to the mean direction it is seen from.

        Args:
            views: keyframes that see it, at least.
        """
        keyframes, often = map_.keyframes, map_.seen_by(views)
        seen = [_seen(keyframe) for keyframe in keyframes]
        feature, ids = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        number = np.repeat(np.arange(len(keyframes)), [len(at) for at, _ in seen])
        center_w = np.array([keyframe.center_w for keyframe in keyframes])
        central = central_views(center_w[number] - map_.landmarks.position_w[ids], ids, map_.size)[often]
        chosen, chosen_feature = np.full(map_.size, -1), np.full(map_.size, -1)
        chosen[often], chosen_feature[often] = number[central], feature[central]
        return cls(chosen, chosen_feature, int(map_.landmarks.observations[often].sum()))

    def batches(self) -> Iterator[Ints]:
        """Landmarks whose views are in one another's company, by keyframe, some at a time."""
        ids = np.flatnonzero(self.keyframe >= 0)
        ids = ids[np.argsort(self.keyframe[ids], kind="stable")]
        for start in range(0, len(ids), _TEMPLATES):
            yield ids[start : start + _TEMPLATES]


@dataclass(frozen=True)
class _Keypoints:
    """Of a keyframe: pixels ``(N, 2)`` as they are now, and which of them are aligned ``(N,)``."""

    keyframe: MapKeyframe
    raw_px: Floats
    is_aligned: Bools

    @classmethod
    def of(cls, keyframe: MapKeyframe) -> _Keypoints:
        raw_px: Floats = keyframe.features.raw_px
        return cls(keyframe, raw_px, np.zeros(len(raw_px), dtype=np.bool_))

    @property
    def features(self) -> Features:
        features: Features = self.keyframe.features
        return features

    def moved(self, at: Ints, px: Floats) -> _Keypoints:
        """With the features ``at`` aligned to ``px (M, 2)``."""
        raw_px, is_aligned = self.raw_px.copy(), self.is_aligned.copy()
        raw_px[at], is_aligned[at] = px, True
        return _Keypoints(self.keyframe, raw_px, is_aligned)


@dataclass(frozen=True)
class _Batch:
    """Some landmarks, and the patch about each in the view that the others are aligned to.

    Attributes:
        T_camera_world: ``(K, 4, 4)`` of the keyframes.
        place: ``(P,)`` of each landmark of the map in ``templates``, -1 for none.
    """

    map_: Map
    references: References
    T_camera_world: Floats
    place: Ints
    templates: Templates

    @classmethod
    def of(cls, map_: Map, references: References, landmark_ids: Ints) -> _Batch:
        """The landmarks ``landmark_ids``, which are ordered by the keyframe of their view."""
        place = np.full(map_.size, -1)
        place[landmark_ids] = np.arange(len(landmark_ids))
        of_keyframe = references.keyframe[landmark_ids]

        def templates(number: int) -> Templates:
            keyframe = map_.keyframes[number]
            features: Features = keyframe.features
            at = references.feature[landmark_ids[of_keyframe == number]]
            # finer than the level of the detector, which is where its error comes from
            spacing_px = np.sqrt(features.sigma_px[at])
            image = ImagePyramid(keyframe.frame.load_as_spilled())
            return Templates.of(image, features.raw_px[at], spacing_px)

        with in_parallel(templates, np.unique(of_keyframe).tolist()) as making:
            parts = [made.result() for made in making]
        T_camera_world = np.array([keyframe.T_camera_world for keyframe in map_.keyframes])
        return cls(map_, references, T_camera_world, place, Templates.joined(parts))

    def aligned(self, keypoints: _Keypoints) -> _Keypoints:
        """Align what a keyframe sees of these landmarks."""
        keyframe = keypoints.keyframe
        at, ids = _seen(keyframe)
        known = (self.place[ids] >= 0) & self.templates.is_usable[self.place[ids]]
        is_other = self.references.keyframe[ids] != keyframe.id
        own = at[known & ~is_other]
        keypoints = keypoints.moved(own, keypoints.raw_px[own])
        at, ids = at[known & is_other], ids[known & is_other]
        if len(at) == 0:
            return keypoints
        image = ImagePyramid(keyframe.frame.load_as_spilled())
        camera = keyframe.frame.camera
        warp = facing_warp(
            keyframe.T_camera_world,
            self.T_camera_world,
            self.references.keyframe[ids],
            self.map_.landmarks.position_w[ids],
            np.array([camera.fx, camera.fy]),
        )
        farthest_px = FARTHEST * keypoints.features.sigma_px[at]
        templates = self.templates.taken(self.place[ids])
        px, good = align_near(image, templates, warp, keypoints.raw_px[at], farthest_px)
        return keypoints.moved(at[good], px[good])


def _seen(keyframe: MapKeyframe) -> tuple[Ints, Ints]:
    """Features with a landmark, and their landmarks."""
    at = np.flatnonzero(keyframe.landmark_ids >= 0)
    return at, keyframe.landmark_ids[at]
