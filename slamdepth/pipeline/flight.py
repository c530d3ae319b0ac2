# SPDX-License-Identifier: Apache-2.0
"""The video of a reconstruction: a flight through the mesh of a run."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from slamdepth.errors import ConfigError, DatasetError
from slamdepth.pipeline.depth_maps.video import video_writer
from slamdepth.report.flight import draw_flight, plan_flight
from slamdepth.report.saved_run import read_mesh, read_run
from slamdepth.report.scene.simplify import simplified
from slamdepth.report.viewpoints import ideal_camera
from slamdepth.typing import Bytes

FLIGHT_FILE = "flight.mp4"
_MOST_TRIANGLES = 300_000  # more take longer and show no more in a video
_VIEW_DEG = 60.0


@dataclass(frozen=True)
class FlightQuestion:
    """A video that is asked for.

    Attributes:
        run: the run folder.
        output: the mp4 file.
        seconds, fps: its length and frame rate.
        width, height: in pixels, both even.
        number: which map, 1 for the largest.

    Raises:
        ConfigError: a number is out of range.
    """

    run: Path
    output: Path
    seconds: float = 12.0
    fps: float = 24.0
    width: int = 960
    height: int = 540
    number: int = 1

    def __post_init__(self) -> None:
        if not 0 < self.seconds <= 600:
            raise ConfigError(f"the length must be above 0 and at most 600 seconds, got {self.seconds:g}")
        if not 1 <= self.fps <= 120:
            raise ConfigError(f"the frame rate must be 1 to 120, got {self.fps:g}")
        if not all(64 <= side <= 4096 and side % 2 == 0 for side in (self.width, self.height)):
            raise ConfigError(
                f"width and height must be even numbers from 64 to 4096, got {self.width}x{self.height}"
            )

    @property
    def frames(self) -> int:
        return max(2, round(self.seconds * self.fps))


def render_flight(asked: FlightQuestion, progress: Callable[[int, int], None]) -> None:
    """Write the video of a run, whole or not at all.

    Args:
        progress: called with (images done, images in all).

    Raises:
        DatasetError: the run has no such map, or that map has no mesh.
        OutputError: the video cannot be written.
        SlamdepthError: Open3D is not installed.
    """
    run = read_run(asked.run)
    if not 1 <= asked.number <= len(run.scene.maps):
        raise DatasetError(f"{asked.run}: has no map {asked.number}; its maps are 1 to {len(run.scene.maps)}")
    one = run.scene.maps[asked.number - 1]
    path = run.map_folder(asked.number) / "mesh.ply"
    if not path.is_file() or len(one.path) == 0:
        raise DatasetError(f"{path}: no such mesh; run again without --no-mesh")
    one = replace(one, mesh=simplified(read_mesh(path), _MOST_TRIANGLES))
    flight = plan_flight(one, asked.frames)
    camera = ideal_camera(asked.width, asked.height, _VIEW_DEG)

    def draw(n: int) -> Bytes:
        return draw_flight(one, flight, n, camera, run.scene.aspect)

    workers = max(1, min(8, os.cpu_count() or 1))
    progress(0, asked.frames)
    with video_writer(asked.output, asked.fps) as add, ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Bytes]] = deque()
        try:
            for n in range(asked.frames):
                waiting.append(pool.submit(draw, n))
                if len(waiting) > workers:
                    add(waiting.popleft().result())
                    progress(n + 1 - len(waiting), asked.frames)
            for left in range(len(waiting), 0, -1):
                add(waiting.popleft().result())
                progress(asked.frames - left + 1, asked.frames)
        finally:
            for future in waiting:
                future.cancel()
