# SPDX-License-Identifier: Apache-2.0
"""Dense depth of all keyframes of a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from slamdepth.dense.agreement import agreement
from slamdepth.dense.frames import FrameViews, SourceFrame
from slamdepth.dense.fuse import fuse
from slamdepth.dense.measure import measure
from slamdepth.dense.rectify import Rectifier
from slamdepth.dense.sheet import first_sheet
from slamdepth.dense.sweep import View
from slamdepth.dense.views import are_seen, choose_views, surface_points
from slamdepth.mapping.codec import encode_half_precision
from slamdepth.mapping.dense_depth import DenseDepth, StoredDenseDepth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.spill_file import SpilledArray, SpillFile
from slamdepth.thread_limits import single_threaded
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats, Floats32

_S = TypeVar("_S")
_T = TypeVar("_T")

_BATCH = 48  # keyframes whose views are in memory at a time
_NEIGHBOURS = 8
_LEAST_OVERLAP = 0.25


@dataclass(frozen=True)
class Effort:
    """How much is computed for a keyframe.

    Attributes:
        width: of the working images in pixels, along the longer side.
        views: most views of a keyframe.
        rounds: for each, how far about the present depth is searched (log ratio), and in how many steps.
    """

    width: int
    views: int
    rounds: tuple[tuple[float, int], ...]


EFFORTS = {
    "fast": Effort(320, 6, ((0.42, 33),)),
    "best": Effort(320, 8, ((0.42, 49), (0.2, 41))),
}


def densify(
    reconstruction: Reconstruction,
    frames: Sequence[SourceFrame],
    read: Callable[[int], Bytes],
    effort: Effort,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Measure the surface of each keyframe from the frames about it.

    Args:
        reconstruction: a finished map, with keyframes' depth by a network or a sensor.
        frames: all placed frames, in order of time; those of the keyframes are among them.
        read: gives the ``(H, W, 3)`` uint8 image of a frame that is no keyframe; an ``ImageDecodeError``
            leaves it out.
        effort: see :data:`EFFORTS`.
        progress: called with (steps done, steps in all).

    Returns:
        The same map; each keyframe with depth has ``dense`` depth. The same input gives the same bytes.
    """
    if len(reconstruction.keyframes) < 2:
        return reconstruction
    job = _Job(reconstruction, frames, read, effort, progress or (lambda done, total: None))
    with single_threaded(), ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        depths = job.run(pool)
    return replace(
        reconstruction,
        keyframes=tuple(replace(kf, dense=depths.get(kf.id)) for kf in reconstruction.keyframes),
    )


@dataclass
class _State:
    """A keyframe while it is worked on; its maps, ``(h, w)`` at the working size, are in a file."""

    keyframe: Keyframe
    points_w: Floats
    maps: dict[str, SpilledArray] = field(default_factory=dict)


