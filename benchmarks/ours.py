# SPDX-License-Identifier: Apache-2.0
"""slamdepth as a system under test: the tracker alone, without files, mesh and report."""

from __future__ import annotations

from benchmarks.seeded import seeded_depth_model
from benchmarks.system import Estimate
from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.pipeline.results import keyframe_trajectory
from slamdepth.pipeline.seeds import seed_everything, seed_torch
from slamdepth.tracking import create_tracker
from slamdepth.types import Camera, Frame


class SlamDepth:
    """Tracks as ``slamdepth run --no-mesh`` does; the network runs in the measured time.

    Args:
        model: used instead of the depth model that ``config`` names.

    Raises:
        WeightsError: the weights of the depth model are missing.
    """

    def __init__(self, camera: Camera, config: Config, model: DepthModel | None = None) -> None:
        if model is None:
            model = seeded_depth_model(config.depth.name, config)
        else:
            seed_everything(config.seed)
            seed_torch(config.seed)
        self._tracker = create_tracker(camera, model, config)

    def step(self, frame: Frame) -> None:
        """Track the next frame."""
        self._tracker.step(frame)

    def finish(self) -> Estimate:
        """Optimise the map and hand over the poses.

        Raises:
            TrackingError: no frame was tracked.
        """
        done = self._tracker.finish()
        counts = {
            "keyframes": len(done.keyframes),
            "loops": done.statistics.loop_closures,
            "relocalisations": done.statistics.relocalisations,
            "registrations": done.statistics.registrations,
        }
        keyframes = keyframe_trajectory(done) if done.keyframes else None
        return Estimate(done.trajectory, keyframes, counts)
