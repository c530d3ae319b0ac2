# SPDX-License-Identifier: Apache-2.0
"""Export formats by name: one file each in ``slamdepth/export/formats/``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from slamdepth.errors import ConfigError
from slamdepth.export.images import ExportImages, ImageMode
from slamdepth.export.scene import ExportScene
from slamdepth.registry import Registry

if TYPE_CHECKING:
    from slamdepth.datasets import Dataset

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ExportRequest:
    """What an export is made of.

    Attributes:
        scene: poses, keypoints, points.
        dataset: the recording; None where it is not to be read.
        mode: which images are written; formats without images ignore it.
        tell: called with (images done, images in all).
    """

    scene: ExportScene
    dataset: Dataset | None = None
    mode: ImageMode = ImageMode.UNDISTORTED
    tell: Progress = field(default=lambda done, total: None)

    def images(self) -> ExportImages:
        """The images of the scene and their camera.

        Raises:
            DatasetError: there is no recording although images are asked for, or the camera is unknown.
        """
        return ExportImages(self.scene, self.dataset, self.mode)


class ExportFormat(ABC):
    """Writes a scene as other tools read it.

    Attributes:
        name: of ``--to NAME``.
        about: what it writes, and for which tools, in a line.
        has_images: whether it writes images, so that the recording is needed.
        package: a Python package that it needs and slamdepth does not, with the extra that brings it.
    """

    name: str
    about: str
    has_images: bool = False
    package: tuple[str, str] | None = None

    @abstractmethod
    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        """Write the files into ``folder``, which exists and is empty.

        Returns:
            Lines about the files for the export's ``README.txt``.

        Raises:
            InputError: the run lacks what this format needs.
            OutputError: a file cannot be written.
        """


FORMATS: Registry[ExportFormat] = Registry("export format", package="slamdepth.export.formats")


_FormatType = TypeVar("_FormatType", bound=ExportFormat)


def register_format(format_type: type[_FormatType]) -> type[_FormatType]:
    """Class decorator that makes an :class:`ExportFormat` known by its name."""
    one = format_type()
    FORMATS.add(one.name, one, format_type)
    return format_type


def export_format(name: str) -> ExportFormat:
    """The format called ``name``, whose package is installed.

    Raises:
        ConfigError: there is no such format, or its package is missing.
    """
    import importlib.util

    found = FORMATS.get(name)
    if found.package is not None and importlib.util.find_spec(found.package[0]) is None:
        raise ConfigError(
            f"export to {name}: needs the package '{found.package[0]}': "
            f"pip install 'slamdepth[{found.package[1]}]'"
        )
    return found
