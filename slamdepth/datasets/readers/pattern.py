# SPDX-License-Identifier: Apache-2.0
"""A pattern of image names, such as ``walk/img_*.png``: the images that it fits, in natural order."""

from __future__ import annotations

from pathlib import Path

from slamdepth.datasets.image_files import IMAGE_ENDINGS, natural_key
from slamdepth.datasets.readers.images import FolderSequence, ImagesReader
from slamdepth.datasets.registry import register_reader
from slamdepth.errors import DatasetError
from slamdepth.types import Camera

_WILD = ("*", "?", "[")


@register_reader
class PatternReader:
    """Opens patterns of images."""

    name = "pattern"
    needs = "a pattern in quotes, such as 'walk/img_*.png'"

    def matches(self, path: Path) -> bool:
        return any(mark in str(path) for mark in _WILD) and not path.exists()

    def open(self, path: Path, camera: Camera | None) -> FolderSequence:
        parts = path.parts
        first = next(i for i, part in enumerate(parts) if any(mark in part for mark in _WILD))
        folder = Path(*parts[:first]) if first else Path()
        try:
            found = [one for one in folder.glob("/".join(parts[first:])) if one.is_file()]
        except ValueError as error:
            raise DatasetError(f"{path}: no such pattern: {error}") from error
        images = [one for one in found if one.suffix.lower() in IMAGE_ENDINGS]
        if not images:
            raise DatasetError(f"{path}: fits no image ({len(found)} files)")
        places = {one: str(one.relative_to(folder)) for one in images}
        images.sort(key=lambda one: (natural_key(places[one]), places[one]))
        return ImagesReader().open_list(folder, tuple(images), camera)
