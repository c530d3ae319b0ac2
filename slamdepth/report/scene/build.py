# SPDX-License-Identifier: Apache-2.0
"""The scene of a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import invert
from slamdepth.report.keyframe_images import colour_depth, encode_jpeg
from slamdepth.report.scene.model import Scene, SceneMap, Thumbnail
from slamdepth.types import Trajectory
from slamdepth.typing import Bytes, Floats32

if TYPE_CHECKING:
    from slamdepth.evaluation import TrajectoryScore
    from slamdepth.mapping.keyframe import Keyframe
    from slamdepth.mapping.mesh import Mesh
    from slamdepth.mapping.reconstruction import Reconstruction

MOST_THUMBNAILS = 160
"""Keyframes of a scene that have images; more would make a page slow to open."""

_WIDTH_PX = 256
_QUALITY = 78
_MOST_POINTS = 30_000
_RANGE_PERCENT = (1, 97)


def scene_of(
    run: Reconstruction,
    meshes: Sequence[Mesh | None],
    scores: Sequence[TrajectoryScore | None],
    most_thumbnails: int = MOST_THUMBNAILS,
) -> Scene:
    """The scene of a run with its maps.

    Args:
        run: the largest map, with its others.
        meshes, scores: of each map, the largest first; missing ones count as None.
        most_thumbnails: keyframes of all maps together that get images.
    """
    maps = (run, *run.others)
    total = sum(len(one.keyframes) for one in maps)
    chosen = [_spread(len(one.keyframes), most_thumbnails, total) for one in maps]
    shown = [(one.keyframes[row], n, row) for n, one in enumerate(maps) for row in chosen[n]]
    near_m, far_m = _depth_range([keyframe for keyframe, _, _ in shown])
    made = {(n, row): _thumbnail(keyframe, row, near_m, far_m) for keyframe, n, row in shown}
    return Scene(
        tuple(
            _map(
                n,
                one,
                tuple(made[n, row] for row in chosen[n]),
                meshes[n] if n < len(meshes) else None,
                scores[n] if n < len(scores) else None,
            )
            for n, one in enumerate(maps)
        ),
        next((keyframe.frame.camera for one in maps for keyframe in one.keyframes), None),
        near_m,
        far_m,
    )


def _map(
    n: int,
    run: Reconstruction,
    thumbnails: tuple[Thumbnail, ...],
    mesh: Mesh | None,
    score: TrajectoryScore | None,
) -> SceneMap:
    keyframes = run.keyframes
    row = {keyframe.id: k for k, keyframe in enumerate(keyframes)}
    points_m = run.points_m[np.isfinite(run.points_m).all(axis=1)]
    return SceneMap(
        number=n + 1,
        path=run.trajectory,
        keyframe_ids=np.array([keyframe.id for keyframe in keyframes], np.int64),
        keyframes=Trajectory(
            np.array([keyframe.frame.timestamp_s for keyframe in keyframes], np.float64),
            np.array([keyframe.T_world_camera for keyframe in keyframes], np.float64).reshape(-1, 4, 4),
        ),
        loops=np.array([(row[i], row[j]) for i, j in run.loops], np.int64).reshape(-1, 2),
        points_m=points_m[:: max(1, -(-len(points_m) // _MOST_POINTS))],
        truth=_truth(score),
        gravity_w=run.gravity_w,
        thumbnails=thumbnails,
        mesh=mesh if mesh is not None and len(mesh.triangles) else None,
    )


def _truth(score: TrajectoryScore | None) -> Trajectory | None:
    """The ground truth in the world of the map, positions only."""
    if score is None:
        return None
    T_estimate_truth = invert(score.se3.T_truth_estimate)
    poses = np.tile(np.eye(4), (len(score.truth_m), 1, 1))
    poses[:, :3, 3] = score.truth_m @ T_estimate_truth[:3, :3].T + T_estimate_truth[:3, 3]
    return Trajectory(score.timestamps_s, poses)


def _spread(count: int, most: int, total: int) -> list[int]:
    """Rows of a map's share of ``most`` images, evenly spread, the first and the last among them."""
    share = count if total <= most else max(1, most * count // total)
    if count == 0:
        return []
    return sorted(set(np.linspace(0, count - 1, share).round().astype(int).tolist()))


def _depth_range(keyframes: Sequence[Keyframe]) -> tuple[float, float]:
    some = keyframes[:: max(1, len(keyframes) // 12)]
    known = [depth[np.isfinite(depth) & (depth > 0)][::16] for depth in map(_depth, some)]
    values = np.concatenate(known) if known else np.zeros(0)
    if len(values) == 0:
        return 0.0, 1.0
    near_m, far_m = np.percentile(values, _RANGE_PERCENT)
    return float(near_m), float(far_m)


def _depth(keyframe: Keyframe) -> Floats32:
    """The depth that the mesh is made of."""
    return keyframe.load_depth_m() if keyframe.dense is None else keyframe.dense.load().depth_m


def _thumbnail(keyframe: Keyframe, row: int, near_m: float, far_m: float) -> Thumbnail:
    import cv2

    image = keyframe.frame.load().image_rgb
    height, width = image.shape[:2]
    size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(_depth(keyframe), size, interpolation=cv2.INTER_NEAREST)
    return Thumbnail(
        row, _jpeg(np.asarray(small, np.uint8)), _jpeg(colour_depth(np.asarray(depth), near_m, far_m))
    )


def _jpeg(image_rgb: Bytes) -> bytes:
    return encode_jpeg(image_rgb, _QUALITY)
