# SPDX-License-Identifier: Apache-2.0
"""``scene.safetensors`` of a run folder: what a viewer shows besides the mesh, the cloud and the path.

One file of safetensors. Its metadata has one entry, ``slamdepth``, a JSON text with ``format``, ``version``,
``near_m``, ``far_m``, ``camera`` and the number of ``maps``. Tensors of each map ``N``, from 1:

* ``N/keyframe_ids (K,)``, ``N/keyframe_times_s (K,)``, ``N/keyframe_poses (K, 4, 4)``: camera to world;
* ``N/loops (L, 2)``: rows of keyframes; ``N/points_m (P, 3)``; ``N/gravity (3,)`` or ``(0,)``;
* ``N/truth_times_s (M,)`` and ``N/truth_m (M, 3)``: the ground truth aligned by SE(3), or empty;
* ``N/thumbnail_rows (T,)``: the keyframes that have images; ``N/images``, ``N/depths``: their JPEG files one
  behind the other; ``N/image_ends (T,)``, ``N/depth_ends (T,)``: where each ends, in bytes.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import CameraError, DatasetError
from slamdepth.io.tensors import decode_tensors, encode_tensors, write_bytes
from slamdepth.report.scene.model import Scene, SceneMap, Thumbnail
from slamdepth.types import Camera, Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCENE_FILE = "scene.safetensors"
_FORMAT, _VERSION = "slamdepth scene", 1
_KEY = "slamdepth"


def write_scene(path: Path, scene: Scene) -> None:
    """Write everything of ``scene`` but meshes and paths, whole or not at all.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    tensors: dict[str, NDArray[Any]] = {}
    for one in scene.maps:
        tensors |= {f"{one.number}/{name}": array for name, array in _tensors(one).items()}
    about = {
        "format": _FORMAT,
        "version": _VERSION,
        "maps": len(scene.maps),
        "near_m": scene.near_m,
        "far_m": scene.far_m,
        "camera": None if scene.camera is None else asdict(scene.camera),
    }
    write_bytes(path, encode_tensors(tensors, about, _KEY))


def read_scene(path: Path) -> Scene:
    """Read a file of :func:`write_scene`; meshes and paths are missing.

    Raises:
        DatasetError: it cannot be read, is damaged, or is of a newer version.
    """
    try:
        tensors, about = decode_tensors(path.read_bytes(), _KEY)
        if not isinstance(about, dict) or about.get("format") != _FORMAT:
            raise DatasetError(f"{path}: is no scene of a run")
        if about["version"] != _VERSION:
            raise DatasetError(
                f"{path}: has version {about['version']}, this slamdepth reads {_VERSION}: run it again"
            )
        camera = None if about["camera"] is None else _camera(about["camera"])
        maps = tuple(_map(tensors, number) for number in range(1, about["maps"] + 1))
        return Scene(maps, camera, float(about["near_m"]), float(about["far_m"]))
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from error
    except CameraError as error:
        raise DatasetError(f"{path}: {error}") from error


def _camera(about: dict[str, Any]) -> Camera:
    return Camera(**{**about, "distortion": tuple(about["distortion"])})


def _tensors(one: SceneMap) -> dict[str, NDArray[Any]]:
    images, depths = ([getattr(t, name) for t in one.thumbnails] for name in ("image", "depth"))
    truth = one.truth or Trajectory.empty()
    return {
        "keyframe_ids": one.keyframe_ids,
        "keyframe_times_s": one.keyframes.timestamps_s,
        "keyframe_poses": one.keyframes.T_world_camera,
        "loops": one.loops,
        "points_m": one.points_m.astype(np.float32),
        "gravity": np.zeros(0) if one.gravity_w is None else one.gravity_w,
        "truth_times_s": truth.timestamps_s,
        "truth_m": truth.T_world_camera[:, :3, 3].astype(np.float32),
        "thumbnail_rows": np.array([t.row for t in one.thumbnails], np.int64),
        "images": np.frombuffer(b"".join(images), np.uint8),
        "image_ends": np.cumsum([len(data) for data in images], dtype=np.int64),
        "depths": np.frombuffer(b"".join(depths), np.uint8),
        "depth_ends": np.cumsum([len(data) for data in depths], dtype=np.int64),
    }


def _map(tensors: dict[str, NDArray[Any]], number: int) -> SceneMap:
    def of(name: str) -> NDArray[Any]:
        return tensors[f"{number}/{name}"]

    keyframes = Trajectory(of("keyframe_times_s"), of("keyframe_poses"))
    for name in ("loops", "thumbnail_rows"):
        if (rows := of(name)).size and not 0 <= rows.min() <= rows.max() < len(keyframes):
            raise ValueError(f"{number}/{name} names a keyframe that is not there")
    images = _pieces(of("images"), of("image_ends"))
    depths = _pieces(of("depths"), of("depth_ends"))
    truth_m = of("truth_m")
    poses = np.tile(np.eye(4), (len(truth_m), 1, 1))
    poses[:, :3, 3] = truth_m
    return SceneMap(
        number=number,
        path=Trajectory.empty(),
        keyframe_ids=of("keyframe_ids"),
        keyframes=keyframes,
        loops=of("loops"),
        points_m=of("points_m").astype(np.float64),
        truth=Trajectory(of("truth_times_s"), poses) if len(truth_m) else None,
        gravity_w=of("gravity") if len(of("gravity")) else None,
        thumbnails=tuple(
            Thumbnail(int(row), image, depth)
            for row, image, depth in zip(of("thumbnail_rows"), images, depths, strict=True)
        ),
    )


def _pieces(data: NDArray[np.uint8], ends: NDArray[np.int64]) -> list[bytes]:
    starts = np.concatenate([[0], ends[:-1]]) if len(ends) else ends
    return [data[a:b].tobytes() for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
