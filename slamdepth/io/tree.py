# SPDX-License-Identifier: Apache-2.0
"""Nested dictionaries and lists of arrays and plain values, as what safetensors and JSON can hold."""

from __future__ import annotations

from typing import Any

import numpy as np

Tree = dict[str, Any]
"""Dictionaries with text as keys, and lists, of arrays, numbers, texts and None."""

_ARRAY = "$array"


def flattened(tree: Any, path: str = "") -> tuple[Any, dict[str, np.ndarray[Any, Any]]]:
    """The tree with a name in the place of each array, and the arrays by name.

    Raises:
        TypeError: it holds something else.
    """
    if isinstance(tree, np.ndarray):
        return {_ARRAY: path}, {path: tree}
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        arrays: dict[str, np.ndarray[Any, Any]] = {}
        plain = []
        for key, value in pairs:
            one, found = flattened(value, f"{path}/{key}" if path else str(key))
            plain.append((key, one))
            arrays |= found
        return (dict(plain) if isinstance(tree, dict) else [one for _, one in plain]), arrays
    if isinstance(tree, np.generic):
        tree = tree.item()
    if tree is None or isinstance(tree, bool | int | float | str):
        return tree, {}
    raise TypeError(f"{path}: a {type(tree).__name__} cannot be saved")


def restored(plain: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """What :func:`flattened` was given; tuples come back as lists.

    Raises:
        KeyError: an array is missing.
    """
    if isinstance(plain, dict):
        if set(plain) == {_ARRAY}:
            return arrays[plain[_ARRAY]]
        return {key: restored(value, arrays) for key, value in plain.items()}
    if isinstance(plain, list):
        return [restored(value, arrays) for value in plain]
    return plain
