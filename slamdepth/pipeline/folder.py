# SPDX-License-Identifier: Apache-2.0
"""The run folder: its place, its files and its log."""

from __future__ import annotations

import logging
import logging.handlers
import shlex
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from slamdepth.errors import OutputError
from slamdepth.export import is_export
from slamdepth.io import results_folder, writable, write_text
from slamdepth.io.text import writing
from slamdepth.mapstore import remove_map
from slamdepth.pipeline import checkpoint
from slamdepth.report.saved_run import map_folder

FILES = {
    "trajectory.txt": "every frame placed in the largest map, after optimisation (TUM, camera to world)",
    "trajectory_online.txt": "each frame's pose as it was first placed, written during the run, also where "
    "it was withdrawn later; a comment line says where another map, and so another world frame, begins",
    "keyframes.txt": "the keyframes of trajectory.txt",
    "depth_scale.yaml": "the scale fitted to the sequence's own sensor (--depth-scale groundtruth)",
    "mesh.ply": "mesh of the largest map, with colours and normals, in the frame of its first camera, metres",
    "cloud.ply": "points in the same frame that a sensor or several views measured, with colours and normals",
    "mesh.png": "the mesh as a whole with the camera's path, and over the camera's shoulder",
    "report.html": "the run in 3D, figures and plots; opens in any browser, needs nothing else",
    "report.json": "the same figures for programs",
    "scene.safetensors": "what 'slamdepth view' and 'slamdepth render' show besides mesh, cloud and path",
    "config.yaml": "the settings used, for --config; images and camera are not among them",
    "log.txt": "what happened, in detail",
    "README.txt": "this list, and the command for the same run again",
}
"""What each file of a run folder holds."""

MAP = "map"
"""Folder of the map, for ``slamdepth localize --map`` and ``slamdepth run --map``."""

MAP_CONTENT = "keyframes, landmarks, places and graph, for 'slamdepth localize --map' and 'run --map'"

MAPS = "maps/"
"""Folder of the maps that never met the largest one: ``maps/2/``, ``maps/3/``, ..."""

MAPS_CONTENT = (
    "2/, 3/, ...: trajectory.txt, keyframes.txt, mesh.ply and cloud.ply of each map that never met the "
    "largest; every map has its own world frame and its own scale"
)
"""What :data:`MAPS` holds."""

EXPORTS = "export/"
"""Folder of the exports: ``export/colmap/``, ..."""

EXPORTS_CONTENT = "colmap/, tum/, ...: what --export or 'slamdepth export' wrote; each has a README.txt"
"""What :data:`EXPORTS` holds."""

_MAP_FILES = ("trajectory.txt", "keyframes.txt", "mesh.ply", "cloud.ply")

