# SPDX-License-Identifier: Apache-2.0
"""How much of what a moving camera sees moves by itself."""

from __future__ import annotations

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.frontend.moving import moving_share
from slamdepth.geometry import invert
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_view import MapView, median_depth_m
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.map_arrays import features_of, features_state, metric_of, metric_state
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_EVERY_S = 0.15  # what moves slowly has moved by some pixels, and most frames cost nothing
_MAX_GAP_S = 0.4  # frames farther apart have little in common


class MovingThings:
    """Compares placed frames that are 0.15 s apart, see :func:`moving_share`.

    What moves becomes no landmark that lasts, so it does not show among the matches with the map: features
    that agree with no landmark are matched with those of the image before.

    Args:
        camera: that took the frames.
    """

    def __init__(self, camera: Camera, map_: MapView) -> None:
        self._camera = camera.without_distortion()
        self._map = map_
        self._last: tuple[float, Features, Floats, Ints] | None = None
        self._share: float | None = None

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        if self._last is None:
            return {"last": None, "share": self._share}
        timestamp_s, features, T_camera_world, ids = self._last
        last = {
            "timestamp_s": timestamp_s,
            "features": features_state(features),
            "metric": metric_state(features.metric),
            "T_camera_world": T_camera_world,
            "landmark_ids": ids,
        }
        return {"last": last, "share": self._share}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self._share, last = state["share"], state["last"]
        self._last = None
        if last is not None:
            features = features_of(last["features"], metric_of(last["metric"]))
            pose, ids = np.array(last["T_camera_world"]), np.array(last["landmark_ids"])
            self._last = last["timestamp_s"], features, pose, ids

    def forget(self) -> None:
        """The last pose is in another world frame now."""
        self._last = self._share = None

    def renumber(self, ids_now: Ints) -> None:
        """Follow new landmark ids, see :meth:`Map.compact`."""
        if self._last is not None:
            timestamp_s, features, T_camera_world, ids = self._last
            self._last = timestamp_s, features, T_camera_world, ids_now[ids]

    def __call__(
        self, timestamp_s: float, features: Features, placement: Placement, *, is_judged: bool = True
    ) -> float | None:
        """Take the next placed frame.

        Args:
            features: of the frame; ``placement`` says which landmark each sees.
            is_judged: False where frames are too far apart for features to be found nearby.

        Returns:
            The share of moving features when it was measured last; None where it was not.
        """
        before = self._last
        if before is not None and is_judged and timestamp_s - before[0] < _EVERY_S:
            return self._share
        self._last = timestamp_s, features, placement.T_camera_world, placement.landmark_ids
        self._share = None
        if before is not None and is_judged and timestamp_s - before[0] <= _MAX_GAP_S:
            self._share = self._measured(*before[1:], features, placement)
        return self._share

    def _measured(
        self, before: Features, T_before: Floats, ids_before: Ints, now: Features, placement: Placement
    ) -> float | None:
        found, T_now = placement.found_ids, placement.T_camera_world
        if len(found) == 0:
            return None
        ids_before = self._map.resolve(ids_before)
        is_seen_again = self._map.mask(placement.landmark_ids)
        static = np.flatnonzero(self._map.mask(ids_before)[placement.landmark_ids])
        return moving_share(
            self._camera,
            before,
            now,
            np.flatnonzero(~is_seen_again[ids_before]),
            np.flatnonzero(placement.landmark_ids < 0),
            now.px[static],
            T_now @ invert(T_before),
            median_depth_m(T_now, self._map.landmarks.position_w[found]),
        )
