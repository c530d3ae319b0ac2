# SPDX-License-Identifier: Apache-2.0
"""Text and JSON files, and the way every file is written: whole or not at all."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError, InputError, OutputError

_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of what is written, whichever file they name: that of a copy names the one that is copied."""


def read_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a list file that say something, with their numbers from 1.

    A byte order mark, CRLF, blank lines and ``#`` comments are taken out; lines come
    stripped.

    Raises:
        DatasetError: the file cannot be read.
    """
    return [(number, line) for number, line in read_commented_lines(path) if not line.startswith("#")]


def read_commented_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a list file and its ``#`` comments, with their numbers from 1.

    A byte order mark, CRLF and blank lines are taken out; lines come stripped.

    Raises:
        DatasetError: the file cannot be read.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    # Not str.splitlines: it also breaks at form feeds and the like, and editors don't count those.
    stripped = ((number, line.strip()) for number, line in enumerate(re.split(r"\r\n|\r|\n", text), 1))
    return [(number, line) for number, line in stripped if line]


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        DatasetError: the file cannot be read or is no JSON; names the line.
    """
    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    except json.JSONDecodeError as error:
        raise DatasetError(f"{path}:{error.lineno}: not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:  # no UTF-8, too many digits, too deeply nested
        raise DatasetError(f"{path}: not valid JSON: {error}") from error


def parse_float(text: str) -> float:
    """``float(text)`` without Python's ``1_000``, which no data file means.

    Raises:
        ValueError: ``text`` is no number.
    """
    if "_" in text:
        raise ValueError(f"not a number: {text!r}")
    return float(text)


@contextmanager
def writing(path: str | Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn what the system says against writing to ``path`` into one clear error.

    Args:
        temporary: where it is written first.

    Raises:
        OutputError: the block raised an OSError.
        InputError: it raised one of another file, which could not be read.
    """
    try:
        yield
    except OSError as error:
        why, source = error.strerror or error, error.filename
        if isinstance(source, str) and error.errno not in _OF_THE_DISK:
            place = Path(source).absolute()
            own = [Path(path).absolute(), *([] if temporary is None else [temporary])]
            if not any(place.is_relative_to(one) or one.is_relative_to(place) for one in own):
                raise InputError(f"{source}: cannot be read: {why}") from error
        raise OutputError(f"{path}: cannot be written: {why}") from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path with the same ending, moved to ``path`` when the block succeeds.

    Raises:
        OutputError: ``path`` cannot be written; nothing is left behind.
        InputError: another file cannot be read; the same.
    """
    place = Path(path).absolute()
    temporary = place.with_name(f".{place.stem}.{secrets.token_hex(4)}.partial{place.suffix}")
    try:
        with writing(path, temporary):
            yield temporary
            os.replace(temporary, place)
    finally:
        with suppress(OSError):  # such as a folder that is no folder: that error is on its way
            temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(folder: str | Path) -> Iterator[Path]:
    """A new folder beside ``folder``, which takes its place when the block succeeds.

    Raises:
        OutputError: ``folder`` cannot be written; what was there stays, and nothing else is left behind.
        InputError: a file elsewhere cannot be read; the same.
    """
    place = Path(folder).absolute()
    made = list(takewhile(lambda above: not above.exists(), place.parents))
    partial = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
    before = partial.with_suffix(".before")
    try:
        with writing(folder, partial):
            partial.mkdir(parents=True)
            yield partial
            if place.exists():
                os.replace(place, before)
            os.replace(partial, place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):
            if not place.exists():
                os.replace(before, place)
            elif before.is_symlink():
                before.unlink()
            else:
                shutil.rmtree(before, ignore_errors=True)
        with suppress(OSError):  # one with something in it stays
            for above in made if not place.exists() else ():
                above.rmdir()


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` as UTF-8, whole or not at all.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(text.encode("utf-8", errors="backslashreplace"))
        file.flush()
        os.fsync(file.fileno())


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON, whole or not at all.

    NumPy scalars and arrays, paths, enums, sets and tuples become what JSON has; NaN and
    infinities become null, since JSON has neither.

    Raises:
        OutputError: ``path`` cannot be written.
        TypeError: ``value`` holds something with no meaning in JSON.
    """
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """``value`` as indented JSON, as :func:`write_json` writes it.

    Raises:
        TypeError: ``value`` holds something with no meaning in JSON.
    """
    return json.dumps(_jsonable(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _jsonable(value: Any) -> Any:
    if isinstance(value, Enum):
        return _jsonable(value.value)
    if isinstance(value, np.ndarray | np.generic):
        return _jsonable(value.tolist())
    if isinstance(value, dict):
        return {str(_jsonable(key)): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(_jsonable(item) for item in value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