class _Job:
    """All keyframes of a map."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        frames: Sequence[SourceFrame],
        read: Callable[[int], Bytes],
        effort: Effort,
        progress: Callable[[int, int], None],
    ) -> None:
        keyframes = reconstruction.keyframes
        self._rectifier = Rectifier.of(
            keyframes[0].frame.camera, effort.width, reconstruction.statistics.readout_s or 0.0
        )
        self._camera = self._rectifier.camera
        self._keyframes, self._effort, self._frames = keyframes, effort, list(frames)
        self._poses = np.array([frame.T_world_camera for frame in frames])
        images = {kf.frame.index: kf for kf in keyframes}

        def image_of(index: int) -> Bytes:
            return images[index].frame.load().image_rgb if index in images else read(index)

        self._views = FrameViews(self._frames, image_of, self._rectifier, _inverse_depth(keyframes))
        self._file = SpillFile()
        self._progress = progress
        self._done, self._total = 0, len(keyframes) * (1 + 2 * len(effort.rounds))

    def run(self, pool: ThreadPoolExecutor) -> dict[int, StoredDenseDepth]:
        states = [state for state in self._each(pool, self._begin, self._keyframes) if state is not None]
        neighbours = _neighbours(states, self._camera)
        depths: list[StoredDenseDepth] = []
        for reach_log, labels in self._effort.rounds:
            self._search(pool, states, reach_log, labels)
            settle = partial(self._settle, states=states, neighbours=neighbours)
            depths = self._each(pool, settle, range(len(states)))
        return {state.keyframe.id: one for state, one in zip(states, depths, strict=True)}

    def _search(
        self, pool: ThreadPoolExecutor, states: Sequence[_State], reach_log: float, labels: int
    ) -> None:
        """Depth by the views of all keyframes, a batch at a time: their images have to be in memory."""
        for start in range(0, len(states), _BATCH):
            batch = states[start : start + _BATCH]
            chosen = {state.keyframe.id: self._chosen(state) for state in batch}
            self._views.load(
                index for state in batch for index in (state.keyframe.frame.index, *chosen[state.keyframe.id])
            )
            measure_one = partial(self._measure, chosen=chosen, reach_log=reach_log, labels=labels)
            self._each(pool, measure_one, batch)

    def _each(self, pool: ThreadPoolExecutor, function: Callable[[_S], _T], items: Iterable[_S]) -> list[_T]:
        """The results for all items, in order."""
        results = []
        for result in pool.map(function, items):
            self._done += 1
            self._progress(self._done, self._total)
            results.append(result)
        return results

    def _put(self, state: _State, **maps: Floats32) -> None:
        for name, values in maps.items():
            state.maps[name] = self._file.spill(encode_half_precision(values))

    def _view(self, keyframe: Keyframe) -> tuple[View, Floats32 | None]:
        positions = self._rectifier.positions(
            self._views.velocity(keyframe.frame.index), self._views.inverse_depth
        )
        grey = self._rectifier.grey(keyframe.frame.load().image_rgb, positions)
        return View(grey, keyframe.T_world_camera), positions

    def _begin(self, keyframe: Keyframe) -> _State | None:
        """The sheet of a keyframe."""
        view, positions = self._view(keyframe)
        sheet = first_sheet(keyframe, self._rectifier, positions, view.grey)
        if sheet is None:
            return None
        state = _State(keyframe, surface_points(sheet.depth_m, self._camera, keyframe.T_world_camera))
        sign = np.where(sheet.is_sensor, np.float32(-1.0), np.float32(1.0))
        self._put(state, sheet=sheet.depth_m, sigma=sheet.sigma_log * sign, present=sheet.depth_m)
        return state

    def _chosen(self, state: _State) -> list[int]:
        rows = choose_views(
            state.points_w, self._camera, state.keyframe.T_world_camera, self._poses, self._effort.views
        )
        return [self._frames[row].index for row in rows]

    def _measure(self, state: _State, chosen: dict[int, list[int]], reach_log: float, labels: int) -> None:
        """Depth by the views, about the present one."""
        present = state.maps["present"].load()
        views = [view for index in chosen[state.keyframe.id] if (view := self._views.get(index)) is not None]
        if len(views) < 2:
            self._put(state, found=present, evidence=np.zeros_like(present))
            return
        keyframe = self._views.get(state.keyframe.frame.index)
        assert keyframe is not None
        measured = measure(keyframe, present, views, self._camera, reach_log, labels)
        self._put(state, found=present * np.exp(measured.log_ratio), evidence=measured.evidence)

    def _settle(
        self, place: int, states: Sequence[_State], neighbours: Sequence[Sequence[int]]
    ) -> StoredDenseDepth:
        """Keep what other keyframes confirm, and complete it by the sheet."""
        state = states[place]
        keyframe, others = state.keyframe, [states[n] for n in neighbours[place]]
        found, evidence, sheet, signed = (
            state.maps[name].load() for name in ("found", "evidence", "sheet", "sigma")
        )
        agreed = agreement(
            found,
            keyframe.T_world_camera,
            [(other.maps["found"].load(), other.keyframe.T_world_camera) for other in others],
            self._camera,
        )
        view, positions = self._view(keyframe)
        fused = fuse(sheet, np.abs(signed), signed < 0, found, evidence, agreed, view.grey)
        self._put(state, present=fused.complete_m)
        image_rgb = self._rectifier.color(keyframe.frame.load().image_rgb, positions)
        depth = DenseDepth(self._camera, image_rgb, fused.depth_m, fused.sigma_log, fused.is_measured)
        return StoredDenseDepth.of(depth, self._file)


def _inverse_depth(keyframes: Sequence[Keyframe]) -> float:
    """1/m of the scene in general, by a few keyframes."""
    some = keyframes[:: max(1, len(keyframes) // 5)]
    depths = [depth[depth > 0] for kf in some if (depth := kf.load_depth_m()[::8, ::8]).any()]
    return 1.0 / float(np.median(np.concatenate(depths))) if depths else 0.0


def _neighbours(states: Sequence[_State], camera: Camera) -> list[list[int]]:
    """For each keyframe the places of those that see most of the same."""
    poses = np.array([state.keyframe.T_world_camera for state in states])
    found = []
    for place, state in enumerate(states):
        share = are_seen(state.points_w, camera, poses).mean(axis=1)
        share[place] = 0.0
        best = np.argsort(-share, kind="stable")[:_NEIGHBOURS]
        found.append([int(n) for n in best if share[n] > _LEAST_OVERLAP])
    return found
