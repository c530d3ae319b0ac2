# SPDX-License-Identifier: Apache-2.0
"""A finished run in the viewer: mesh, cloud, path, keyframes with images, loops, several maps, playback."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.open3d_loader import import_open3d
from slamdepth.report.saved_run import SavedRun
from slamdepth.report.scene import Thumbnail
from slamdepth.report.scene.page_data import first_view, segments
from slamdepth.report.scene.simplify import simplified
from slamdepth.viewer.server import LOOP, NOW, PATH, TRUTH, field_of_view, frustum_lines, placed

if TYPE_CHECKING:
    from slamdepth.mapping.mesh import Mesh
    from slamdepth.report.scene import Scene, SceneMap
    from slamdepth.typing import Bytes

_MOST_TRIANGLES = 1_000_000
_MOST_POINTS = 1_000_000
_KEYFRAME, _CURRENT = 0.022, 0.06  # depth of frustums, of the size of the map
_PARTS = ("mesh", "cloud", "points", "path", "ground truth", "keyframes", "images", "loops")
_HIDDEN = ("cloud", "points", "images")  # at first, where there is a mesh
_FIELD_RAD = 0.72  # from top to bottom
_IMAGES = 60  # keyframes that show their image in space


@dataclass(frozen=True)
class _Stop:
    """A place of the slider: a keyframe with images."""

    map_index: int
    time_s: float
    thumbnail: Thumbnail


class RunView:
    """Shows a run on a server of :func:`slamdepth.viewer.start_server`.

    Args:
        server: a ``viser.ViserServer``.
        run: with its meshes, see :meth:`slamdepth.report.saved_run.SavedRun.with_meshes`.
    """

    def __init__(self, server: Any, run: SavedRun) -> None:
        self._server = server
        self._scene: Scene = run.scene
        self._views = [first_view(one) for one in run.scene.maps]
        self._parts: dict[str, Any] = {}
        self._shown = 0
        self._closed = threading.Event()
        self._stops = sorted(
            (
                _Stop(n, float(one.keyframes.timestamps_s[thumbnail.row]) - run.scene.start_s, thumbnail)
                for n, one in enumerate(run.scene.maps)
                for thumbnail in one.thumbnails
            ),
            key=lambda stop: stop.time_s,
        )
        for n, one in enumerate(run.scene.maps):
            self._add_map(n, one, run.map_folder(one.number) / "cloud.ply")
        self._add_controls(run)
        self._show_map(0)
        server.on_client_connect(lambda client: self._aim(client))
        self._player = threading.Thread(target=self._play, name="playback", daemon=True)
        self._player.start()

    def close(self) -> None:
        """End the playback."""
        self._closed.set()
        self._player.join(timeout=5)

    def show(self, n: int) -> None:
        """Show a place of the slider: its image, its depth, and where the camera was."""
        if not self._stops:
            return
        stop = self._stops[n]
        if stop.map_index != self._shown:
            self._show_map(stop.map_index)
        one = self._scene.maps[stop.map_index]
        image, depth = (_decoded(data) for data in (stop.thumbnail.image, stop.thumbnail.depth))
        pose = one.keyframes.T_world_camera[stop.thumbnail.row]
        with self._server.atomic():
            self._now.visible = True
            self._now.wxyz, self._now.position = placed(pose).values()
            self._now.image = image
            self._now.scale = _CURRENT * self._views[stop.map_index][3]
            self._image.image, self._depth.image = image, depth
            self._when.content = f"{stop.time_s:.2f} s, keyframe {int(one.keyframe_ids[stop.thumbnail.row])}"
        if self._follow.value:
            for client in self._server.get_clients().values():
                _look_with(client, pose, 0.07 * self._views[stop.map_index][3])

    def _add_map(self, n: int, one: SceneMap, cloud: Path) -> None:
        scene, (_, _, _, size) = self._server.scene, self._views[n]
        name, parts = f"/{one.number}", self._parts
        if one.mesh is not None:
            parts[f"{n} mesh"] = _add_mesh(scene, f"{name}/mesh", simplified(one.mesh, _MOST_TRIANGLES))
        if cloud.is_file():
            points, colors = _read_cloud(cloud)
            parts[f"{n} cloud"] = scene.add_point_cloud(
                f"{name}/cloud", points, colors, point_size=0.0015 * size, precision="float32"
            )
        if len(one.points_m):
            parts[f"{n} points"] = scene.add_point_cloud(
                f"{name}/points", one.points_m.astype(np.float32), TRUTH, point_size=0.002 * size
            )
        lines = {
            "path": (segments(one.path), PATH, 3.0),
            "ground truth": (segments(one.truth) if one.truth else np.zeros((0, 2, 3)), TRUTH, 2.0),
            "keyframes": (
                frustum_lines(one.keyframes.T_world_camera, self._scene.aspect, _KEYFRAME * size), PATH, 1.2,
            ),
            "loops": (one.keyframes.T_world_camera[one.loops][..., :3, 3], LOOP, 2.0),
        }  # fmt: skip
        for kind, (ends, colour, width) in lines.items():
            if len(ends):
                parts[f"{n} {kind}"] = scene.add_line_segments(
                    f"{name}/{kind}",
                    ends.astype(np.float32),
                    colour,
                    thickness=width,
                    thickness_units="screen",
                )
        some = one.thumbnails[:: max(1, -(-len(one.thumbnails) // _IMAGES))]
        if some:
            parts[f"{n} images"] = scene.add_frame(f"{name}/images", show_axes=False)
            for thumbnail in some:
                scene.add_camera_frustum(
                    f"{name}/images/{thumbnail.row}",
                    **field_of_view(self._scene.aspect),
                    scale=2 * _KEYFRAME * size,
                    thickness=1.2,
                    thickness_units="screen",
                    color=PATH,
                    image=_decoded(thumbnail.image),
                    **placed(one.keyframes.T_world_camera[thumbnail.row]),
                )

    def _add_controls(self, run: SavedRun) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.add_markdown(f"**{run.summary['sequence']}**  \n{run.summary['health']['headline']}")
        names = [f"map {one.number}, {len(one.path)} frames" for one in self._scene.maps]
        self._chooser = gui.add_dropdown("map", names, initial_value=names[0], visible=len(names) > 1)
        self._chooser.on_update(lambda _: self._show_map(names.index(self._chooser.value)))
        has_mesh = any(one.mesh is not None for one in self._scene.maps)
        self._boxes = {}
        for part in _PARTS:
            if any(key.endswith(f" {part}") for key in self._parts):
                shown = not (has_mesh and part in _HIDDEN) and part != "images"
                box = self._boxes[part] = gui.add_checkbox(part, shown)
                box.on_update(lambda _: self._update_parts())
        last = max(1, len(self._stops) - 1)
        is_there = bool(self._stops)
        self._slider = gui.add_slider("time", 0, last, 1, 0, visible=is_there, disabled=len(self._stops) < 2)
        self._slider.on_update(lambda _: self.show(min(self._slider.value, len(self._stops) - 1)))
        self._playing = gui.add_checkbox("play", False, visible=is_there)
        self._speed = gui.add_slider("keyframes a second", 1, 20, 1, 6, visible=is_there)
        self._follow = gui.add_checkbox("follow the camera", False, visible=is_there)
        self._follow.on_update(lambda _: self.show(min(self._slider.value, len(self._stops) - 1)))
        gui.add_button("reset the view").on_click(lambda _: self._aim_all())
        self._when = gui.add_markdown("", visible=is_there)
        blank = np.zeros((3, 4, 3), np.uint8)
        self._image = gui.add_image(blank, label="image", format="jpeg", visible=is_there)
        low_to_high = f"depth, {self._scene.near_m:.1f} (dark) to {self._scene.far_m:.1f} m (yellow)"
        self._depth = gui.add_image(blank, label=low_to_high, format="jpeg", visible=is_there)
        self._now = scene.add_camera_frustum(
            "/now",
            **field_of_view(self._scene.aspect),
            scale=0.1,
            thickness=2.5,
            thickness_units="screen",
            color=NOW,
            visible=False,
        )
        self.show(0)

    def _update_parts(self) -> None:
        with self._server.atomic():
            for key, handle in self._parts.items():
                number, part = key.split(" ", 1)
                handle.visible = int(number) == self._shown and self._boxes[part].value

    def _show_map(self, n: int) -> None:
        self._shown = n
        self._update_parts()
        self._chooser.value = self._chooser.options[n]
        self._server.scene.set_up_direction(self._views[n][2])
        self._aim_all()

    def _aim_all(self) -> None:
        for client in self._server.get_clients().values():
            self._aim(client)

    def _aim(self, client: Any) -> None:
        eye, target, up, size = self._views[self._shown]
        client.camera.up_direction = up
        client.camera.position = eye
        client.camera.look_at = target
        client.camera.fov = _FIELD_RAD
        client.camera.near, client.camera.far = 1e-3 * size, 20 * size

    def _play(self) -> None:
        while not self._closed.wait(1.0 / self._speed.value):
            if self._playing.value and len(self._stops) > 1:
                self._slider.value = (self._slider.value + 1) % len(self._stops)


def _look_with(client: Any, T_world_camera: Any, back_m: float) -> None:
    """Move the viewer's camera a step behind a camera of the run."""
    right, down, ahead = T_world_camera[:3, :3].T
    del right
    with client.atomic():
        client.camera.position = T_world_camera[:3, 3] - back_m * ahead - 0.25 * back_m * down
        client.camera.look_at = T_world_camera[:3, 3] + 4 * back_m * ahead


def _add_mesh(scene: Any, name: str, mesh: Mesh) -> Any:
    import trimesh

    colors = np.full((len(mesh.vertices_m), 4), 255, np.uint8)
    colors[:, :3] = np.round(np.clip(mesh.colors if mesh.colors.any() else 0.75, 0, 1) * 255)
    shown = trimesh.Trimesh(mesh.vertices_m, mesh.triangles, vertex_colors=colors, process=False)
    return scene.add_mesh_trimesh(name, shown, cast_shadow=False, receive_shadow=False)


def _read_cloud(path: Path) -> tuple[Any, Any]:
    o3d = import_open3d()
    cloud = o3d.io.read_point_cloud(str(path))
    points, colors = np.asarray(cloud.points, np.float32), np.asarray(cloud.colors)
    step = max(1, -(-len(points) // _MOST_POINTS))
    return points[::step], np.round(colors[::step] * 255).astype(np.uint8)


def _decoded(data: bytes) -> Bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image[..., ::-1], np.uint8)


def wait_for_end(stop: threading.Event) -> None:
    """Return when ``stop`` is set; a signal handler may set it."""
    while not stop.is_set():
        time.sleep(0.2)