_README = "README.txt"
_MARK = "A run of slamdepth"
_COMMAND = ("slamdepth", "run")


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run's results. Nothing is written before :meth:`create`.

    Attributes:
        path: the folder.
        replaces: True where it holds an earlier run, whose files are to be removed.
    """

    path: Path
    replaces: bool = False

    @classmethod
    def plan(cls, output: Path | None, sequence_name: str, *, overwrite: bool) -> RunFolder:
        """Choose and check the folder.

        Raises:
            OutputError: it is a file, holds something already, or cannot be written.
        """
        if output is None:
            stem = f"{sequence_name}-{time.strftime('%Y%m%d-%H%M%S')}"
            path = Path("runs") / stem
            number = 2
            while path.exists():
                path = Path("runs") / f"{stem}-{number}"
                number += 1
            return cls(writable(path))
        path = results_folder(Path(output), is_run, "run", overwrite=overwrite)
        return cls(path, replaces=path.is_dir() and any(path.iterdir()))

    def check_keeps(self, paths: Iterable[Path]) -> None:
        """Refuse to replace an earlier run whose map or export this run reads.

        Raises:
            OutputError: one of ``paths`` lies in what :meth:`create` removes.
        """
        if not self.replaces:
            return
        removed = [(self.path / name).resolve() for name in (MAP, MAPS, EXPORTS)]
        for path in paths:
            place = path.expanduser().resolve()
            if any(place.is_relative_to(folder) for folder in removed):
                raise OutputError(
                    f"{self.path}: this run reads {path}, which would be removed with the run there; name "
                    "another folder"
                )

    def create(self, arguments: Sequence[str] = ()) -> None:
        """Make the folder, without the files of an earlier run, and its README.

        Args:
            arguments: of ``slamdepth run``, those that ``config.yaml`` does not hold; the README gives the
                command for the same run again.

        Raises:
            OutputError: it cannot be written.
        """
        make_folder(self.path)
        if self.replaces:
            with writing(self.path):
                self._remove_files()
        width = max(map(len, FILES))
        content = {**FILES, f"{MAP}/": MAP_CONTENT, MAPS: MAPS_CONTENT, EXPORTS: EXPORTS_CONTENT}
        lines = [f"{name:<{width}}  {what}" for name, what in content.items()]
        head = f"{_MARK}. A file that is missing was not asked for, or the run was killed before it.\n\n"
        if arguments:
            command = shlex.join([*_COMMAND, *arguments, "--config", str(self.path / "config.yaml")])
            lines += ["", "The same run again, from the folder this one was started in:", f"  {command}"]
        write_text(self.path / _README, head + "\n".join(lines) + "\n")

    def discard(self) -> None:
        """Remove our files, and the folder where nothing else is in it."""
        with suppress(OSError):
            self._remove_files()
            self.path.rmdir()

    def make_map_folder(self, number: int) -> Path:
        """Make the folder of a map, and return it.

        Args:
            number: counted from 1 for the largest map, whose folder is the run's.

        Raises:
            OutputError: it cannot be written.
        """
        folder = map_folder(self.path, number)
        make_folder(folder)
        return folder

    def _remove_files(self) -> None:
        """Remove our files; folders of maps only where nothing else is in them, and never through a link."""
        for name in FILES:
            (self.path / name).unlink(missing_ok=True)
        exports = self.path / EXPORTS
        if exports.is_dir() and not exports.is_symlink():
            for folder in sorted(exports.iterdir()):
                if is_export(folder):
                    shutil.rmtree(folder)
            _remove_if_empty(exports)
        remove_map(self.path / MAP)
        checkpoint.remove(self.path)
        maps = self.path / MAPS
        if maps.is_symlink() or not maps.is_dir():
            return
        for folder in sorted(maps.iterdir()):
            if folder.name.isdecimal() and folder.is_dir() and not folder.is_symlink():
                for name in _MAP_FILES:
                    (folder / name).unlink(missing_ok=True)
                remove_map(folder / MAP)
                _remove_if_empty(folder)
        _remove_if_empty(maps)

    def __truediv__(self, name: str) -> Path:
        return self.path / name


@contextmanager
def run_log() -> Iterator[logging.handlers.MemoryHandler]:
    """Collect slamdepth's messages of every level; :func:`write_log_to` gives them a file."""
    package = logging.getLogger("slamdepth")
    level = package.level
    # Kept in memory until there is a run folder: bad input must not leave one behind.
    buffer = logging.handlers.MemoryHandler(capacity=10_000, flushLevel=logging.CRITICAL + 1)
    buffer.setLevel(logging.DEBUG)
    package.addHandler(buffer)
    package.setLevel(logging.DEBUG)
    try:
        yield buffer
    finally:
        package.removeHandler(buffer)
        package.setLevel(level)
        target = buffer.target
        buffer.close()
        if target is not None:
            target.close()


def write_log_to(buffer: logging.handlers.MemoryHandler, path: Path, *, goes_on: bool = False) -> None:
    """Write the messages so far and all later ones to ``path``.

    Args:
        goes_on: behind those of an earlier process.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    with writing(path):
        file = logging.FileHandler(path, mode="a" if goes_on else "w", encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
    buffer.setTarget(file)
    buffer.flush()
    buffer.flushLevel = logging.DEBUG  # from now on line by line, so that a killed run leaves its log


def is_run(path: Path) -> bool:
    """True where ``path`` is the folder of a run, finished or not."""
    try:
        return (path / _README).read_text(encoding="utf-8").startswith(_MARK)
    except (OSError, UnicodeDecodeError):
        return False


def as_argument(path: str) -> str:
    """A path as an argument of a command: one that begins with a dash would be an option."""
    return f"./{path}" if path.startswith("-") else path


def recorded_arguments(path: Path) -> list[str]:
    """The arguments of the command that made a run, the sequence first; none where its README has no command.

    Relative paths are relative to the folder that the run was started in.
    """
    try:
        lines = (path / _README).read_text(encoding="utf-8").splitlines()
        words = [shlex.split(line) for line in lines if line.strip().startswith(" ".join(_COMMAND))]
    except (OSError, ValueError):
        return []
    return words[-1][len(_COMMAND) :] if words else []


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()


def writable_folder(path: Path) -> Path:
    """``path``, if it is a folder that can be written or can become one.

    Raises:
        OutputError: it is a file or cannot be written.
    """
    path = path.expanduser()
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file; name a folder for the results")
    return writable(path)


def make_folder(path: Path) -> None:
    """Make the folder ``path`` and those above it, where they are missing.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
