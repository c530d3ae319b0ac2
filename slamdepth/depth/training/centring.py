# SPDX-License-Identifier: Apache-2.0
"""Taking out of a head what it is wrong by on the whole.

Of mixed scenes only the nearer surfaces are seen, so a head that learns from them expects
everything nearer than it is. Views that are not mixed tell by how much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from slamdepth.depth.head import DepthHead
from slamdepth.depth.training.caches import PlannedCache
from slamdepth.depth.training.features import FeatureCache, load_batch
from slamdepth.depth.training.stages import predict

_MOST_VIEWS = 200  # of a source


def centre(
    head: DepthHead, planned: Sequence[PlannedCache], caches: Sequence[FeatureCache], device: str
) -> float:
    """Shift ``head``'s log depth so that it is right on the median over views that are trained on
    and not mixed, whether or not by this head; every source counts the same.

    Returns:
        What was taken out; 0 where there are no such views.
    """
    errors = [
        _median_error(head, cache, device)
        for plan, cache in zip(planned, caches, strict=True)
        if plan.held_out is None and not plan.view.augment.mixed
    ]
    offset = float(np.mean(errors)) if errors else 0.0
    assert head.out.bias is not None
    with torch.no_grad():
        head.out.bias[0] -= offset
    return offset


def _median_error(head: DepthHead, cache: FeatureCache, device: str) -> float:
    was_training = head.training
    head.eval()
    medians = []
    for k in np.unique(np.linspace(0, len(cache) - 1, min(len(cache), _MOST_VIEWS)).round().astype(int)):
        with torch.inference_mode():
            prediction, target = predict(head, load_batch(cache, np.array([k]), device), False)
        known = target[0] > 0
        if bool(known.any()):
            medians.append(float((prediction[0, 0][known] - target[0][known].log()).median()))
    head.train(was_training)
    return float(np.mean(medians)) if medians else 0.0
