# SPDX-License-Identifier: Apache-2.0
"""An export's folder: written whole or not at all, with a README."""

from __future__ import annotations

from pathlib import Path

from slamdepth.datasets.virtual_view import ViewedSequence
from slamdepth.errors import InputError
from slamdepth.export.images import ImageMode
from slamdepth.export.registry import ExportRequest, export_format
from slamdepth.io import results_folder, write_text
from slamdepth.io.text import replacing_folder

README = "README.txt"
_MARK = "An export of slamdepth"


def write_export(request: ExportRequest, name: str, folder: Path, *, overwrite: bool = False) -> Path:
    """Write a scene in the format called ``name`` into ``folder``.

    Args:
        overwrite: an earlier export in ``folder`` may be replaced.

    Returns:
        The folder.

    Raises:
        ConfigError: there is no such format, or a package that it needs is missing.
        InputError: the run lacks what the format needs.
        OutputError: the folder holds something else, or cannot be written.
    """
    kind = export_format(name)
    if kind.has_images and not request.scene.views:
        raise InputError(
            "this run has no keyframe to export, since the map that it went on from had all it needed: "
            "'slamdepth export RUN --every-frame' takes its frames"
        )
    folder = check_place(folder, overwrite=overwrite).absolute()
    with replacing_folder(folder) as partial:
        lines = kind.write(request, partial)
        write_text(partial / README, _readme(request, name, kind.about, kind.has_images, lines))
    return folder


def check_place(folder: Path, *, overwrite: bool = False) -> Path:
    """``folder``, if an export can be written there.

    Raises:
        OutputError: it is a file, holds something already, or cannot be written.
    """
    return results_folder(folder, is_export, "export", overwrite=overwrite)


def is_export(folder: Path) -> bool:
    """True where ``folder`` holds what :func:`write_export` wrote."""
    try:
        is_ours = (folder / README).read_text(encoding="utf-8").startswith(_MARK)
    except (OSError, UnicodeDecodeError):
        return False
    return is_ours and not folder.is_symlink()


def _readme(request: ExportRequest, name: str, about: str, has_images: bool, lines: tuple[str, ...]) -> str:
    scene = request.scene
    text = [f"{_MARK} of '{scene.name}' to {name}: {about}.", "", *lines, ""]
    if has_images:
        text += [_about_images(request), ""]
    if scene.gravity_w is None:
        gravity = "The direction of gravity is not known."
    else:
        gravity = "Gravity in the world frame: " + " ".join(f"{x:.6f}" for x in scene.gravity_w) + "."
    text += [
        "World frame of the run: that of its first camera, x right, y down, z forward. " + gravity,
        f"Unit: metres of the run. Scale: {scene.scale}",
    ]
    return "\n".join(text) + "\n"


def _about_images(request: ExportRequest) -> str:
    if request.mode is ImageMode.RAW and isinstance(request.dataset, ViewedSequence):
        return (
            f"Images: as the run used them, which is not as they were taken: {request.dataset.view.note}. "
            "The camera is the pinhole of these views; a rolling shutter is not corrected."
        )
    return _IMAGES[request.mode]


_IMAGES = {
    ImageMode.UNDISTORTED: "Images: without lens distortion and, where the run found one, rolling shutter; "
    "cropped to where every pixel has a source. The camera is a pinhole.",
    ImageMode.RAW: "Images: as they were taken. The camera has the lens distortion; a rolling shutter is not "
    "corrected.",
    ImageMode.NONE: "Images: none; the camera is that of undistorted images.",
}
