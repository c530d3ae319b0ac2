# SPDX-License-Identifier: Apache-2.0
"""What frames see of a saved map, aligned in the images of its keyframes."""

from __future__ import annotations

import logging
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.patch_alignment import ImagePyramid, Templates, align_near, facing_warp
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.keypoint_alignment import ALIGNED_SHARE, FARTHEST, References
from slamdepth.types import Frame
from slamdepth.typing import Ints

logger = logging.getLogger(__name__)

_TEMPLATES = 30_000  # in memory at a time, 1 kB each


@dataclass(frozen=True)
class _View:
    """Patches of the landmarks ``ids (P,)``, ascending, in one keyframe."""

    ids: Ints
    templates: Templates


class FrameAligner:
    """Moves keypoints of placed frames to where the map's keyframes show their landmarks.

    A landmark that one keyframe sees is aligned to that one. Images that do not decode are left out.

    Attributes:
        damaged: numbers of the keyframes whose images were left out so far.

    Args:
        map_: whose keyframes took their images with the camera of the frames, and does not change.
        levels: of the features.
    """

    def __init__(self, map_: Map, levels: ScaleLevels) -> None:
        self._map = map_
        self._levels = levels
        self._references = References.of(map_, views=1)
        self._views: OrderedDict[int, _View] = OrderedDict()
        self.damaged: set[int] = set()

    def __call__(self, frame: Frame, raw: Features, placement: Placement) -> Features:
        """The features ``raw`` of a placed frame at aligned pixels, which are more certain."""
        at = np.flatnonzero(placement.landmark_ids >= 0)
        number = self._references.keyframe[placement.landmark_ids[at]]
        used = [k for k in np.unique(number[number >= 0]).tolist() if self._map.keyframes[k].frame.is_kept]
        if not used:
            return raw
        image = ImagePyramid(frame.image_rgb)
        raw_px, sigma_px = raw.raw_px.copy(), raw.sigma_px.copy()
        for k in used:
            view = self._view(k)
            if view is None:
                continue
            own = at[number == k]
            place = np.searchsorted(view.ids, placement.landmark_ids[own])
            own, place = own[view.templates.is_usable[place]], place[view.templates.is_usable[place]]
            if len(own) == 0:
                continue
            warp = facing_warp(
                placement.T_camera_world,
                self._map.keyframes[k].T_camera_world[None],
                np.zeros(len(own), np.int64),
                self._map.landmarks.position_w[view.ids[place]],
                np.array([frame.camera.fx, frame.camera.fy]),
            )
            farthest_px = FARTHEST * raw.sigma_px[own]
            px, good = align_near(image, view.templates.taken(place), warp, raw.raw_px[own], farthest_px)
            raw_px[own[good]] = px[good]
            sigma_px[own[good]] *= ALIGNED_SHARE
        self._forget()
        px = frame.camera.undistort_points(raw_px)
        return replace(raw, raw_px=raw_px, px=px, sigma_px=sigma_px)

    def _view(self, number: int) -> _View | None:
        """The patches of a keyframe, which are made when they are asked for first; None without its image."""
        view = self._views.get(number)
        if view is None:
            if number in self.damaged:
                return None
            keyframe = self._map.keyframes[number]
            try:
                image = ImagePyramid(keyframe.frame.load_as_spilled())
            except DatasetError as error:
                self.damaged.add(number)
                logger.warning("keypoints are not aligned in one image: %s", error)
                return None
            features: Features = keyframe.features
            ids = np.flatnonzero(self._references.keyframe == number)
            at = self._references.feature[ids]
            spacing_px = np.sqrt(self._levels.sigma_px(features.octave[at]))
            view = self._views[number] = _View(ids, Templates.of(image, features.raw_px[at], spacing_px))
        self._views.move_to_end(number)
        return view

    def _forget(self) -> None:
        """Forget the patches that were not asked for longest, where they are too many."""
        while len(self._views) > 1 and sum(len(view.ids) for view in self._views.values()) > _TEMPLATES:
            self._views.popitem(last=False)
