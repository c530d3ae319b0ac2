# SPDX-License-Identifier: Apache-2.0
"""Dense depth of all keyframes of a run."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.dense.agreement import agreement
from slamdepth.dense.frames import FrameViews
from slamdepth.dense.fuse import fuse
from slamdepth.dense.measure import measure
from slamdepth.dense.rectify import Rectifier
from slamdepth.dense.sheet import first_sheet
from slamdepth.dense.views import are_seen, choose_views, parallax_rad, surface_points
from slamdepth.errors import ConfigError, ImageDecodeError
from slamdepth.mapping.codec import encode_half_precision
from slamdepth.mapping.dense_depth import DenseDepth, StoredDenseDepth, store_dense_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.spill_file import SpilledArray, SpillFile
from slamdepth.thread_limits import single_threaded
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Bytes, Floats, Floats32

log = logging.getLogger(__name__)

_S = TypeVar("_S")
_T = TypeVar("_T")

_BATCH = 48  # keyframes whose views are in memory at a time
_NEIGHBOURS = 8
_LEAST_OVERLAP = 0.25


@dataclass(frozen=True)
class DenseEffort:
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
    "fast": DenseEffort(320, 6, ((0.42, 33),)),
    "best": DenseEffort(480, 8, ((0.42, 49), (0.1, 21))),
}


def densify(
    reconstruction: Reconstruction,
    dataset: Dataset | None = None,
    effort: DenseEffort | str = "fast",
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Measure the depth of each keyframe from the frames about it.

    Args:
        reconstruction: a finished map, with keyframes' depth by a network or a sensor.
        dataset: what was tracked; all its frames become views. Without it those of the keyframes do.
        effort: "fast", "best" or one of your own.
        progress: called with (steps done, steps in all).

    Returns:
        The same map; each keyframe with depth has ``dense`` depth, which :meth:`Reconstruction.fuse_mesh`
        takes. The same input gives the same bytes.

    Raises:
        ConfigError: there is no effort of this name.
    """
    if isinstance(effort, str):
        if effort not in EFFORTS:
            raise ConfigError(f"effort must be one of {', '.join(EFFORTS)}, got {effort!r}")
        effort = EFFORTS[effort]
    times_s = set(reconstruction.trajectory.timestamps_s.tolist())
    if sum(kf.frame.timestamp_s in times_s for kf in reconstruction.keyframes) < 2:
        return reconstruction
    job = _Job(reconstruction, dataset, effort, progress or (lambda done, total: None))
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        with single_threaded():
            depths = job.run(pool)
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted job does not finish what waits
    return replace(
        reconstruction,
        keyframes=tuple(replace(kf, dense=depths.get(kf.id)) for kf in reconstruction.keyframes),
    )


@dataclass
class _State:
    """A keyframe while it is worked on; its maps, ``(h, w)`` at the working size, are in a file."""

    keyframe: Keyframe
    row: int  # of its frame in the trajectory
    points_w: Floats
    maps: dict[str, SpilledArray] = field(default_factory=dict)
    parallax_rad: float = 0.0  # of its views


