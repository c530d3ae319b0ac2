# SPDX-License-Identifier: Apache-2.0
"""A loop on trial: does the map still reproject once the loop is closed?

What drift explains can still be wrong. Closing a true loop moves keyframes in ways that their observations do
not determine: after an adjustment landmarks are where they were seen, on both sides of the loop. A false one
bends the map against its own observations: either those of the loop are lost again, or others are. So the
correction is tried on a copy of a part of the map, and the map is changed only where it holds. Whether more
observations are lost than are won is a sign test (McNemar, "Note on the sampling error of the difference
between correlated proportions or percentages", 1947), over the part and in each of its keyframes.

What no observation contradicts passes: along a wall, predicted depth leaves a drift of scale undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.config import BundleConfig
from slamdepth.geometry import CHI2_2DOF_95, invert
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.observations import Observations
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Ints

_TRACKS = 25  # landmarks of each keyframe, and of each sighting, those that most keyframes see
_STEPS = (2,)  # of the adjustment; one brings nearly all back that a true loop has moved
_KEYFRAMES = 80  # of a part; more are thinned out
_MEETING = 20  # keyframes of each of two maps
_AROUND = 3  # keyframes before and after the place that is seen again
_LEAST_SIGHTED = 0.5
_SURPRISE = 4.0  # deviations: by chance in one keyframe of 30,000


@dataclass(frozen=True)
class Part:
    """A part of a map that takes part in a trial, where the map has it or where a correction would move it.

    Attributes:
        map: the map.
        keyframe_ids: ``K`` keyframes of the part.
        T_world_camera: ``(K, 4, 4)`` their poses on trial.
        position_w: ``(size, 3)`` landmarks of the map on trial.
        log_scale: ``(K,)`` natural logarithm of what their depths are multiplied by.
    """

    map: MapView
    keyframe_ids: Sequence[int]
    T_world_camera: Floats
    position_w: Floats
    log_scale: Floats

    @staticmethod
    def of(map_: MapView, keyframe_ids: Sequence[int]) -> Part:
        """The part as the map has it."""
        at, position_w = list(keyframe_ids), map_.landmarks.position_w
        return Part(map_, at, map_.T_world_camera[at], position_w, np.zeros(len(at)))

    def corrected(self, T_world_camera: Floats, scales: Floats) -> Part:
        """The part after a correction of all keyframes, for which see :meth:`Map.correct_similarities`."""
        at, landmarks = list(self.keyframe_ids), self.map.landmarks
        anchor = landmarks.anchor_keyframe
        T_camera_old, T_new = invert(self.map.T_world_camera)[anchor], T_world_camera[anchor]
        position_c = np.einsum("nij,nj->ni", T_camera_old[:, :3, :3], landmarks.position_w)
        position_c = (position_c + T_camera_old[:, :3, 3]) * scales[anchor][:, None]
        position_w = np.einsum("nij,nj->ni", T_new[:, :3, :3], position_c) + T_new[:, :3, 3]
        return Part(self.map, at, T_world_camera[at], position_w, np.log(scales[at]))


@dataclass(frozen=True)
class Sighting:
    """A keyframe that is said to see landmarks of another place.

    Attributes:
        keyframe: the keyframe.
        landmark_ids: ``(N,)`` landmark that each of its features sees, -1 for none.
    """

    keyframe: MapKeyframe
    landmark_ids: Ints


class Trial:
    """Observations of one map, or of two that are to be joined, and those that a loop adds.

    Args:
        camera: its distortion is ignored.
        parts: as the maps have them; two where two maps are to be joined.
        sightings: keyframes of the last part that see landmarks of the first one.
    """

    def __init__(
        self, camera: Camera, config: BundleConfig, parts: Sequence[Part], sightings: Sequence[Sighting]
    ) -> None:
        self._camera = camera.without_distortion()
        self._config = config
        self._parts = parts
        self._ids = [tracks_of(part.map, part.keyframe_ids) for part in parts]
        places = [_best(parts[0], sighting.landmark_ids) for sighting in sightings]
        self._ids[0] = np.unique(np.concatenate([self._ids[0], *places]))
        own = [
            Observations.of([part.map.keyframes[k] for k in part.keyframe_ids], ids, part.map.size)
            for part, ids in zip(parts, self._ids, strict=True)
        ]
        added = [self._sighted(sighting) for sighting in sightings]
        self._count = sum(len(seen) for seen in own)
        first_keyframe, first_landmark = [0], [0]
        for part, ids in zip(parts[:-1], self._ids, strict=False):
            first_keyframe.append(first_keyframe[-1] + len(part.keyframe_ids))
            first_landmark.append(first_landmark[-1] + len(ids))
        self._seen = Observations.joined(
            [*own, *added],
            [*first_keyframe, *(first_keyframe[-1] for _ in added)],
            [*first_landmark, *(0 for _ in added)],
        )

    def worsened(self, corrected: Sequence[Part]) -> str:
        """How the maps would reproject worse after a correction, once adjusted; empty where they would not.

        Args:
            corrected: the parts, where the correction would move them, in one world frame.
        """
        before, after = self._agrees(self._parts, (0,)), self._agrees(corrected, _STEPS)
        sighted = after[self._count :]
        if len(sighted) == 0:
            return ""
        if np.mean(sighted) < _LEAST_SIGHTED:
            return f"{np.sum(~sighted)} of its {len(sighted)} observations contradict those of the map"
        before, after = before[: self._count], after[: self._count]
        keyframe = self._seen.keyframe[: self._count]
        lost, won = before & ~after, after & ~before
        keyframes = int(keyframe.max(initial=0)) + 1
        minus, plus = (
            np.r_[np.sum(which), np.bincount(keyframe[which], minlength=keyframes)] for which in (lost, won)
        )
        surprise = (minus - plus) / np.sqrt(np.maximum(minus + plus, 1))
        if np.all(surprise <= _SURPRISE):
            return ""
        return f"{np.sum(lost)} of {np.sum(before)} observations of the map would be lost"

    def _agrees(self, parts: Sequence[Part], steps: tuple[int, ...]) -> Bools:
        """Which observations agree after an adjustment, ``(M,)``; those of the sightings are the last."""
        seen, is_measured = self._seen, all(part.map.is_measured for part in parts)
        T_world_camera = np.concatenate([part.T_world_camera for part in parts])
        log_scale = np.concatenate([part.log_scale for part in parts])
        problem = BundleProblem(
            camera=self._camera,
            T_camera_world=invert(T_world_camera),
            fixed=np.arange(len(T_world_camera)) == 0,
            points_w=np.concatenate(
                [part.position_w[ids] for part, ids in zip(parts, self._ids, strict=True)]
            ),
            obs_camera=seen.keyframe,
            obs_point=seen.landmark,
            px=seen.px,
            sigma_px=seen.sigma_px,
            log_depth=seen.log_depth + log_scale[seen.keyframe],
            sigma_log=seen.sigma_log * (1.0 if is_measured else self._config.prior_inflation),
            sigma_scale=0.0 if is_measured else self._config.scale_sigma,
        )
        return bundle_adjust(problem, steps).chi2 < CHI2_2DOF_95

    def _sighted(self, sighting: Sighting) -> Observations:
        """What a keyframe is said to see; where it is a feature's second landmark, its depth counts once."""
        place, here = self._parts[0], self._parts[-1]
        ids = sighting.landmark_ids
        if here.map is place.map:  # a landmark may be seen already
            ids = np.where(place.map.mask(sighting.keyframe.landmark_ids)[ids], -1, ids)
        index_of = np.full(place.map.size + 1, -1, dtype=np.int64)
        index_of[self._ids[0]] = np.arange(len(self._ids[0]))
        index_of[-1] = -1
        at = np.flatnonzero(index_of[ids] >= 0)
        features, number = sighting.keyframe.features, list(here.keyframe_ids).index(sighting.keyframe.id)
        return Observations(
            keyframe=np.full(len(at), number),
            landmark=index_of[ids[at]],
            feature=at,
            px=features.px[at],
            sigma_px=features.sigma_px[at],
            log_depth=np.full(len(at), np.nan),
            sigma_log=np.ones(len(at)),
        )


