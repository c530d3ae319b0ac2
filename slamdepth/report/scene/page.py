# SPDX-License-Identifier: Apache-2.0
"""The 3D view of a page: its data, its scripts, and what allows those and no other ones."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Sequence
from importlib import resources
from typing import Any

from slamdepth.errors import SlamdepthError
from slamdepth.report.scene.model import Scene
from slamdepth.report.scene.page_data import scene_json, with_small_meshes
from slamdepth.report.scene.three import three_js

logger = logging.getLogger(__name__)


def scene_content(scene: Scene | None) -> dict[str, Any]:
    """What ``run_scene.html.j2`` and ``base.html.j2`` need of a scene; of None, and of an empty one, nothing.

    A page without three.js has no 3D view, and a warning is logged.
    """
    nothing = {"scene": None, "scene_data": "", "scene_caption": "", "scripts": (), "script_hashes": ""}
    if scene is None or not any(len(one.path) for one in scene.maps):
        return nothing
    try:
        small = with_small_meshes(scene)
        scripts = (three_js(), _own_script())
    except SlamdepthError as error:
        logger.warning("the page has no 3D view: %s", error)
        return nothing
    return {
        "scene": small,
        "scene_data": scene_json(small),
        "scene_caption": _caption(scene, small),
        "scripts": scripts,
        "script_hashes": script_hashes(scripts),
    }


def script_hashes(scripts: Sequence[str]) -> str:
    """Sources of a Content-Security-Policy that allow these scripts and no other."""
    digests = (hashlib.sha256(script.encode("utf-8")).digest() for script in scripts)
    return " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)


def _own_script() -> str:
    return (resources.files("slamdepth.report") / "templates/scene.js").read_text(encoding="utf-8")


def _caption(whole: Scene, small: Scene) -> str:
    keyframes = sum(len(one.keyframe_ids) for one in whole.maps)
    images = sum(len(one.thumbnails) for one in whole.maps)
    triangles = [
        sum(len(one.mesh.triangles) for one in scene.maps if one.mesh is not None) for scene in (whole, small)
    ]
    parts = ["Walls and ceilings are left out where they are seen from behind."]
    if triangles[1] < triangles[0]:
        parts.append(f"The mesh is thinned out to {triangles[1]:,} of its {triangles[0]:,} triangles.")
    if 0 < images < keyframes:
        parts.append(f"The slider has {images} of the {keyframes:,} keyframes, evenly spread.")
    if len(whole.maps) > 1:
        parts.append("Maps that never met have no common frame, so one is shown at a time.")
    return " ".join(parts)
