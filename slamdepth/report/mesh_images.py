# SPDX-License-Identifier: Apache-2.0
"""Images of the finished mesh: as a whole, and from behind the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import invert, project, transform
from slamdepth.io import write_png
from slamdepth.mapping.raycast import render_mesh
from slamdepth.report.gaps import gap_ends
from slamdepth.report.keyframe_images import colour_depth
from slamdepth.report.viewpoints import from_above, guessed_gravity, ideal_camera, over_the_shoulder
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.mesh import Mesh
    from slamdepth.mapping.reconstruction import Reconstruction
    from slamdepth.types import Camera, Trajectory

WIDTH, HEIGHT = 900, 600
BACKGROUND = (205, 211, 219)
_PATH, _CASING = (23, 105, 212), (255, 255, 255)
_SUBPIXELS = 4  # bits
_STRIPE = 8  # pixels

WORST_M = 0.1
ERROR_COLOURS = f"dark blue 0, green to yellow {100 * WORST_M:g} cm or more, grey not judged"
"""How errors are drawn."""


@dataclass(frozen=True)
class MeshImage:
    """One view of a mesh.

    Attributes:
        title: what is seen, in a few words.
        caption: what else one needs to read it.
        image_rgb: ``(H, W, 3)`` uint8.
    """

    title: str
    caption: str
    image_rgb: NDArray[np.uint8]


def render_mesh_images(mesh: Mesh, run: Reconstruction) -> tuple[MeshImage, ...]:
    """Views of ``mesh``; none where it has no triangle or ``run`` no pose.

    Up is against gravity. Where ``run`` has no gravity it is guessed from how the camera was held, and
    the caption says so.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    poses = run.trajectory.T_world_camera
    if len(mesh.triangles) == 0 or len(poses) == 0:
        return ()
    gravity_w = _gravity(run)
    level = (
        "upright by gravity"
        if run.gravity_w is not None
        else "which way is up is guessed from how the camera was held"
    )
    wide, T = overview(mesh, poses, gravity_w)
    whole = render_mesh(mesh, wide, T, BACKGROUND)
    images = [
        MeshImage(
            "The whole mesh, from above and behind the camera",
            f"The path of the camera is blue, with a dot at its start; {level}. Surfaces seen from behind "
            "are left out, so that one looks through walls and ceilings into the room. Nothing is drawn "
            "where no keyframe saw a surface.",
            _with_path(whole, run.trajectory, wide, T),
        )
    ]
    near = ideal_camera(WIDTH, HEIGHT, 65.0)
    if (behind := over_the_shoulder(mesh, poses, gravity_w, near)) is not None:
        images.append(
            MeshImage(
                "Over the camera's shoulder",
                "A step behind that place of the path from which most of the mesh is seen; to be compared "
                "with the images.",
                render_mesh(mesh, near, behind, BACKGROUND),
            )
        )
    return tuple(images)


def render_errors(mesh: Mesh, errors_m: Floats, run: Reconstruction) -> tuple[MeshImage, ...]:
    """The whole mesh coloured by its distance to a reference; none where ``run`` has no pose.

    Args:
        errors_m: ``(V,)`` of each vertex, NaN where it cannot be judged.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    poses = run.trajectory.T_world_camera
    if len(mesh.triangles) == 0 or len(poses) == 0:
        return ()
    wide, T = overview(mesh, poses, _gravity(run))
    colours = error_colours(errors_m).astype(np.float32) / np.float32(255.0)
    image = render_mesh(replace(mesh, colors=colours), wide, T, BACKGROUND)
    return (
        MeshImage(
            "The error of the mesh",
            f"Distance to what the sensor saw, after alignment of the poses: {ERROR_COLOURS}.",
            image,
        ),
    )


def overview(mesh: Mesh, poses: Floats, gravity_w: Floats) -> tuple[Camera, Floats]:
    """A camera that sees the mesh from above and behind cameras ``(N, 4, 4)``, and its pose ``(4, 4)``."""
    wide = ideal_camera(WIDTH, HEIGHT, 50.0)
    return wide, from_above(mesh, poses[:, :3, 3], gravity_w, wide)


def _gravity(run: Reconstruction) -> Floats:
    """Direction of gravity in the world frame, guessed where the run has none."""
    return guessed_gravity(run.trajectory.T_world_camera) if run.gravity_w is None else run.gravity_w


def error_colours(errors_m: Floats) -> NDArray[np.uint8]:
    """Colours ``(V, 3)`` RGB of distances ``(V,)``, as :data:`ERROR_COLOURS` says; NaN is not judged."""
    colours = colour_depth(errors_m[None], 0.0, WORST_M, np.isfinite(errors_m)[None])
    return np.asarray(colours[0], np.uint8)


def write_mesh_png(path: Path, images: tuple[MeshImage, ...]) -> None:
    """Write the images side by side, a white stripe between them.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    write_side_by_side(path, [image.image_rgb for image in images])


def write_side_by_side(path: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    """Write images ``(H, W, 3)`` RGB of one height side by side, a white stripe between them.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    stripe = np.full((images[0].shape[0], _STRIPE, 3), 255, np.uint8)
    row = [part for image in images for part in (stripe, image)]
    write_png(path, np.hstack(row[1:]))


def _with_path(
    image_rgb: NDArray[np.uint8], trajectory: Trajectory, camera: Camera, T_world_camera: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The image with the path drawn over it, broken where frames were lost."""
    import cv2

    px, _ = project(camera, transform(invert(T_world_camera), trajectory.T_world_camera[:, :3, 3]))
    px = np.round(np.clip(px, -1e4, 1e4) * 2**_SUBPIXELS).astype(np.int32)
    drawn: NDArray[np.uint8] = image_rgb.copy()
    parts = [part[:, None] for part in np.split(px, gap_ends(trajectory.timestamps_s)) if len(part) > 1]
    for colour, width in ((_CASING, 5), (_PATH, 2)):
        cv2.polylines(drawn, parts, False, colour, width, cv2.LINE_AA, _SUBPIXELS)
    for colour, radius in ((_CASING, 7), (_PATH, 5)):
        cv2.circle(drawn, px[0].tolist(), radius << _SUBPIXELS, colour, -1, cv2.LINE_AA, _SUBPIXELS)
    return drawn
