# SPDX-License-Identifier: Apache-2.0
"""A short rendered walk, depth models made up for it, and the errors of a tracker."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slamdepth.config import Config
from slamdepth.depth import registry
from slamdepth.depth.base import DepthModel
from slamdepth.depth.sensor import SensorDepth
from slamdepth.geometry import invert, umeyama
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.synth.sequence import SynthSettings, render_frames, synth_camera
from slamdepth.tracking import Tracker, create_tracker
from slamdepth.types import (
    DepthKind,
    DepthPrediction,
    Frame,
    StepResult,
    TrackingStatus,
    Trajectory,
    WeightsInfo,
)

COUNT = 64
SETTINGS = SynthSettings(frames=COUNT, width=320, height=240, seed=3)
CAMERA = synth_camera(SETTINGS)
CONFIG = Config.from_dict({"features": {"count": 600}})

Change = Callable[[Frame], Frame]


def walk(*, bare: bool = False) -> tuple[tuple[Frame, ...], NDArray[np.float64]]:
    """All frames with exact depth, and their poses ``(COUNT, 4, 4)`` in the first camera.

    Args:
        bare: along the same path through a white room.
    """
    return _rendered(bare)


@lru_cache  # of a function without defaults: walk() and walk(bare=False) would be two entries
def _rendered(bare: bool) -> tuple[tuple[Frame, ...], NDArray[np.float64]]:
    settings = SETTINGS.model_copy(update={"texture": "bare"}) if bare else SETTINGS
    frames, poses = zip(*render_frames(settings, range(COUNT)), strict=True)
    return frames, invert(poses[0]) @ np.stack(poses)


def frames(
    indices: Iterable[int] = range(COUNT), change: Change | None = None, *, bare: bool = False
) -> list[Frame]:
    """Some frames of the walk, with ``change`` applied to each."""
    chosen = [walk(bare=bare)[0][i] for i in indices]
    return chosen if change is None else [change(frame) for frame in chosen]


def played(given: Iterable[Frame]) -> list[Frame]:
    """Frames one after another at the walk's pace, whenever they were taken; ``index`` stays."""
    return [replace(frame, timestamp_s=k / SETTINGS.fps) for k, frame in enumerate(given)]


def colour_only(frame: Frame) -> Frame:
    return replace(frame, depth_m=None)


def grey(frame: Frame) -> Frame:
    """As if a hand lay over the lens of the colour camera."""
    return replace(frame, image_rgb=np.full_like(frame.image_rgb, 90))


def covered(frame: Frame) -> Frame:
    """As if a hand lay over both lenses."""
    return replace(grey(frame), depth_m=np.zeros_like(frame.depth_m))


class ConstantDepth:
    """The worst honest network: two metres everywhere, with a large deviation."""

    name = "constant"
    kind = DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, depth_m: float = 2.0, sigma_log: float = 0.45) -> None:
        self.depth_m, self.sigma_log = depth_m, sigma_log
        self.calls = 0

    def predict(self, frame: Frame) -> DepthPrediction:
        self.calls += 1
        shape = frame.image_rgb.shape[:2]
        return DepthPrediction(
            np.full(shape, self.depth_m, np.float32), self.kind, np.full(shape, self.sigma_log, np.float32)
        )


def register_constant_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register :class:`ConstantDepth` as the depth model ``constant``."""

    def flat(**_: Any) -> ConstantDepth:
        return ConstantDepth()

    monkeypatch.setitem(registry.MODELS.parts, "constant", flat)


class Run:
    """A tracker after some frames, and after :meth:`finish` its reconstruction."""

    def __init__(
        self, given: Iterable[Frame], model: DepthModel | None = None, config: Config = CONFIG
    ) -> None:
        self.tracker = create_tracker(CAMERA, model or SensorDepth(), config)
        self.results: list[StepResult] = [self.tracker.step(frame) for frame in given]

    @property
    def slam(self) -> Tracker:
        """The tracker by features, for tests that look into its parts."""
        assert isinstance(self.tracker, Tracker)
        return self.tracker

    def finish(self) -> Reconstruction:
        return self.tracker.finish()

    def statuses(self) -> Counter[TrackingStatus]:
        return Counter(result.status for result in self.results)

    def status_of(self, index: int) -> TrackingStatus:
        return next(r.status for r in self.results if r.index == index)


def poses_of(results: Iterable[StepResult]) -> NDArray[np.float64]:
    """Poses ``(N, 4, 4)`` of frames that were all placed."""
    poses = [r.T_world_camera for r in results]
    placed = [T for T in poses if T is not None]
    assert len(placed) == len(poses)
    return np.stack(placed)


def errors_m(results: Iterable[StepResult]) -> NDArray[np.float64]:
    """``(N,)`` distances of the placed frames from the truth, the first placed camera aligned."""
    placed = [(r.index, r.T_world_camera) for r in results if r.T_world_camera is not None]
    truth = walk()[1][[index for index, _ in placed]]
    moved = placed[0][1] @ invert(truth[0]) @ truth
    return _distances_m(moved, np.stack([T for _, T in placed]))


def _distances_m(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> NDArray[np.float64]:
    distances: NDArray[np.float64] = np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1)
    return distances


def truth_of(trajectory: Trajectory) -> NDArray[np.float64]:
    """True poses ``(N, 4, 4)`` at the times of a trajectory, in the first camera of the walk."""
    index = np.rint(trajectory.timestamps_s * SETTINGS.fps).astype(int)
    poses: NDArray[np.float64] = walk()[1][index]
    return poses


def ate_m(trajectory: Trajectory, *, with_scale: bool = False) -> float:
    """RMSE of positions after alignment, metres of the truth."""
    estimate, truth = trajectory.T_world_camera[:, :3, 3], truth_of(trajectory)[:, :3, 3]
    scale, R, t = umeyama(estimate, truth, with_scale)
    return float(np.sqrt(np.mean(np.sum((scale * estimate @ R.T + t - truth) ** 2, axis=1))))


def position_errors_m(trajectory: Trajectory) -> NDArray[np.float64]:
    """``(N,)`` distances from the truth, with nothing aligned but the first camera."""
    truth = truth_of(trajectory)
    return _distances_m(trajectory.T_world_camera, invert(truth[0]) @ truth)
