# SPDX-License-Identifier: Apache-2.0
"""A camera placed in the map."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from slamdepth.typing import Floats, Ints


class PlacedBy(Enum):
    """What a frame was placed by."""

    MOTION = "the motion model"
    LAST_KEYFRAME = "the last keyframe"
    PLACE = "a keyframe that looks alike"
    REGISTRATION = "registration of its depth"


@dataclass(frozen=True)
class Placement:
    """A frame placed in the map.

    Attributes:
        T_camera_world: ``(4, 4)``.
        landmark_ids: ``(N,)`` landmark each feature agrees with, -1 for none.
        expected_ids: ``(M,)`` landmarks that should be seen from there.
        placed_by: how it was found.
        is_loose: in some corner of the image the pose errs by more than the search for landmarks allows for.
    """

    T_camera_world: Floats
    landmark_ids: Ints
    expected_ids: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    placed_by: PlacedBy = PlacedBy.MOTION
    is_loose: bool = False

    @property
    def inliers(self) -> int:
        """Number of landmarks that agree."""
        return int(np.count_nonzero(self.landmark_ids >= 0))

    @property
    def found_ids(self) -> Ints:
        """Landmarks that agree, ``(inliers,)``."""
        return self.landmark_ids[self.landmark_ids >= 0]
