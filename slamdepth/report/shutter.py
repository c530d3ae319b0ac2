# SPDX-License-Identifier: Apache-2.0
"""What a report says about the camera's shutter."""

from __future__ import annotations

from typing import Any

from slamdepth.types import RunStatistics


def shutter_facts(run: RunStatistics, is_given: bool) -> dict[str, Any]:
    """Readout time and its standard deviation in milliseconds, whether it was estimated, and a sentence."""
    if run.readout_s is None:
        return {
            "readout_ms": None,
            "uncertainty_ms": None,
            "is_found": False,
            "sentence": "not modelled by this odometry",
        }
    readout_ms = 1e3 * run.readout_s
    sigma_ms = None if run.readout_sigma_s is None else 1e3 * run.readout_sigma_s
    return {
        "readout_ms": readout_ms,
        "uncertainty_ms": sigma_ms,
        "is_found": not is_given and sigma_ms is not None,
        "sentence": _sentence(readout_ms, sigma_ms, is_given),
    }


def _sentence(readout_ms: float, sigma_ms: float | None, is_given: bool) -> str:
    if is_given:
        return f"{readout_ms:.1f} ms from first row to last, as given" if readout_ms else "global, as given"
    if sigma_ms is None:
        return "assumed to be global: too little motion to estimate it"
    if readout_ms == 0.0:
        return f"global: no readout time found, with an uncertainty of {sigma_ms:.1f} ms"
    return f"{readout_ms:.1f} ± {sigma_ms:.1f} ms from first row to last, estimated from the motion"
