# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity in the world, agreed on by the images of several keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamdepth.typing import Floats

_MIN_ESTIMATES = 6  # for a direction to be known
_MIN_GUESSES = 2  # for a direction to be tried first
_MIN_SHARE = 0.7  # of all confidence that must agree
_AGREEMENT = np.cos(np.radians(15.0))
_CHECK_EVERY = 5  # images: the direction is estimated again even where it is known


class GravityConsensus:
    """Collects estimates of gravity from single images; what most of them agree on is known.

    One image may mistake a wall for the floor. The camera's rotation from keyframe to keyframe is known to
    a degree, so several images share one direction, and it need not be estimated in the next.
    """

    def __init__(self) -> None:
        self._estimates_w: list[Floats] = []
        self._confidences: list[float] = []
        self._queries = 0

    def in_camera(self, R_world_camera: Floats, *, may_guess: bool = True) -> tuple[Floats | None, bool]:
        """Unit direction of gravity ``(3,)`` in a camera's frame, and whether the image should be asked too.

        Args:
            R_world_camera: ``(3, 3)``.
            may_guess: False asks each of the first six images by itself.

        Returns:
            No direction before two images agree, or six where there are no guesses. The image is asked before
            six do, and every fifth time.
        """
        self._queries += 1
        gravity_w = self._agreed(_MIN_GUESSES if may_guess else _MIN_ESTIMATES)
        if gravity_w is None:
            return None, True
        is_known = len(self._estimates_w) >= _MIN_ESTIMATES
        return np.asarray(R_world_camera.T @ gravity_w), not is_known or self._queries % _CHECK_EVERY == 0

    def add(self, R_world_camera: Floats, gravity: Floats, confidence: float) -> None:
        """Add the estimate of one image.

        Args:
            R_world_camera: ``(3, 3)``.
            gravity: ``(3,)`` unit direction in the camera's frame.
            confidence: 0 to 1.
        """
        self._estimates_w.append(R_world_camera @ gravity)
        self._confidences.append(confidence)

    def state(self) -> dict[str, Any]:
        """All estimates as plain values, for a saved map or a checkpoint."""
        return {
            "gravity_w": np.array(self._estimates_w, dtype=np.float64).reshape(-1, 3),
            "confidence": np.array(self._confidences, dtype=np.float64),
            "queries": self._queries,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Remember what :meth:`state` gave, and nothing else."""
        self._estimates_w = [np.array(estimate) for estimate in state["gravity_w"]]
        self._confidences = state["confidence"].tolist()
        self._queries = state["queries"]

    def turn(self, R_new_old: Floats) -> None:
        """Follow a world that was turned by ``(3, 3)``."""
        self._estimates_w = [R_new_old @ estimate for estimate in self._estimates_w]

    def absorb(self, other: GravityConsensus) -> None:
        """Take over the estimates of a map in the same world frame."""
        self._estimates_w += other._estimates_w
        self._confidences += other._confidences

    @property
    def disagrees(self) -> bool:
        """Whether enough images were asked, and there is no direction that most of them agree on."""
        return len(self._estimates_w) >= _MIN_ESTIMATES and self.in_world() is None

    def in_world(self) -> Floats | None:
        """The unit direction ``(3,)`` in the world that most agree on; None before enough do."""
        return self._agreed(_MIN_ESTIMATES)

    def _agreed(self, minimum: int) -> Floats | None:
        if len(self._estimates_w) < minimum:
            return None
        estimates, confidences = np.stack(self._estimates_w), np.array(self._confidences)
        alike = estimates @ estimates.T > _AGREEMENT
        votes = alike @ confidences
        best = int(votes.argmax())
        if votes[best] < _MIN_SHARE * confidences.sum():
            return None
        mean = confidences[alike[best]] @ estimates[alike[best]]
        return np.asarray(mean / np.linalg.norm(mean))
