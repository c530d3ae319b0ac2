# SPDX-License-Identifier: Apache-2.0
"""Several runs of a row become medians and spreads; a benchmark becomes one JSON file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row
from slamdepth.errors import InputError
from slamdepth.report.environment import hardware, versions

FORMAT = 1


@dataclass(frozen=True)
class Metric:
    """A column: key in the figures, heading, decimals, factor for display, better direction.

    ``better`` is -1 where less is better, 1 where more is, 0 where neither.
    """

    key: str
    heading: str
    digits: int
    factor: float = 1.0
    better: int = -1


METRICS = (
    Metric("tracked", "tracked %", 1, 100.0, better=1),
    Metric("ate_se3_m", "ATE SE(3) m", 3),
    Metric("ate_sim3_m", "ATE Sim(3) m", 3),
    Metric("ate_sim3_keyframes_m", "keyframes' Sim(3) m", 3),
    Metric("scale", "scale", 3, better=0),
    Metric("rpe_m_per_s", "RPE m/s", 3),
    Metric("rpe_deg_per_s", "RPE °/s", 2),
    Metric("keyframes", "keyframes", 0, better=0),
    Metric("loops", "loops", 0, better=0),
    Metric("fps", "fps", 1, better=1),
    Metric("step_p95_ms", "step p95 ms", 0),
    Metric("finish_s", "finish s", 1),
    Metric("cpu_ms_per_frame", "CPU ms/frame", 0),
    Metric("peak_memory_mib", "peak MiB", 0),
)
"""The columns of the table, in order."""


def summarise(sequence: str, row: Row, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One entry of the JSON file: the runs as they were, and over the good ones each figure's
    ``median``, ``min`` and ``max``. The status is "ok" where at least one run was."""
    good = [result for result in results if result["status"] == "ok"]
    bad = [result for result in results if result["status"] != "ok"]
    keys = dict.fromkeys(key for result in good for key in result["figures"])
    figures = {}
    for key in keys:
        values = [result["figures"][key] for result in good if key in result["figures"]]
        figures[key] = {
            "median": float(np.median(values)),
            "min": float(np.min(values)),
            "max": float(np.max(values)),
        }
    notes = list(dict.fromkeys([*([row.note] if row.note else []), *(n for r in good for n in r["notes"])]))
    messages = list(dict.fromkeys(str(result["message"]) for result in bad))
    if good and bad:
        notes.append(f"{len(bad)} of {len(results)} runs failed: {'; '.join(messages)}")
    return {
        "sequence": sequence,
        **row.published(),
        "status": "ok" if good else (str(bad[0]["status"]) if bad else "left out"),
        "message": "" if good else "; ".join(messages),
        "runs": [dict(result) for result in results],
        "figures": figures,
        "notes": notes,
    }


def environment() -> dict[str, Any]:
    """Versions, commit, hardware, and how busy the machine was when the benchmark began."""
    found = versions()
    try:
        found["pyorbslam3"] = metadata.version("pyorbslam3")
    except metadata.PackageNotFoundError:
        found["pyorbslam3"] = None
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"versions": found, "hardware": hardware(), "load_average": load}


def read_benchmark(path: Path) -> dict[str, Any]:
    """A file written by an earlier benchmark.

    Raises:
        InputError: it is missing or something else.
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
