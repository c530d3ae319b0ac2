# SPDX-License-Identifier: Apache-2.0
"""The folder of depth maps: where each file lies, and what is done already."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slamdepth.errors import ConfigError, OutputError
from slamdepth.io import writable, write_json, write_text
from slamdepth.io.text import writing
from slamdepth.pipeline.folder import make_folder
from slamdepth.types import DepthKind

ABOUT = "depth.json"
JOURNAL = "frames.jsonl"
README = "README.txt"
VIDEO = "side-by-side.mp4"
_MARK = "Depth maps by slamdepth"

COLOUR, MILLIMETRES, VALUES, CLOUD = "colour", "depth-mm", "values", "cloud"
_VALUES_NAMES = {
    DepthKind.METRIC: "depth-metres",
    DepthKind.AFFINE_DEPTH: "relative-depth",
    DepthKind.AFFINE_INVERSE_DEPTH: "relative-inverse-depth",
}
_EXPLAINED = {
    "colour.png": "the map in colour, dark blue near to yellow far, above a scale bar",
    "depth-mm.png": "16 bits, millimetres, 0 = unknown or beyond 65.535 m",
    "depth-metres.npy": "float32 (rows, columns), metres along the optical axis, 0 = unknown",
    "relative-depth.npy": "float32 (rows, columns), no unit: scale and offset unknown; large is far",
    "relative-inverse-depth.npy": "float32 (rows, columns), no unit: scale and offset unknown; large is near",
    "cloud.ply": "coloured points in metres, camera frame: x right, y down, z forward",
}


@dataclass
class DepthFolder:
    """The folder of one source's depth maps.

    Attributes:
        path: the folder.
        is_flat: True for the files of one image; otherwise each kind of file has a folder of its own.
        about: the content of ``depth.json``; empty in a new folder.
        frames: the journal's entry of each finished shot, by its name.
    """

    path: Path
    is_flat: bool
    about: dict[str, Any] = field(default_factory=dict)
    frames: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def plan(cls, output: Path | None, source_name: str, *, is_flat: bool) -> DepthFolder:
        """Choose and check the folder, and read what is there already; nothing is written.

        Raises:
            OutputError: it is a file, holds something else, or cannot be written.
        """
        path = Path("depth") / source_name if output is None else Path(output).expanduser()
        try:
            if path.exists() and not path.is_dir():
                raise OutputError(f"{path}: is a file; name a folder for the depth maps")
            if not (path.is_dir() and any(path.iterdir())):
                return cls(writable(path), is_flat)
        except OSError as error:
            raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from error
        if not _is_ours(path):
            raise OutputError(f"{path}: is not empty and holds no earlier depth maps; name a new folder")
        return cls(writable(path), is_flat, _read_about(path / ABOUT), _read_journal(path / JOURNAL))

    def check_same(self, settings: dict[str, Any]) -> None:
        """Make sure that what is here was made with ``settings``.

        Raises:
            ConfigError: it was not; names the first setting that differs, its two values, and what to do.
        """
        before = self.about.get("settings")
        if before is None:
            return
        now = json.loads(json.dumps(settings))
        for name in dict.fromkeys((*now, *before)):
            if before.get(name) != now.get(name):
                raise ConfigError(
                    f"{self.path}: holds depth maps made with '{name}' {_short(before.get(name))}, now "
                    f"{_short(now.get(name))}; name another --output, or add --overwrite"
                )

    def clear(self) -> None:
        """Remove our files of an earlier time.

        Raises:
            OutputError: one cannot be removed.
        """
        with writing(self.path):
            for name in (VIDEO, JOURNAL, ABOUT):
                (self.path / name).unlink(missing_ok=True)
            for ending in _EXPLAINED:
                for folder in (self.path, self.path / Path(ending).stem):
                    for file in folder.glob(f"*.{ending}"):
                        file.unlink()
                with suppress(OSError):  # not there, or it holds other files
                    (self.path / Path(ending).stem).rmdir()
        self.about, self.frames = {}, {}

    def discard(self) -> None:
        """Remove our files, and the folder where nothing else is in it."""
        with suppress(OSError, OutputError):
            self.clear()
            (self.path / README).unlink(missing_ok=True)
            self.path.rmdir()

    def open(self, kinds: list[str], kind: DepthKind) -> None:
        """Make the folder, those of its files of ``kinds``, and an orderly journal.

        Raises:
            OutputError: it cannot be written.
        """
        make_folder(self.path)
        with writing(self.path):
            for file_kind in kinds:
                self.place(file_kind, "x", kind).parent.mkdir(exist_ok=True)
        self.write_readme([f"{_MARK}, not finished yet: the same command goes on."], [])
        # A kill may have cut the last line.
        write_text(self.path / JOURNAL, "".join(_line(entry) for entry in self.frames.values()))

    def place(self, file_kind: str, name: str, kind: DepthKind) -> Path:
        """Where the file of ``file_kind`` of the shot ``name`` belongs."""
        ending = file_name(file_kind, kind)
        folder = self.path if self.is_flat else self.path / Path(ending).stem
        return folder / f"{name}.{ending}"

    def record(self, entry: dict[str, Any]) -> None:
        """Note in the journal that the shot ``entry["name"]`` is done; all its files must be there.

        Raises:
            OutputError: the journal cannot be written.
        """
        path = self.path / JOURNAL
        with writing(path), path.open("ab", buffering=0) as file:
            file.write(_line(entry).encode("utf-8"))
        self.frames[entry["name"]] = json.loads(_line(entry))

    def write_about(self, about: dict[str, Any]) -> None:
        """Write ``depth.json``."""
        write_json(self.path / ABOUT, about)
        self.about = json.loads((self.path / ABOUT).read_text(encoding="utf-8"))

    def write_readme(self, head: list[str], kinds: list[str], kind: DepthKind = DepthKind.METRIC) -> None:
        """Write ``README.txt``: what the folder is, and what each file holds."""
        files = {f"NAME.{file_name(k, kind)}": _EXPLAINED[file_name(k, kind)] for k in kinds}
        if (self.path / VIDEO).exists():
            files[VIDEO] = "image and colour map side by side, one range of colours throughout"
        files[ABOUT] = "model, weights, unit, intrinsics and notes, for programs"
        files[JOURNAL] = "a line for each image: its origin, camera and range of values"
        width = max(map(len, files))
        lines = [*head, "", *(f"{name:<{width}}  {what}" for name, what in files.items())]
        write_text(self.path / README, "\n".join(lines) + "\n")


def file_name(file_kind: str, kind: DepthKind) -> str:
    """The part of a file's name after the shot's, which says what its numbers are."""
    if file_kind == VALUES:
        return f"{_VALUES_NAMES[kind]}.npy"
    return f"{file_kind}.ply" if file_kind == CLOUD else f"{file_kind}.png"


def readme_head(title: str) -> str:
    """The first line of a finished folder's README."""
    return f"{_MARK} of {title}"


def _is_ours(path: Path) -> bool:
    try:
        return (path / README).read_text(encoding="utf-8").startswith(_MARK)
    except (OSError, UnicodeDecodeError):
        return False


def _read_about(path: Path) -> dict[str, Any]:
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: damaged ({error}); add --overwrite or name another --output") from error
    return about if isinstance(about, dict) else {}


def _read_journal(path: Path) -> dict[str, dict[str, Any]]:
    """Entries by name; a line that is no entry, such as one that a kill cut, is ignored."""
    frames: dict[str, dict[str, Any]] = {}
    try:
        text = path.read_bytes().decode("utf-8", errors="replace")
    except FileNotFoundError:
        return frames
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from error
    for line in text.split("\n"):
        with suppress(ValueError):
            entry = json.loads(line)
            if isinstance(entry, dict) and isinstance(entry.get("name"), str):
                frames[entry["name"]] = entry
    return frames


def _line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, ensure_ascii=False, allow_nan=False) + "\n"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
