# SPDX-License-Identifier: Apache-2.0
"""The image files of an export: one JPEG for each view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamdepth.errors import ImageDecodeError
from slamdepth.export.images import ExportImages, ImageMode
from slamdepth.export.refine import SmallImages, refine_tracks
from slamdepth.export.registry import ExportRequest
from slamdepth.export.tracks import Colours, Tracks, build_tracks
from slamdepth.mapping.codec import encode_image
from slamdepth.typing import Bytes

FOLDER = "images"


def image_name(number: int) -> str:
    """Name of the image of the ``number``-th view; names sort as views do."""
    return f"frame_{number:06d}.jpg"


@dataclass(frozen=True)
class Written:
    """What was written and found while the images were read.

    Attributes:
        tracks: refined in the images, where there are any; None where the run kept no landmarks.
        colors: ``(P, 3)`` uint8 of their points.
        missing: numbers of the views whose image does not decode any more.
        tracked_error_px: mean reprojection error before the tracks were refined; 0 without tracks.
    """

    tracks: Tracks | None
    colors: Bytes
    missing: tuple[int, ...]
    tracked_error_px: float = 0.0


def write_views(request: ExportRequest, images: ExportImages, folder: Path) -> Written:
    """Write the images into ``folder/images``, and find the points with their colours."""
    scene = request.scene
    if not scene.has_tracks:
        return Written(None, np.zeros((0, 3), np.uint8), _write_images(request, images, folder))
    tracks = build_tracks(scene, images)
    colours, small = Colours(tracks), SmallImages()
    missing = _write_images(request, images, folder, colours, small)
    refined, kept = refine_tracks(scene, images, tracks, small)
    return Written(refined, colours.rgb()[kept], missing, tracks.mean_error_px)


def _write_images(
    request: ExportRequest,
    images: ExportImages,
    folder: Path,
    colours: Colours | None = None,
    small: SmallImages | None = None,
) -> tuple[int, ...]:
    """Write the image of each view, and hand it on.

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
        if small is not None:
            small.add(number, image_rgb)
        if is_written:
            (folder / FOLDER / image_name(number)).write_bytes(encode_image(image_rgb).data)
    request.tell(len(views), len(views))
    return tuple(missing)
