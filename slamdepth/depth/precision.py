# SPDX-License-Identifier: Apache-2.0
"""What numbers the backbone of the embedded model computes in: float32, bfloat16, or 8-bit integers."""

from __future__ import annotations

import logging
from typing import Literal

import torch

from slamdepth.config import Precision
from slamdepth.depth.dinov2 import DinoV2, working_type
from slamdepth.depth.int8 import check_int8, to_int8
from slamdepth.errors import ConfigError
from slamdepth.processor import has_bfloat16, instructions

_log = logging.getLogger(__name__)

ChosenPrecision = Literal["float32", "bfloat16", "int8"]


def chosen_precision(asked: Precision, device: str) -> ChosenPrecision:
    """What ``asked`` stands for on ``device``; logs what ``auto`` takes, and why.

    ``auto`` takes bfloat16 on a CPU that multiplies it natively, else int8 on one with AVX2, else float32.
    bfloat16 changes depth by half a per cent, int8 by one, where the head errs by ten or more.

    Raises:
        ConfigError: int8 is asked for and cannot be had; says why.
    """
    if asked == "int8":
        try:
            check_int8(device)
        except ConfigError as error:
            raise ConfigError(f"depth.precision int8: {error}; take 'auto' or 'float32'") from error
    if asked != "auto":
        if asked == "bfloat16" and device == "cpu" and not has_bfloat16():
            _log.warning("bfloat16 is emulated on this processor, which is slower than float32")
        return asked
    if working_type(device) is torch.bfloat16:
        _log.info("the backbone computes in bfloat16, which this processor multiplies natively")
        return "bfloat16"
    if device != "cpu" or "avx2" not in instructions():
        return "float32"
    try:
        check_int8(device)
    except ConfigError as error:
        _log.warning("the backbone computes in float32, half as fast as in int8: %s", error)
        return "float32"
    _log.info("the backbone computes in int8: this processor has AVX2, but no native bfloat16")
    return "int8"


def with_precision(backbone: DinoV2, precision: ChosenPrecision, device: str) -> tuple[DinoV2, torch.dtype]:
    """``backbone`` on ``device``, changed in place, and the type of the images that it takes."""
    if precision == "int8":
        return to_int8(backbone.to(device, torch.float32)), torch.float32
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    return backbone.to(device, dtype), dtype
