# SPDX-License-Identifier: Apache-2.0
"""What a run looks like: the content of the 3D view of a page, of the viewer and of the video."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.types import Trajectory
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from slamdepth.mapping.mesh import Mesh
    from slamdepth.types import Camera


@dataclass(frozen=True)
class Thumbnail:
    """A keyframe's image and depth, small.

    Attributes:
        row: of its keyframe in the map.
        image, depth: JPEG files; the depth in the colours of :func:`~slamdepth.report.keyframe_images.
            colour_depth` between ``Scene.near_m`` and ``Scene.far_m``.
    """

    row: int
    image: bytes
    depth: bytes


@dataclass(frozen=True)
class SceneMap:
    """One map of a run, in its own world frame and its own metres.

    Attributes:
        number: 1 for the largest.
        path: every placed frame.
        keyframe_ids: ``(K,)``.
        keyframes: their poses.
        loops: ``(L, 2)`` rows of the two keyframes of each loop.
        points_m: ``(P, 3)`` some of the map points.
        truth: the ground truth, aligned by SE(3); None where there is none.
        gravity_w: ``(3,)`` unit direction of gravity in the world; None where it is not known.
        thumbnails: of some keyframes, evenly spread, in order.
        mesh: None where there is none.
    """

    number: int
    path: Trajectory
    keyframe_ids: Ints
    keyframes: Trajectory
    loops: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    points_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    truth: Trajectory | None = None
    gravity_w: Floats | None = None
    thumbnails: tuple[Thumbnail, ...] = ()
    mesh: Mesh | None = None


@dataclass(frozen=True)
class Scene:
    """A run.

    Attributes:
        maps: the largest first.
        camera: that took the images; None where it is not known.
        near_m, far_m: depth that is drawn as near and as far as it gets, in each map's own metres.
    """

    maps: tuple[SceneMap, ...]
    camera: Camera | None = None
    near_m: float = 0.0
    far_m: float = 1.0

    @property
    def start_s(self) -> float:
        """Time of the first frame of any map; 0 without frames."""
        return min((float(one.path.timestamps_s[0]) for one in self.maps if len(one.path)), default=0.0)

    @property
    def aspect(self) -> tuple[float, float]:
        """Half the width and half the height of an image at a distance of 1; those of 60 degrees where the
        camera is not known."""
        if self.camera is None:
            return 0.577, 0.433
        return self.camera.width / self.camera.fx / 2, self.camera.height / self.camera.fy / 2
