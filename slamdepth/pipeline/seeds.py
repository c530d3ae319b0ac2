# SPDX-License-Identifier: Apache-2.0
"""Seeds of the global random generators."""

from __future__ import annotations

import random
import sys

import numpy as np


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and OpenCV, which libraries draw from."""
    import cv2

    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - for libraries that still use it
    cv2.setRNGSeed(seed % 2**31)


def seed_torch(seed: int) -> None:
    """Seed torch where a depth model has loaded it; loading it here would take seconds."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
