# SPDX-License-Identifier: Apache-2.0
"""Arrays by name in safetensors files: no code is in them, and the same arrays give the same bytes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.io.text import replacing

if TYPE_CHECKING:
    from numpy.typing import NDArray


def encode_tensors(
    arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any] | None = None, key: str = "about"
) -> bytes:
    """Arrays of one or more dimensions as the bytes of a safetensors file.

    Args:
        about: what JSON can hold; stored in the header.
        key: of the header's entry that holds it.
    """
    from safetensors.numpy import save

    contiguous = {name: np.ascontiguousarray(array) for name, array in sorted(arrays.items())}
    text = None if about is None else {key: json.dumps(about, sort_keys=True)}
    return bytes(save(contiguous, metadata=text))


def decode_tensors(data: bytes, key: str = "about") -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """What :func:`encode_tensors` was given; the arrays may be written.

    Args:
        key: as it was given; without such an entry, nothing is known about the arrays.

    Raises:
        ValueError: the bytes are no such file.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(data)
        length = int.from_bytes(data[:8], "little")
        text = json.loads(data[8 : 8 + length]).get("__metadata__", {}).get(key)
        about = {} if text is None else json.loads(text)
    except (SafetensorError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise ValueError(f"no safetensors file: {error}") from error
    return arrays, about


def write_bytes(path: Path, data: bytes) -> str:
    """Write ``data``, whole or not at all, and wait for the disk; returns its SHA-256 checksum.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return hashlib.sha256(data).hexdigest()


def read_checked(path: Path, sha256: str) -> bytes:
    """The bytes of a file whose checksum is known.

    Raises:
        DatasetError: it is missing, cannot be read, or has other bytes.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: is missing") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DatasetError(f"{path}: is damaged: its checksum is not the one that was written down")
    return data
