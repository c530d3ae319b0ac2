# SPDX-License-Identifier: Apache-2.0
"""The embedded model while it learns from the map: its last layer, by ridge regression.

Upsampling is linear in what the heads' last layer (1 x 1) says, so a change of the layer's weights
for log depth changes log depth linearly, and the best change is the solution of one small linear
system instead of many steps of a gradient: robust (Huber, by reweighting) and held to the trained
weights by a ridge (Hoerl and Kennard, 1970). What is common to a view is taken out of the points and
of the change: the map's scale, which may drift, teaches nothing, and the predictions' own scale, as
the map sees it at its points, stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from slamdepth.depth.adaptation import TaughtView
from slamdepth.depth.head import HeadFeatures, LastLayerChange
from slamdepth.types import Adaptation, DepthPrediction, Frame

if TYPE_CHECKING:
    from slamdepth.depth.model import Dinov2Depth

MAX_VIEWS = 30
"""Views whose features are kept, 600 KB each."""

RIDGE = 30.0
"""Pull to the trained weights: that of so many views whose errors say the opposite."""

HUBER_LOG = 0.1
_MIN_POINTS = 20
_MIN_VIEWS = 5
_REWEIGHTINGS = 3


@dataclass(frozen=True)
class _Kept:
    """Of one view: features ``(members, 1, C, h, w)`` in half precision, the members' common doubt, their
    levels ``(members, 1)``, mean and variance of the features over the image ``(members * C,)``, log depth
    ``(h, w)`` as trained."""

    features: Tensor
    doubt: Tensor | None
    level: Tensor | None
    mean: Tensor
    variance: Tensor
    log_depth: Tensor


@dataclass(frozen=True)
class _Samples:
    """Of one view's points: features ``(N, members * C)`` less the image's mean, and log depth that is
    missing ``(N,)``."""

    features: Tensor
    missing: Tensor
    is_held_out: Tensor

    def only(self, mask: Tensor) -> _Samples:
        return _Samples(self.features[mask], self.missing[mask], self.is_held_out[mask])


class AdaptingDinov2:
    """A :class:`~slamdepth.depth.adaptation.AdaptingDepthModel` over ``model``, which stays as it is.

    A change is in use only while it is better than none on points it never learns from, in views
    that it had not learnt from yet.

    Args:
        ridge: see :data:`RIDGE`.
    """

    def __init__(self, model: Dinov2Depth, ridge: float = RIDGE) -> None:
        self._ridge = ridge
        self.name, self.kind, self.weights = model.name, model.kind, model.weights
        self._model = model
        self._kept: dict[int, _Kept] = {}
        self._learnt: LastLayerChange | None = None
        self._in_use: LastLayerChange | None = None
        self._learnt_from: set[int] = set()
        self._updates, self._judged = 0, 0
        self._loss_before, self._loss_after = 0.0, 0.0

    def predict(self, frame: Frame) -> DepthPrediction:
        """As :meth:`Dinov2Depth.predict`, with what was learnt so far."""
        return self._model.decode(self._features(frame), frame, self._in_use)

    def predict_as_trained(self, frame: Frame) -> DepthPrediction:
        """As if nothing had been learnt."""
        return self._model.decode(self._features(frame), frame)

    def _features(self, frame: Frame) -> HeadFeatures:
        kept = self._kept.get(frame.index)
        if kept is not None:
            return HeadFeatures(kept.features.float(), kept.doubt, kept.level)
        features = self._model.features(frame)
        self._keep(frame.index, features)
        return features

    def adapt(self, views: Sequence[TaughtView]) -> Adaptation:
        """Judge what was learnt by the views that are new, then learn from all; see the protocol."""
        with torch.inference_mode():
            samples = {v.frame.index: self._samples(v) for v in views if v.frame.index in self._kept}
            samples = {index: found for index, found in samples.items() if len(found.missing) >= _MIN_POINTS}
            self._judge([found for index, found in samples.items() if index not in self._learnt_from])
            if len(samples) >= _MIN_VIEWS:
                self._learn(samples)
            is_better = self._judged > 0 and self._loss_after < self._loss_before
            self._in_use = self._learnt if is_better else None
        judged = max(self._judged, 1)
        return Adaptation(
            updates=self._updates,
            views=len(self._learnt_from),
            judged_views=self._judged,
            loss_before=self._loss_before / judged if self._judged else None,
            loss_after=self._loss_after / judged if self._judged else None,
            in_use=self._in_use is not None,
        )

    def _keep(self, index: int, features: HeadFeatures) -> None:
        """Keep a view's features; of too many drop the one that stands closest between its neighbours."""
        flat = features.seen.flatten(0, 2).flatten(1)
        self._kept[index] = _Kept(
            features.seen.half(),
            features.doubt,
            features.level,
            flat.mean(dim=1),
            flat.var(dim=1, correction=0),
            self._model.coarse_log_depth(features),
        )
        if len(self._kept) > MAX_VIEWS:
            order = sorted(self._kept)
            gaps = [after - before for before, after in zip(order, order[2:], strict=False)]
            del self._kept[order[1 + gaps.index(min(gaps))]]

    def _samples(self, view: TaughtView) -> _Samples:
        kept = self._kept[view.frame.index]
        camera = view.frame.camera
        device = kept.log_depth.device
        # pixels have integer centres; grid_sample's -1 and 1 are the image's outer edges
        size = torch.tensor([camera.width, camera.height], dtype=torch.float32, device=device)
        at = (torch.as_tensor(view.px, dtype=torch.float32, device=device) + 0.5) / size * 2.0 - 1.0
        members = len(kept.features)
        grids = torch.cat([kept.features.float().flatten(0, 2) / members, kept.log_depth[None]])
        found = F.grid_sample(grids[None], at[None, None], padding_mode="border", align_corners=False)[
            0, :, 0
        ]
        log_depth = torch.as_tensor(view.log_depth, dtype=torch.float32, device=device)
        return _Samples(
            found[:-1].T - kept.mean / members,
            log_depth - found[-1],
            torch.as_tensor(view.is_held_out, device=device),
        )

    def _judge(self, unseen: list[_Samples]) -> None:
        if self._learnt is None:
            return
        for view in unseen:
            held = view.only(view.is_held_out)
            if len(held.missing) >= _MIN_POINTS // 4:
                self._loss_before += huber(held.missing)
                self._loss_after += huber(held.missing - held.features @ self._learnt.weights.flatten())
                self._judged += 1

    def _learn(self, samples: dict[int, _Samples]) -> None:
        members = len(next(iter(self._kept.values())).features)
        spread = torch.stack([self._kept[index].variance for index in samples]).mean(dim=0).sqrt() / members
        taught = [found.only(~found.is_held_out) for found in samples.values()]
        start = None if self._learnt is None else self._learnt.weights.flatten()
        w = fit_change(taught, spread, self._ridge, start)
        self._learnt = LastLayerChange(w.view(members, -1), scale_keeping_offset(taught, w))
        self._learnt_from |= set(samples)
        self._updates += 1


