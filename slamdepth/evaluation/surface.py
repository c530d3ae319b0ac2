# SPDX-License-Identifier: Apache-2.0
"""Score a surface against a reference: accuracy, completion, precision, recall.

The figures are those of Knapitsch et al., "Tanks and Temples" (2017), and of Murai et al., "MASt3R-SLAM"
(2025), whose accuracy and completion are RMSE of distances up to 0.5 m. Distances are measured from points
spread evenly over one surface to the other surface itself, not to its vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.evaluation.surface_points import distances_m, even_points
from slamdepth.typing import Bools, Floats, Floats32, Ints

THRESHOLDS_M = (0.02, 0.05, 0.1)
"""Distances at which precision, recall and F-score are given."""

CUT_M = 0.5
"""Larger distances count as this much in means and RMSE, so that no single stray point decides them."""

Judge = Callable[[Floats], Bools]
"""Mask ``(N,)`` of the points ``(N, 3)`` of the reference's frame at which the reference can judge."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or a point cloud.

    Attributes:
        vertices_m: ``(V, 3)`` float32 metres.
        triangles: ``(T, 3)`` int64 vertex numbers; ``(0, 3)`` makes it a point cloud.
    """

    vertices_m: Floats32
    triangles: Ints

    @classmethod
    def cloud(cls, points_m: Floats32) -> Surface:
        """A point cloud ``(N, 3)``."""
        return cls(points_m, np.zeros((0, 3), np.int64))

    def moved(self, T_reference_surface: Floats) -> Surface:
        """The surface in another frame; ``(4, 4)``, its rotation part may be multiplied by a scale."""
        T = T_reference_surface
        moved = self.vertices_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return replace(self, vertices_m=moved.astype(np.float32))


@dataclass(frozen=True)
class Distances:
    """Distances from points of one surface to the other; mean and RMSE are of those capped at 0.5 m."""

    median_m: float
    mean_m: float
    rmse_m: float

    @classmethod
    def of(cls, distances: Floats) -> Distances:
        """Of ``(N,)`` metres, N at least 1."""
        capped = np.minimum(distances, CUT_M)
        return cls(
            float(np.median(distances)), float(capped.mean()), float(np.sqrt(np.mean(capped * capped)))
        )


@dataclass(frozen=True)
class Matched:
    """What lies within a distance.

    Attributes:
        precision: share of the estimate within it of the reference.
        recall: share of the reference within it of the estimate.
    """

    precision: float
    recall: float

    @property
    def f_score(self) -> float:
        """The harmonic mean of the two, 0 where both are."""
        both = self.precision + self.recall
        return 2.0 * self.precision * self.recall / both if both else 0.0


@dataclass(frozen=True)
class SurfaceScore:
    """How far an estimated surface is from a reference.

    Attributes:
        accuracy: from the judged part of the estimate to the reference.
        completion: from the reference to the estimate.
        within: precision and recall by distance in metres.
        judged: share of the estimate's points at which the reference can judge.
        points, reference_points: judged points of the estimate, and points of the reference.
    """

    accuracy: Distances
    completion: Distances
    within: dict[float, Matched]
    judged: float
    points: int
    reference_points: int

    @property
    def chamfer_m(self) -> float:
        """Mean of the means of accuracy and completion."""
        return (self.accuracy.mean_m + self.completion.mean_m) / 2.0

    def to_dict(self) -> dict[str, Any]:
        """The figures as nested plain values; ``within`` by centimetres: ``"2cm"``, ``"5cm"``, ``"10cm"``."""
        return {
            **{
                name: {"median_m": one.median_m, "mean_m": one.mean_m, "rmse_m": one.rmse_m}
                for name, one in (("accuracy", self.accuracy), ("completion", self.completion))
            },
            "chamfer_m": self.chamfer_m,
            "within": {
                centimetres(threshold_m): {
                    "precision": one.precision,
                    "recall": one.recall,
                    "f_score": one.f_score,
                }
                for threshold_m, one in self.within.items()
            },
            "judged": self.judged,
            "points": self.points,
            "reference_points": self.reference_points,
        }


@dataclass(frozen=True)
class AlignedScores:
    """The score of one surface after alignment of the poses, without and with scale."""

    se3: SurfaceScore
    sim3: SurfaceScore


def surface_figures(scores: AlignedScores | None) -> dict[str, Any]:
    """The figures of both alignments, with the same keys where the surface was not scored."""
    if scores is None:
        return {"se3": _unknown(), "sim3": _unknown()}
    return {"se3": scores.se3.to_dict(), "sim3": scores.sim3.to_dict()}


def _unknown() -> dict[str, Any]:
    distances = dict.fromkeys(("median_m", "mean_m", "rmse_m"))
    matched = dict.fromkeys(("precision", "recall", "f_score"))
    return {
        "accuracy": distances,
        "completion": dict(distances),
        "chamfer_m": None,
        "within": {centimetres(threshold_m): dict(matched) for threshold_m in THRESHOLDS_M},
        **dict.fromkeys(("judged", "points", "reference_points")),
    }


def centimetres(distance_m: float) -> str:
    """``0.05`` as ``"5cm"``."""
    return f"{100 * distance_m:g}cm"


def score_surface(
    estimate: Surface, reference: Surface, can_judge: Judge | None = None, *, seed: int = 0
) -> SurfaceScore:
    """Score ``estimate``, which must be in the frame of ``reference``; nothing is aligned here.

    Points are spread evenly over both surfaces (about one per square centimetre, at most 100,000) and thinned
    to one per voxel of 1 cm, so that neither the density of vertices nor that of a cloud counts. All of the
    estimate counts for completion; only where ``can_judge`` holds does it count for accuracy and precision.

    Args:
        can_judge: where the reference knows what is there; None: everywhere.
        seed: of the points; the same seed gives the same figures.

    Raises:
        DatasetError: a surface is empty, or no point of the estimate can be judged.
        SlamdepthError: Open3D is not installed.
    """
    ours = even_points(estimate.vertices_m, estimate.triangles, seed)
    theirs = even_points(reference.vertices_m, reference.triangles, seed)
    for name, points in (("estimate", ours), ("reference", theirs)):
        if len(points) == 0:
            raise DatasetError(f"the {name} has no surface")
    mask = np.ones(len(ours), bool) if can_judge is None else can_judge(ours)
    if not mask.any():
        raise DatasetError(
            "no point of the surface lies where the reference can judge: are both in one frame?"
        )
    to_reference = distances_m(ours[mask], reference.vertices_m, reference.triangles)
    to_estimate = distances_m(theirs, estimate.vertices_m, estimate.triangles)
    return SurfaceScore(
        Distances.of(to_reference),
        Distances.of(to_estimate),
        {
            t: Matched(float((to_reference <= t).mean()), float((to_estimate <= t).mean()))
            for t in THRESHOLDS_M
        },
        float(mask.mean()),
        int(mask.sum()),
        len(theirs),
    )


def vertex_errors_m(estimate: Surface, reference: Surface, can_judge: Judge | None = None) -> Floats:
    """Distance ``(V,)`` of each vertex of ``estimate`` to ``reference``; NaN where it cannot be judged.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    points = estimate.vertices_m.astype(np.float64)
    errors = distances_m(points, reference.vertices_m, reference.triangles)
    if can_judge is not None:
        errors[~can_judge(points)] = np.nan
    return errors
