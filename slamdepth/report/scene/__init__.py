# SPDX-License-Identifier: Apache-2.0
"""What a run looks like in 3D: mesh, path, keyframes with their images, loops, several maps."""

from __future__ import annotations

from slamdepth.report.scene.build import scene_of
from slamdepth.report.scene.file import SCENE_FILE, read_scene, write_scene
from slamdepth.report.scene.model import Scene, SceneMap, Thumbnail
from slamdepth.report.scene.page_data import scene_json, with_small_meshes
from slamdepth.report.scene.three import three_js

__all__ = [
    "SCENE_FILE",
    "Scene",
    "SceneMap",
    "Thumbnail",
    "read_scene",
    "scene_json",
    "scene_of",
    "three_js",
    "with_small_meshes",
    "write_scene",
]
