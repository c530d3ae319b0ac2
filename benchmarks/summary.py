# SPDX-License-Identifier: Apache-2.0
"""Medians and spread of several runs of a row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.rows import Row


@dataclass(frozen=True)
class Metric:
    """A column of the table.

    Attributes:
        key: of the figure.
        digits: decimals.
        factor: from the figure to the shown value.
        better: -1 where less is better, 1 where more is, 0 where neither.
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


def condense(runs: Sequence[Mapping[str, float]]) -> tuple[dict[str, float], dict[str, list[float]]]:
    """The median of each figure over the runs that have it, and the least and the most where runs differ."""
    medians: dict[str, float] = {}
    spread: dict[str, list[float]] = {}
    for key in dict.fromkeys(key for run in runs for key in run):
        values = [run[key] for run in runs if key in run]
        medians[key] = float(np.median(values))
        if min(values) < max(values):
            spread[key] = [float(min(values)), float(max(values))]
    return medians, spread


def summarise(sequence: str, row: Row, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One entry of the JSON file.

    ``figures`` holds medians over the good runs, ``spread`` the least and the most where they differ. The
    status is "ok" where at least one run was.
    """
    good = [result for result in results if result["status"] == "ok"]
    bad = [result for result in results if result["status"] != "ok"]
    figures, spread = condense([result["figures"] for result in good])
    notes = list(dict.fromkeys([*([row.note] if row.note else []), *(n for r in good for n in r["notes"])]))
    messages = list(dict.fromkeys(str(result["message"]) for result in bad))
    if good and bad:
        notes.append(f"{len(bad)} of {len(results)} runs failed: {'; '.join(messages)}")
    return {
        "sequence": sequence,
        **row.published(),
        "status": "ok" if good else (str(bad[0]["status"]) if bad else "left out"),
        "message": "" if good else "; ".join(messages),
        "runs": len(good),
        "frames": good[0]["frames"] if good else 0,
        "figures": figures,
        "spread": spread,
        "notes": notes,
    }
