# SPDX-License-Identifier: Apache-2.0
"""A depth model of one's own: any class with ``name``, ``kind``, ``weights`` and ``predict``.

python docs/examples/own_depth_model.py demo/room

This one knows no image content. It assumes a level floor below an upright camera and a wall in front of it,
which is a poor prior, but enough to start a map that triangulation then corrects. A network of your own goes
into ``predict`` in the same way. ``slamdepth.depth.registry.register`` makes a model known by name.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

import slamdepth


class FloorAndWall:
    """Depth of a level floor, no farther than a wall.

    Args:
        height_m: height of the camera above the floor.
        wall_m: distance of the wall.
        sigma_log: standard deviation of the logarithm of depth, about the relative error.
    """

    name = "floor-and-wall"
    kind = slamdepth.DepthKind.METRIC
    weights: tuple[slamdepth.WeightsInfo, ...] = ()

    def __init__(self, height_m: float = 1.4, wall_m: float = 3.0, sigma_log: float = 0.3) -> None:
        self.height_m = height_m
        self.wall_m = wall_m
        self.sigma_log = sigma_log

    def predict(self, frame: slamdepth.Frame) -> slamdepth.DepthPrediction:
        """Predict depth along z, ``(H, W)`` in metres."""
        camera = frame.camera
        gravity = np.array([0.0, 1.0, 0.0]) if frame.gravity is None else frame.gravity
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        fall = gravity[0] * x + gravity[1] * y + gravity[2]  # towards the floor, per metre of depth
        floor_m = self.height_m / np.maximum(fall, 1e-6)
        depth_m = np.minimum(floor_m, self.wall_m).astype(np.float32)
        return slamdepth.DepthPrediction(depth_m, self.kind, np.full_like(depth_m, self.sigma_log))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program."""
    (sequence,) = sys.argv[1:] if arguments is None else arguments
    dataset = slamdepth.open_dataset(sequence)
    with slamdepth.Tracker(dataset.camera, depth_model=FloorAndWall()) as tracker:
        for frame in dataset:
            tracker.step(frame)
        reconstruction = tracker.finish()
    print(f"{len(reconstruction.trajectory)} poses, {len(reconstruction.keyframes)} keyframes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
