# SPDX-License-Identifier: Apache-2.0
"""The image files of an export: one JPEG for each view."""

from __future__ import annotations

from pathlib import Path

from slamdepth.errors import ImageDecodeError
from slamdepth.export.images import ExportImages, ImageMode
from slamdepth.export.registry import ExportRequest
from slamdepth.export.tracks import Colours
from slamdepth.mapping.codec import encode_image

FOLDER = "images"


def image_name(number: int) -> str:
    """Name of the image of the ``number``-th view; names sort as views do."""
    return f"frame_{number:06d}.jpg"


def write_images(
    request: ExportRequest, images: ExportImages, folder: Path, colours: Colours | None = None
) -> tuple[int, ...]:
    """Write the image of each view into ``folder/images``, and sample the points' colours.

    Without a recording nothing is written. With one and :attr:`ImageMode.NONE` colours are sampled only.

    Returns:
        Numbers of the views whose image does not decode any more.
    """
    if request.dataset is None:
        return ()
    views = request.scene.views
    is_written = request.mode is not ImageMode.NONE
    if is_written:
        (folder / FOLDER).mkdir()
    missing = []
    for number, view in enumerate(views):
        request.tell(number, len(views))
        if not is_written and colours is None:
            break
        try:
            image_rgb = images.image(view)
        except ImageDecodeError:
            missing.append(number)
            continue
        if colours is not None:
            colours.add(number, image_rgb)
        if is_written:
            (folder / FOLDER / image_name(number)).write_bytes(encode_image(image_rgb).data)
    request.tell(len(views), len(views))
    return tuple(missing)