class _Job:
    """All keyframes of a map."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        dataset: Dataset | None,
        effort: DenseEffort,
        progress: Callable[[int, int], None],
    ) -> None:
        trajectory = reconstruction.trajectory
        self._row = {time_s: row for row, time_s in enumerate(trajectory.timestamps_s.tolist())}
        keyframes = [kf for kf in reconstruction.keyframes if kf.frame.timestamp_s in self._row]
        self._rectifier = Rectifier.of(
            keyframes[0].frame.camera, effort.width, reconstruction.statistics.readout_s or 0.0
        )
        self._camera = self._rectifier.camera
        self._keyframes, self._effort = keyframes, effort
        images = _Images(trajectory, keyframes, dataset)
        self._candidates, self._poses = images.rows, trajectory.T_world_camera[images.rows]
        self._views = FrameViews(trajectory, images.read, self._rectifier, _inverse_depth(keyframes))
        self._file = SpillFile()
        self._progress = progress
        self._done, self._total = 0, len(keyframes) * (1 + 2 * len(effort.rounds))

    def run(self, pool: ThreadPoolExecutor) -> dict[int, StoredDenseDepth]:
        states = [state for state in self._each(pool, self._begin, self._keyframes) if state is not None]
        self._total -= (len(self._keyframes) - len(states)) * 2 * len(self._effort.rounds)
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
            chosen = {state.row: self._chosen(state) for state in batch}
            self._views.load(row for state in batch for row in (state.row, *chosen[state.row]))
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

    def _begin(self, keyframe: Keyframe) -> _State | None:
        """The sheet of a keyframe."""
        row = self._row[keyframe.frame.timestamp_s]
        positions = self._views.positions(row)
        grey = self._rectifier.grey(keyframe.frame.load().image_rgb, positions)
        sheet = first_sheet(keyframe, self._rectifier, positions, grey)
        if sheet is None:
            return None
        state = _State(keyframe, row, surface_points(sheet.depth_m, self._camera, keyframe.T_world_camera))
        is_sensor = sheet.is_sensor.astype(np.float32)
        self._put(state, sheet=sheet.depth_m, is_sensor=is_sensor, present=sheet.depth_m)
        return state

    def _chosen(self, state: _State) -> list[int]:
        rows = choose_views(
            state.points_w, self._camera, state.keyframe.T_world_camera, self._poses, self._effort.views
        )
        return [int(row) for row in self._candidates[rows]]

    def _measure(self, state: _State, chosen: dict[int, list[int]], reach_log: float, labels: int) -> None:
        """Depth by the views, about the present one."""
        present = state.maps["present"].load()
        views = [view for row in chosen[state.row] if (view := self._views.get(row)) is not None]
        if len(views) < 2:
            self._put(state, found=present, evidence=np.zeros_like(present))
            return
        keyframe = self._views.get(state.row)
        assert keyframe is not None
        poses = np.array([view.T_world_camera for view in views])
        state.parallax_rad = parallax_rad(state.points_w, state.keyframe.T_world_camera, poses)
        measured = measure(keyframe, present, views, self._camera, reach_log, labels)
        self._put(state, found=present * np.exp(measured.log_ratio), evidence=measured.evidence)

    def _settle(
        self, place: int, states: Sequence[_State], neighbours: Sequence[Sequence[int]]
    ) -> StoredDenseDepth:
        """Keep what other keyframes confirm, and complete it by the sheet."""
        state = states[place]
        keyframe, others = state.keyframe, [states[n] for n in neighbours[place]]
        found, evidence, sheet, is_sensor = (
            state.maps[name].load() for name in ("found", "evidence", "sheet", "is_sensor")
        )
        agreed = agreement(
            found,
            keyframe.T_world_camera,
            [(other.maps["found"].load(), other.keyframe.T_world_camera) for other in others],
            self._camera,
        )
        image_rgb = keyframe.frame.load().image_rgb
        positions = self._views.positions(state.row)
        grey = self._rectifier.grey(image_rgb, positions)
        parallax_px = state.parallax_rad * 0.5 * (self._camera.fx + self._camera.fy)
        fused = fuse(sheet, is_sensor > 0, found, evidence, agreed, grey, parallax_px)
        self._put(state, present=fused.complete_m)
        color = self._rectifier.color(image_rgb, positions)
        depth = DenseDepth(self._camera, color, fused.depth_m, fused.sigma_log, fused.is_measured)
        return store_dense_depth(depth, self._file)


class _Images:
    """The images of a trajectory's frames.

    Attributes:
        rows: of the trajectory, those that may have an image.
    """

    def __init__(
        self, trajectory: Trajectory, keyframes: Sequence[Keyframe], dataset: Dataset | None
    ) -> None:
        self._keyframes = {kf.frame.timestamp_s: kf for kf in keyframes}
        self._dataset = dataset
        times_s = [] if dataset is None else dataset.timestamps_s.tolist()
        self._index = {time_s: index for index, time_s in enumerate(times_s)}
        self._times_s: list[float] = trajectory.timestamps_s.tolist()
        self.rows = np.array(
            [
                row
                for row, time_s in enumerate(self._times_s)
                if time_s in self._keyframes or time_s in self._index
            ],
            dtype=np.int64,
        )

    def read(self, row: int) -> Bytes | None:
        """The image of a row; None where it does not decode."""
        time_s = self._times_s[row]
        if time_s in self._keyframes:
            return self._keyframes[time_s].frame.load().image_rgb
        assert self._dataset is not None
        try:
            return self._dataset.read(self._index[time_s]).image_rgb
        except ImageDecodeError as error:
            log.debug("a frame is no view: %s", error)
            return None


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