def part_between(map_: MapView, i: int, j: int) -> Part:
    """Keyframes from around ``i`` up to ``j``, thinned out where they are many."""
    first = max(0, i - _AROUND)
    thinned = np.linspace(first, j, min(_KEYFRAMES, j - first + 1)).round().astype(np.int64)
    ids = np.unique(np.r_[thinned, np.arange(first, min(i + _AROUND, j) + 1)])
    return Part.of(map_, ids.tolist())


def parts_that_meet(here: MapView, there: MapView, sightings: Sequence[Sighting]) -> tuple[Part, Part]:
    """Keyframes of ``there`` that see what is sighted, and of ``here`` around the keyframes that sight it."""
    sighted = np.concatenate([sighting.landmark_ids for sighting in sightings])
    own = np.concatenate([sighting.keyframe.landmark_ids for sighting in sightings])
    ids = {sighting.keyframe.id for sighting in sightings}.union(here.covisible(own, _MEETING))
    return Part.of(there, sorted(there.covisible(sighted, _MEETING))), Part.of(here, sorted(ids))


def tracks_of(map_: MapView, keyframe_ids: Sequence[int]) -> Ints:
    """Of each keyframe the landmarks that most of the others see, ascending."""
    count = _times_seen(map_, keyframe_ids)
    chosen = np.zeros(map_.size + 1, dtype=bool)
    for k in keyframe_ids:
        ids = map_.keyframes[k].landmark_ids
        seen = np.sort(ids[count[ids] >= 2])
        chosen[seen[np.argsort(-count[seen], kind="stable")[:_TRACKS]]] = True
    return np.flatnonzero(chosen[:-1])


def _best(part: Part, landmark_ids: Ints) -> Ints:
    """Of the landmarks that are said to be seen those that most keyframes of the part see."""
    count = _times_seen(part.map, part.keyframe_ids)
    ids = np.unique(landmark_ids[count[landmark_ids] > 0])
    return ids[np.argsort(-count[ids], kind="stable")[:_TRACKS]]


def _times_seen(map_: MapView, keyframe_ids: Sequence[int]) -> Ints:
    """How many of the keyframes see each landmark, ``(size + 1,)``; 0 in the last entry, for -1."""
    count = np.zeros(map_.size + 1, dtype=np.int64)
    for k in keyframe_ids:
        count[map_.keyframes[k].landmark_ids] += 1
    count[-1] = 0
    return count
