# SPDX-License-Identifier: Apache-2.0
"""Whether a placed frame's pose can be believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from slamdepth.frontend.features import Features
from slamdepth.frontend.pose import cells_of, pose_covariance
from slamdepth.geometry import CHI2_2DOF_95
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_view import MapView, median_depth_m
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.localiser import FARTHEST_PX, POSE_PX, Localiser
from slamdepth.tracking.moving_things import MovingThings
from slamdepth.tracking.pose_uncertainty import PoseUncertainty, motion_between
from slamdepth.types import Camera
from slamdepth.typing import Floats

_FEW, _FEW_CELLS = 60, 6  # with more landmarks in more cells, chance and bad geometry are out of the question
_CHANCE_LOG = math.log(1e-9)
_EVERY = 4  # landmarks that the scene's distance is taken from
_FASTEST_RAD_S2 = 100.0
_SIGMAS = 3.0
_CONFIRMED_BY, _CONFIRM_S = 3, 1.0


class Verdict(Enum):
    """What a pose is worth."""

    EARNED = "earned"
    PROVISIONAL = "provisional"
    LOST = "lost"


@dataclass(frozen=True)
class Judgement:
    """What :meth:`PoseCheck.judge` found.

    Attributes:
        verdict: EARNED; PROVISIONAL: the frames after it confirm the pose or it is withdrawn, and until then
            no frame becomes a keyframe; LOST: the frame has no pose.
        why: why it is not earned.
        withdrawn_s: times of earlier frames whose provisional poses this one contradicts.
    """

    verdict: Verdict
    why: str = ""
    withdrawn_s: tuple[float, ...] = ()


class PoseCheck:
    """Judges each pose before it is believed; keeps the poses that wait to be confirmed.

    A pose is LOST where

    * chance would give as many agreeing landmarks. Its rate is measured in this very image: the expected
      landmarks are sought where they are not, at the opposite side of the image, with the same windows,
      descriptors and gate. The tail of the Poisson distribution must be below 1e-9, since a solver picks the
      best of many poses (a contrario; Moisan and Stival 2004);
    * its matches do not determine it, as of points on one line. A large covariance is no reason: a white room
      with a bad depth is tracked well with deviations of over 20 % of the scene's distance.

    It is PROVISIONAL where

    * predicted depth alone was registered: on a bare wall that shape is made up;
    * few landmarks agree and no motion leads there, as after a loss;
    * it is farther from the predicted pose than a camera can accelerate: an image motion of 100 rad/s^2 and
      three deviations of the last pose, which at 5 frames a second allows everything.

    Three frames that follow, or a second of them, confirm it; the next loss or contradiction withdraws it.

    Attributes:
        uncertainty: gives each pose its covariance and quality.
        moving: says how much of a frame moves by itself.
    """

    def __init__(self, camera: Camera, map_: MapView, localiser: Localiser) -> None:
        self._camera = camera.without_distortion()
        self._map = map_
        self._localiser = localiser
        self.uncertainty = PoseUncertainty(camera, map_)
        self.moving = MovingThings(camera, map_)
        self._last_s = -math.inf
        self._provisional_s: list[float] = []

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {
            "last_s": self._last_s,
            "provisional_s": list(self._provisional_s),
            "uncertainty": self.uncertainty.state(),
            "moving": self.moving.state(),
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self._last_s, self._provisional_s = state["last_s"], list(state["provisional_s"])
        self.uncertainty.restore(state["uncertainty"])
        self.moving.restore(state["moving"])

    @property
    def is_provisional(self) -> bool:
        """Whether the last pose waits to be confirmed."""
        return bool(self._provisional_s)

    def judge(
        self, timestamp_s: float, features: Features, placement: Placement, T_guess: Floats | None
    ) -> Judgement:
        """What the pose of the next frame is worth.

        Args:
            features: of the frame.
            placement: with :attr:`Placement.expected_ids`, as the localiser found it.
            T_guess: ``(4, 4)`` T_camera_world by the motion model; None where no motion is known.
        """
        if why := self._unearned(features, placement):
            return Judgement(Verdict.LOST, why, self.lose())
        duration_s, self._last_s = timestamp_s - self._last_s, timestamp_s
        if why := self._suspicion(duration_s, features, placement, T_guess):
            withdrawn = self.lose()
            self._provisional_s = [timestamp_s]
            return Judgement(Verdict.PROVISIONAL, why, withdrawn)
        if not self._provisional_s:
            return Judgement(Verdict.EARNED)
        since_s = timestamp_s - self._provisional_s[0]
        if len(self._provisional_s) >= _CONFIRMED_BY or since_s >= _CONFIRM_S:
            self._provisional_s = []
            return Judgement(Verdict.EARNED)
        self._provisional_s.append(timestamp_s)
        return Judgement(Verdict.PROVISIONAL, "not confirmed yet")

    def lose(self) -> tuple[float, ...]:
        """The camera is lost, or elsewhere: the times of frames whose provisional poses are withdrawn."""
        withdrawn, self._provisional_s = tuple(self._provisional_s), []
        return withdrawn

    def forget_motion(self) -> None:
        """The map has moved as a whole, or grown by another one: what waits counts as confirmed."""
        self._provisional_s = []
        self.uncertainty.forget_motion()
        self.moving.forget()

    def _suspicion(
        self, duration_s: float, features: Features, placement: Placement, T_guess: Floats | None
    ) -> str:
        """Why the pose has to be confirmed; empty where it has not."""
        if placement.placed_by is PlacedBy.REGISTRATION and not self._map.is_measured:
            return "placed by the shape of predicted depth alone"
        if T_guess is None:
            return "" if self._has_many(features, placement) else "few matches where no motion leads"
        T = placement.T_camera_world
        turn, length = motion_between(T_guess, T)
        off = turn + length / self._distance(placement)
        if off > _FASTEST_RAD_S2 * duration_s**2 + _SIGMAS * self.uncertainty.image_sigma:
            return "farther from the predicted pose than a camera can accelerate"
        return ""

    def _distance(self, placement: Placement) -> float:
        """Median depth of the landmarks that agree, metres."""
        ids = placement.found_ids[::_EVERY]
        if len(ids) == 0:
            return math.inf
        return median_depth_m(placement.T_camera_world, self._map.landmarks.position_w[ids])

    def _unearned(self, features: Features, placement: Placement) -> str:
        """Why the matches do not support the pose; empty where they do."""
        if placement.placed_by is PlacedBy.REGISTRATION:
            return ""  # placed by its depth, which has a check of its own
        at = np.flatnonzero(placement.landmark_ids >= 0)
        if self._has_many(features, placement):
            return ""
        if self._is_chance(features, placement):
            return "chance would give as many matches"
        ids, landmarks = placement.landmark_ids[at], self._map.landmarks
        covariance = pose_covariance(
            self._camera,
            placement.T_camera_world,
            landmarks.position_w[ids],
            landmarks.covariance_w[ids],
            features.px[at],
            features.sigma_px[at],
        )
        return "the matches do not determine the pose" if covariance is None else ""

    def _has_many(self, features: Features, placement: Placement) -> bool:
        """Whether so many landmarks agree, in so many of 8 x 8 cells, that chance is out of the question."""
        px = features.px[placement.landmark_ids >= 0]
        if len(px) < _FEW:
            return False
        return int(np.count_nonzero(np.bincount(cells_of(self._camera, px.T)))) >= _FEW_CELLS

    def _is_chance(self, features: Features, placement: Placement) -> bool:
        """Whether landmarks that are sought where they are not agree with about as many features."""
        if len(placement.expected_ids) == 0:
            return False
        visible = self._localiser.expected(placement.T_camera_world, placement.expected_ids)
        size = np.array([self._camera.width - 1, self._camera.height - 1])
        elsewhere = replace(visible, px=size - visible.px)
        found, at, _ = self._localiser.search(elsewhere, features, POSE_PX, FARTHEST_PX)
        order = np.argsort(visible.ids)
        of = order[np.searchsorted(visible.ids, found, sorter=order)]
        S = visible.covariance_px[of] + (features.sigma_px[at] ** 2)[:, None, None] * np.eye(2)
        off = features.px[at] - elsewhere.px[of]
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(S, off[:, :, None])[:, :, 0])
        by_chance = np.count_nonzero(squared < CHI2_2DOF_95)
        return chance_log(placement.inliers, by_chance + 1.0) > _CHANCE_LOG


def chance_log(matches: int, expected: float) -> float:
    """Bound on the logarithm of the probability that a Poisson variable with mean ``expected`` reaches
    ``matches`` (Chernoff); 0 where that is no surprise."""
    if matches <= expected:
        return 0.0
    if expected <= 0.0:
        return -math.inf
    return matches - expected + matches * math.log(expected / matches)
