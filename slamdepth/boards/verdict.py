# SPDX-License-Identifier: Apache-2.0
"""Whether images of a board determine a camera, and what to film where they do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.boards.adjust import Fit
from slamdepth.boards.choose import View
from slamdepth.errors import DatasetError
from slamdepth.typing import Floats

FEWEST_VIEWS = 5
"""Three views determine a pinhole, without anything left to tell how well."""
_ENOUGH_VIEWS = 10
_LARGEST_FOCAL_SIGMA = 0.02
"""A focal length that is less sure than this is no better than what a data sheet says of the lens."""
_TILTED_DEG = 20.0
_UNSURE_PX = 1.0
_COARSE_PX = 1.0
_BLURRED_PX = 5.0
_ROWS = ("top", "middle", "bottom")
_COLUMNS = ("left", "middle", "right")


def check_views(found: int, looked_at: int, board: str) -> None:
    """Refuse where too few images show the board.

    Raises:
        DatasetError: fewer than :data:`FEWEST_VIEWS`.
    """
    if found >= FEWEST_VIEWS:
        return
    if not found:
        raise DatasetError(
            f"none of {looked_at} images shows the board {board}: name yours by --board, as "
            "charuco:COLUMNSxROWS (squares) or checkerboard:COLUMNSxROWS (inner corners); the whole "
            "checkerboard must be in the image, sharp and well lit"
        )
    raise DatasetError(
        f"only {found} of {looked_at} images show the board {board}, at least {FEWEST_VIEWS} are needed: "
        "film it for half a minute from near and far, tilted to all sides and in every corner of the image"
    )


def check_fit(fit: Fit, better: str = "") -> None:
    """Refuse a calibration that the views do not determine.

    Args:
        better: another lens model that fits better, as a phrase; it is said instead of what to film.

    Raises:
        DatasetError: the focal length is unsure by more than two per cent; says what to film.
    """
    unsure = float(np.max(fit.sigma[:2] / fit.values[:2]))
    if unsure <= _LARGEST_FOCAL_SIGMA and np.isfinite(fit.sigma).all():
        return
    percent = f"{100 * min(unsure, 9.99):.1f} %"
    if better:
        raise DatasetError(f"the images do not determine the focal length ({percent} unsure): {better}")
    steepest = float(fit.tilts_deg.max())
    why = "the board faces the camera in all views" if steepest < _TILTED_DEG else "the views are too alike"
    raise DatasetError(
        f"the images do not determine the focal length ({percent} unsure): {why} (at "
        f"most {steepest:.0f} degrees tilted): tilt it by 30 to 45 degrees, left, right, up and down"
    )


def advice(fit: Fit, views: Sequence[View], size: tuple[int, int]) -> list[str]:
    """What would make the calibration better, one line each."""
    lines = []
    if len(views) < _ENOUGH_VIEWS:
        lines.append(f"only {len(views)} views: twenty and more are surer")
    missing = [name for name, count in coverage(views, size).items() if count == 0]
    if missing:
        lines.append(f"no corner of the board was seen {', '.join(missing)} in the image: film it there")
    unsure_px = projection_sigma_px(fit, size)
    if unsure_px > _UNSURE_PX:
        lines.append(
            f"at the edge of the image the lens is unsure by {unsure_px:.1f} pixels: film the board there, "
            "near and tilted"
        )
    if fit.rms_px > _COARSE_PX * max(1.0, max(size) / 1000.0):
        lines.append(
            f"corners are {fit.rms_px:.2f} pixels off: the board is bent, the camera moved (hold it still, "
            "in good light), or the lens is of another model (--fisheye)"
        )
    blurred = float(np.median([view.edge_px for view in views]))
    if blurred > _BLURRED_PX:
        lines.append(f"edges are {blurred:.1f} pixels wide: the images are blurred or out of focus")
    steepest = float(np.quantile(fit.tilts_deg, 0.8))
    if steepest < _TILTED_DEG:
        lines.append(f"the board is hardly tilted ({steepest:.0f} degrees): 30 to 45 degrees are surer")
    return lines


def coverage(views: Sequence[View], size: tuple[int, int]) -> dict[str, int]:
    """Number of corners in each ninth of the image, by name."""
    px = np.concatenate([view.sighting.px for view in views])
    counts = {}
    for row, vertical in enumerate(_ROWS):
        for column, horizontal in enumerate(_COLUMNS):
            low = np.array([column, row]) / 3.0 * size
            inside = ((px >= low) & (px < low + np.array(size) / 3.0)).all(axis=1)
            name = "middle" if row == column == 1 else f"{vertical} {horizontal}"
            counts[name] = int(inside.sum())
    return counts


def projection_sigma_px(fit: Fit, size: tuple[int, int]) -> float:
    """How unsure the lens is near the edge of the image: median deviation of a pixel there, as seen by a
    camera that may turn a little to fit the rest."""
    rays = _rays(fit, size)
    if len(rays) < 12:
        return float("inf")
    by_values = np.stack(
        [
            (fit.model.project(fit.values + step, rays) - fit.model.project(fit.values - step, rays))
            / (2.0 * step.max())
            for step in np.diag(1e-6 * np.maximum(1.0, np.abs(fit.values)))
        ],
        axis=2,
    )
    turning = np.stack(
        [
            (fit.model.project(fit.values, rays + np.cross(w, rays)) - fit.model.project(fit.values, rays))
            / 1e-6
            for w in 1e-6 * np.eye(3)
        ],
        axis=2,
    )
    flat, turns = by_values.reshape(-1, len(fit.values)), turning.reshape(-1, 3)
    rest = flat - turns @ np.linalg.lstsq(turns, flat, rcond=None)[0]
    variances = np.einsum("ij,jk,ik->i", rest, fit.covariance, rest).reshape(-1, 2).sum(axis=1)
    px = fit.model.project(fit.values, rays)
    edge = (np.abs(px / size - 0.5) > 0.4).any(axis=1)
    return float(np.median(np.sqrt(np.maximum(variances[edge], 0.0)))) if edge.any() else float("inf")


def _rays(fit: Fit, size: tuple[int, int]) -> Floats:
    """Rays ``(N, 3)`` of a grid of pixels over the image, where the lens sees any."""
    angle = np.linspace(0.0, 1.5, 31)[1:]
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    theta, phi = (a.ravel() for a in np.meshgrid(angle, turn))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    with np.errstate(all="ignore"):
        px = fit.model.project(fit.values, rays)
        inside = ((px >= 0) & (px <= np.array(size) - 1)).all(axis=1)
    return rays[inside]