def fit_change(
    views: Sequence[_Samples], spread: Tensor, ridge: float, start: Tensor | None = None
) -> Tensor:
    """The change ``w (C,)`` of the weights that minimises, over views and one offset for each,

        sum_views mean_points rho(missing - features @ w - offset) + ridge |spread * w|^2

    with Huber's rho, by iteratively reweighted least squares from ``start``.

    Args:
        spread: ``(C,)`` deviation of each feature over an image, so that the ridge does not depend on
            their units.
    """
    unit = 1.0 / spread.clamp_min(1e-6)
    w = torch.zeros_like(unit, dtype=torch.float64) if start is None else (start / unit).double()
    for _ in range(_REWEIGHTINGS):
        normal = ridge * torch.eye(len(unit), dtype=torch.float64, device=unit.device)
        right = torch.zeros_like(w)
        for view in views:
            X = view.features * unit
            error = view.missing - X @ w.float()
            error = (error - error.median()).abs()
            weight = HUBER_LOG / error.clamp_min(HUBER_LOG) / len(error)
            share = weight / weight.sum()
            X = (X - share @ X) * weight.sqrt()[:, None]
            y = (view.missing - share @ view.missing) * weight.sqrt()
            normal += (X.T @ X).double()
            right += (X.T @ y).double()
        w = torch.linalg.solve(normal, right)
    return w.float() * unit


def scale_keeping_offset(views: Sequence[_Samples], w: Tensor) -> float:
    """What to add to log depth so that the median of what is missing stays, on average over the views.

    The tracker takes the map's scale from those medians; a better relief must not move it.
    """
    moved = [(view.missing - view.features @ w).median() - view.missing.median() for view in views]
    return float(torch.stack(moved).mean())


def huber(error: Tensor) -> float:
    """Mean Huber loss about the median: what is common to a view is no error."""
    size = (error - error.median()).abs()
    return float(torch.where(size < HUBER_LOG, 0.5 * size**2, HUBER_LOG * (size - 0.5 * HUBER_LOG)).mean())
