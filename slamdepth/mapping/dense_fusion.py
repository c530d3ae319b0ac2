# SPDX-License-Identifier: Apache-2.0
"""Fusion of keyframes' dense depth into a signed distance field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slamdepth.config import MapConfig
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.patches import Patches
from slamdepth.mapping.signed_distance import SignedDistance, blocks_of, union

_BLOCKS = 10 / 13


def fuse_dense(
    keyframes: Sequence[Keyframe],
    settings: MapConfig,
    voxel_m: float,
    max_blocks: int,
    progress: Callable[[int, int], None] | None,
) -> Any:
    """The surface of all keyframes that have dense depth, as Open3D's ``t.geometry.TriangleMesh``.

    Blocks are laid out first, so that each keyframe also clears the space in front of what others see.

    Args:
        keyframes: with finite poses.
        settings: depth limit.
        voxel_m: edge of a voxel.
        max_blocks: memory limit, in blocks of 8^3 voxels of 10 KB; those of this field have 13 KB.
        progress: called with (keyframes done, keyframes in all).

    Returns:
        The surface, without triangles where there is none; None where it would need too many blocks.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    blocks = np.zeros((0, 3), np.int32)
    for keyframe in keyframes:
        view = _patches(keyframe, settings, voxel_m)
        if view is not None:
            blocks = union([blocks, blocks_of(view, voxel_m)])
            if len(blocks) > _BLOCKS * max_blocks:
                return None
    field = SignedDistance(voxel_m, blocks)
    for k, keyframe in enumerate(keyframes):
        view = _patches(keyframe, settings, voxel_m)
        if view is not None:
            field.add(view)
        if progress is not None:
            progress(k + 1, len(keyframes))
    return field.surface()


def _patches(keyframe: Keyframe, settings: MapConfig, voxel_m: float) -> Patches | None:
    if keyframe.dense is None:
        return None
    return Patches.of(keyframe.dense.load(), keyframe.T_world_camera, voxel_m, settings.max_depth_m)
