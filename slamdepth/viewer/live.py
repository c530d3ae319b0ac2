# SPDX-License-Identifier: Apache-2.0
"""A run in the viewer while it goes on: keyframes, points, loops, the camera and its image."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.tracking.snapshot import MapSnapshot, Watched
from slamdepth.viewer.server import LOOP, NOW, PATH, field_of_view, frustum_lines, placed

if TYPE_CHECKING:
    from slamdepth.types import Frame, StepResult
    from slamdepth.typing import Bytes, Floats

_BUSY = 0.03  # most of the time of one core that sending may take
_SHORTEST_S = 0.25  # between two pictures
_MOST_POINTS = 20_000
_GROWN = 1.3  # factor on its size from which on a map is looked at anew
_WIDTH_PX = 256
_STATUS = {"tracking": "tracking", "lost": "**lost**"}


@dataclass(frozen=True)
class _News:
    """What the tracker's thread hands over."""

    snapshot: MapSnapshot | None
    T_world_camera: Floats | None
    map_id: int
    image_rgb: Bytes
    aspect: tuple[float, float]
    text: str


class LiveView:
    """Shows a run on a server of :func:`slamdepth.viewer.start_server` while it goes on.

    Tracking is never waited for and never waits: its thread copies the map and leaves it in a box of one
    place, four times a second at most and only while a browser looks. Another thread sends it and then
    rests, so that it is busy for 3 % of the time of a core.

    A context manager: leaving it ends the thread.

    Args:
        server: a ``viser.ViserServer``.
    """

    def __init__(self, server: Any) -> None:
        self._server = server
        self._news: _News | None = None
        self._is_wanted = threading.Event()
        self._arrived = threading.Event()
        self._closed = False
        self._aims: dict[int, tuple[int, Floats, float]] = {}  # of each browser: map, eye, size
        self._handles: dict[str, Any] = {}
        self._text = server.gui.add_markdown("waiting for the first keyframe")
        blank = np.zeros((3, 4, 3), np.uint8)
        self._image = server.gui.add_image(blank, label="image", format="jpeg")
        server.on_client_connect(lambda _: self._is_wanted.set())
        self._thread = threading.Thread(target=self._send, name="viewer", daemon=True)

    def __enter__(self) -> LiveView:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._arrived.set()
        self._thread.join(timeout=5)

    def saw(self, frame: Frame, result: StepResult, tracker: Watched) -> None:
        """Take over what is new where a picture is wanted; called after each frame."""
        if not self._is_wanted.is_set():
            return
        snapshot = tracker.take_snapshot()
        if snapshot is None:
            tracker.ask_for_snapshot()
            return
        camera = frame.camera
        step = max(1, frame.image_rgb.shape[1] // _WIDTH_PX)
        self._news = _News(
            snapshot,
            result.T_world_camera,
            result.map_id,
            np.ascontiguousarray(frame.image_rgb[::step, ::step]),
            (camera.width / camera.fx / 2, camera.height / camera.fy / 2),
            f"{_STATUS.get(result.status.value, result.status.value)} · frame {result.index} · "
            f"keyframes {result.keyframes} · loops {result.loop_closures} · map {result.map_id + 1}",
        )
        self._is_wanted.clear()
        self._arrived.set()

    def _send(self) -> None:
        while True:
            self._arrived.wait()
            if self._closed:
                return
            self._arrived.clear()
            news = self._news
            start = time.thread_time()
            if news is not None:
                with self._server.atomic():
                    self._draw(news)
            busy_s = time.thread_time() - start
            self._pause(max(_SHORTEST_S, busy_s / _BUSY))
            if self._server.get_clients():
                self._is_wanted.set()

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while not self._closed and (left := end - time.monotonic()) > 0:
            time.sleep(min(0.1, left))

    def _draw(self, news: _News) -> None:
        self._text.content = news.text
        self._image.image = news.image_rgb
        snapshot, scene = news.snapshot, self._server.scene
        if snapshot is None:
            return
        places = snapshot.T_world_camera[:, :3, 3]
        points = snapshot.points_m[:: max(1, -(-len(snapshot.points_m) // _MOST_POINTS))]
        size = _size(np.concatenate([points, places]))
        if len(points):
            self._handles["points"] = scene.add_point_cloud(
                "/points", points.astype(np.float32), (90, 100, 115), point_size=0.003 * size
            )
        lines = {
            "keyframes": (frustum_lines(snapshot.T_world_camera, news.aspect, 0.02 * size), PATH, 1.2),
            "path": (np.stack([places[:-1], places[1:]], axis=1), PATH, 3.0),
            "loops": (places[snapshot.loops], LOOP, 2.0),
        }
        for name, (ends, colour, width) in lines.items():
            if len(ends):
                self._handles[name] = scene.add_line_segments(
                    f"/{name}", ends.astype(np.float32), colour, thickness=width, thickness_units="screen"
                )
            elif name in self._handles:  # of another map
                self._handles.pop(name).remove()
        if news.T_world_camera is not None and news.map_id == snapshot.map_id:
            self._handles["now"] = scene.add_camera_frustum(
                "/now",
                **field_of_view(news.aspect),
                scale=0.06 * size,
                color=NOW,
                thickness=2.5,
                thickness_units="screen",
                image=news.image_rgb,
                format="jpeg",
                **placed(news.T_world_camera),
            )
        self._aim(snapshot, size)

    def _aim(self, snapshot: MapSnapshot, size: float) -> None:
        """Look from behind and above the first camera, up in its image; again as the map grows, unless the
        user has moved the view."""
        start = snapshot.T_world_camera[0]
        _, down, ahead = start[:3, :3].T
        for number, client in self._server.get_clients().items():
            map_id, before, aimed_size = self._aims.get(number, (-1, np.zeros(3), 0.0))
            if map_id == snapshot.map_id:
                was_moved = np.linalg.norm(client.camera.position - before) > 0.02 * aimed_size
                if was_moved or size < _GROWN * aimed_size:
                    continue
            eye = start[:3, 3] - 0.6 * size * ahead - 0.5 * size * down
            client.camera.up_direction = -down
            client.camera.position = eye
            client.camera.look_at = start[:3, 3] + 0.4 * size * ahead
            self._aims[number] = (snapshot.map_id, eye, size)


def _size(points: Floats) -> float:
    low, high = np.percentile(points, [3, 97], axis=0)
    return max(float(np.linalg.norm(high - low)), 0.2)
