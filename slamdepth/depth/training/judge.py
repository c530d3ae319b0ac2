# SPDX-License-Identifier: Apache-2.0
"""How good a head is on views it was not trained on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from slamdepth.depth.head import HeadEnsemble
from slamdepth.depth.training.features import FeatureCache, load_batch

if TYPE_CHECKING:
    from numpy.typing import NDArray


def judge(
    ensemble: HeadEnsemble, cache: FeatureCache, device: str
) -> tuple[dict[str, float], NDArray[np.float64]]:
    """Figures over the samples of ``cache``, and all ``|log error| / sigma``.

    AbsRel as predicted and after a median per view, delta1 after it, the spread of the
    views' log scales, and the share of errors below one sigma.
    """
    rows: list[list[float]] = []
    ratios = []
    for k in range(len(cache)):
        batch = load_batch(cache, np.array([k]), device)
        with torch.inference_mode():
            log_depth, sigma = ensemble(*batch[:3])
        known = batch[3][0] > 0
        if int(known.sum()) < 100:
            continue
        error = (log_depth[0][known] - batch[3][0][known].log()).double().cpu().numpy()
        ratios.append(np.abs(error) / sigma[0][known].double().cpu().numpy())
        median = float(np.median(error))
        scaled = np.exp(error - median)
        rows.append([
            float(np.mean(np.abs(np.exp(error) - 1))),
            float(np.mean(np.abs(scaled - 1))),
            float(np.mean(np.maximum(scaled, 1 / scaled) < 1.25)),
            median,
        ])  # fmt: skip
    if not rows:
        return {}, np.ones(1)
    table = np.array(rows)
    ratio = np.concatenate(ratios)
    return {
        "abs_rel": float(table[:, 0].mean()),
        "abs_rel_frame_median": float(table[:, 1].mean()),
        "delta1_frame_median": float(table[:, 2].mean()),
        "scale_spread": float(table[:, 3].std()),
        "within_one_sigma": float(np.mean(ratio < 1)),
    }, ratio
