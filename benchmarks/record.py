# SPDX-License-Identifier: Apache-2.0
"""The JSON file of a benchmark: what was run on what, rounded figures, and few lines."""

from __future__ import annotations

import json
import math
import os
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

from slamdepth.errors import InputError
from slamdepth.io import write_text
from slamdepth.processor import instructions
from slamdepth.report.environment import hardware, versions

FORMAT = 2
_DIGITS = 5  # significant ones; runs differ in the third
_WIDTH = 110
_SHOWN = {
    "avx2": "AVX2",
    "avx512_f": "AVX-512",
    "avx512_bf16": "bfloat16 by AVX-512",
    "amx_bf16": "bfloat16 by AMX",
}


def environment() -> dict[str, Any]:
    """Versions, commit, hardware, and the load of the machine when the benchmark began.

    ``hardware.instructions`` names those of AVX2, AVX-512 and bfloat16 that are used: they decide how fast
    the network is.
    """
    found = versions()
    try:
        found["pyorbslam3"] = metadata.version("pyorbslam3")
    except metadata.PackageNotFoundError:
        found["pyorbslam3"] = None
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "versions": found,
        "hardware": {**hardware(), "instructions": list(instructions())},
        "load_average": load,
    }


def machine_line(begun: dict[str, Any]) -> str:
    """What the figures of :func:`environment` ``begun`` were measured on, for the head of a table."""
    machine, used = begun["hardware"], begun["hardware"].get("instructions", [])
    names = [shown for name, shown in _SHOWN.items() if name in used] or ["instructions unknown"]
    if "avx2" in used and not any("bf16" in name for name in used):
        names.append("no bfloat16")
    commit = str(begun["versions"].get("commit") or begun["versions"].get("slamdepth"))[:9]
    gpu = f", {machine['gpu']}" if machine.get("gpu") else ""
    numba = f", numba {begun['versions']['numba']}" if begun["versions"].get("numba") else ""
    return f"{machine['cores']} cores of {machine['cpu']} ({', '.join(names)}){gpu}{numba}; {commit}"


def write_benchmark(path: Path, begun: dict[str, Any], settings: dict[str, Any], **content: Any) -> None:
    """Write one benchmark, whole or not at all: floats with five significant digits, NaN as null.

    Args:
        begun: :func:`environment` before the first run.
        settings: what decides the figures.
        content: the figures, by the key in the file.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    about = {"format": FORMAT, "environment": begun, "settings": settings}
    write_text(path, compact_json({**about, **_rounded(content)}) + "\n")


def read_benchmark(path: Path) -> dict[str, Any]:
    """Read the rows that :func:`write_benchmark` wrote.

    Raises:
        InputError: the file is missing, or none of this format.
    """
    try:
        loaded = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(loaded, dict) or loaded.get("format") != FORMAT or "rows" not in loaded:
        raise InputError(f"{path}: not a benchmark of this program (format {FORMAT})")
    return loaded


def compact_json(value: Any, indent: int = 0, key: str = "") -> str:
    """JSON text whose lines are filled up to 110 characters, so that a row is a few lines of a diff.

    Args:
        indent: spaces before the closing bracket.
        key: put before the value.
    """
    before_value = f"{json.dumps(key)}: " if key else ""
    flat = before_value + json.dumps(value, ensure_ascii=False, allow_nan=False, default=str)
    if not isinstance(value, dict | list) or indent + len(flat) < _WIDTH:
        return flat
    if isinstance(value, dict):
        parts = [compact_json(item, indent + 2, name) for name, item in value.items()]
        first, last = "{}"
    else:
        parts = [compact_json(item, indent + 2) for item in value]
        first, last = "[]"
    margin = " " * (indent + 2)
    lines = [margin + parts[0]]
    for before, part in pairwise(parts):
        fits = len(lines[-1]) + len(part) + 3 <= _WIDTH
        if fits and "\n" not in part and "\n" not in before:
            lines[-1] += f", {part}"
        else:
            lines[-1] += ","
            lines.append(margin + part)
    return "\n".join([before_value + first, *lines, " " * indent + last])


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value
