# SPDX-License-Identifier: Apache-2.0
"""The output file of a training, checked before anything is computed."""

from __future__ import annotations

from pathlib import Path

from slamdepth.depth.head import FORMAT
from slamdepth.depth.layout import unpack_about
from slamdepth.errors import OutputError
from slamdepth.io import writable
from slamdepth.training.config import TrainConfig

ENDING = ".safetensors"


def output_path(config: TrainConfig) -> Path:
    """The head file, with ``~`` expanded.

    Raises:
        OutputError: there is no such user.
    """
    try:
        return Path(config.output).expanduser()
    except RuntimeError as error:
        raise OutputError(f"{config.output}: {error}; name the folder in full") from error


def check_output(config: TrainConfig) -> Path:
    """The head file, with ``~`` expanded, if a head can be written there; nothing is made yet.

    An existing head may be replaced, no other file.

    Raises:
        OutputError: it is a folder, has another ending, is a file but no head, or its folder
            cannot be written or made.
    """
    path = output_path(config)
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; name a {ENDING} file for the head in setting 'output'")
        if path.suffix.lower() != ENDING:
            raise OutputError(f"{path}: a head's file ends in {ENDING}; name one in setting 'output'")
        if path.exists() and not _is_head(path):
            raise OutputError(f"{path}: is there already and no depth head; name another file in 'output'")
        writable(path.parent if path.exists() else path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def _is_head(path: Path) -> bool:
    """True if the header names a depth head of any format version."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            kind = unpack_about(file.metadata()).get("format", "")
    except (SafetensorError, OSError):
        return False
    return kind.startswith(FORMAT.rpartition("-")[0] + "-")
