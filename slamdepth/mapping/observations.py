# SPDX-License-Identifier: Apache-2.0
"""What some keyframes see of some landmarks, as flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.typing import Floats, Ints


@dataclass(frozen=True)
class Observations:
    """``M`` observations, by keyframe.

    Attributes:
        keyframe, landmark: ``(M,)`` places in the lists that were asked for.
        feature: ``(M,)`` of the keyframe.
        px: ``(M, 2)`` undistorted pixels; sigma_px: ``(M,)``.
        log_depth, sigma_log: ``(M,)`` depth priors, see :class:`~slamdepth.mapping.map_keyframe.MapKeyframe`.
    """

    keyframe: Ints
    landmark: Ints
    feature: Ints
    px: Floats
    sigma_px: Floats
    log_depth: Floats
    sigma_log: Floats

    def __len__(self) -> int:
        return len(self.keyframe)

    @staticmethod
    def of(keyframes: Sequence[MapKeyframe], landmark_ids: Ints, size: int) -> Observations:
        """All observations of the landmarks ``landmark_ids (P,)`` by ``keyframes``, of one map.

        Args:
            size: of the map, see :attr:`~slamdepth.mapping.map_view.MapView.size`.
        """
        index_of = np.full(size + 1, -1, dtype=np.int64)
        index_of[landmark_ids] = np.arange(len(landmark_ids))
        index_of[-1] = -1
        seen = [(k, np.flatnonzero(index_of[k.landmark_ids] >= 0)) for k in keyframes]
        return Observations(
            keyframe=np.concatenate([np.full(len(at), n) for n, (_, at) in enumerate(seen)]),
            landmark=np.concatenate([index_of[k.landmark_ids[at]] for k, at in seen]),
            feature=np.concatenate([at for _, at in seen]),
            px=np.concatenate([k.features.px[at] for k, at in seen]),
            sigma_px=np.concatenate([k.features.sigma_px[at] for k, at in seen]),
            log_depth=np.concatenate([k.log_depth[at] for k, at in seen]),
            sigma_log=np.concatenate([k.sigma_log[at] for k, at in seen]),
        )

    @staticmethod
    def joined(
        parts: Sequence[Observations], first_keyframe: Sequence[int], first_landmark: Sequence[int]
    ) -> Observations:
        """Several as one, whose lists of keyframes and landmarks follow one another.

        Args:
            first_keyframe, first_landmark: place of each one's first keyframe and landmark in the whole list.
        """
        return Observations(
            np.concatenate([one.keyframe + first for one, first in zip(parts, first_keyframe, strict=True)]),
            np.concatenate([one.landmark + first for one, first in zip(parts, first_landmark, strict=True)]),
            np.concatenate([one.feature for one in parts]),
            np.concatenate([one.px for one in parts]),
            np.concatenate([one.sigma_px for one in parts]),
            np.concatenate([one.log_depth for one in parts]),
            np.concatenate([one.sigma_log for one in parts]),
        )
