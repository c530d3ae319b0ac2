# SPDX-License-Identifier: Apache-2.0
"""Where a small patch of one image lies in another, to a fraction of a pixel.

A detector finds a corner anew in each image, and is off by half a pixel of the level it finds it at. The
patch about a corner of one image, warped as the other view sees it, tells the place to some hundredths:
feature alignment (Forster et al., "SVO", ICRA 2014) by the inverse compositional algorithm (Baker and
Matthews, "Lucas-Kanade 20 years on", IJCV 2004), with the patches' brightness and contrast taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.typing import Bools, Bytes, Floats, Floats32, Ints

_HALF = 4  # a patch has 9 x 9 samples
_WINDOW = 2.4  # deviation of their weights, in samples
_LEVELS = 3  # each half as large as the one before
_SMOOTHING_PX = 0.8  # of each level: JPEG and sensor noise
_STEPS = 10
_CONVERGED_PX = 0.003
_LONGEST_STEP = 1.5  # samples
_LEAST_CONTRAST = 2.0  # grey values
_LEAST_CURVATURE = 1e-3  # along the direction the patch tells least of, 1 per sample^2; 0 along an edge
_LEAST_CORRELATION = 0.85
_MOST_ZOOM = 2.0  # of one view against another: a patch at another size shows other things
_CHUNK = 30_000  # rows that cv2.remap takes at a time

_v, _u = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1]
_OFFSETS = np.column_stack([_u.ravel(), _v.ravel()]).astype(np.float32)
_WEIGHTS = np.exp(-(_OFFSETS**2).sum(axis=1) / (2.0 * _WINDOW**2)).astype(np.float32)
_WEIGHTS /= _WEIGHTS.sum()


class ImagePyramid:
    """An image at several sizes, to be sampled anywhere.

    Args:
        image_rgb: ``(H, W, 3)`` uint8.
    """

    def __init__(self, image_rgb: Bytes) -> None:
        import cv2

        grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        self._levels = [_smoothed(grey)]
        while len(self._levels) < _LEVELS and min(self._levels[-1].shape) >= 16:
            height, width = self._levels[-1].shape
            # cut, not squeezed: pixels of a level are squares of four of the one before
            even = _smoothed(self._levels[-1])[: height // 2 * 2, : width // 2 * 2]
            half = cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(half, np.float32))

    @property
    def levels(self) -> tuple[Floats32, ...]:
        """The image and smaller ones, the largest first; where it is small, the last one more than once."""
        missing = _LEVELS - len(self._levels)
        return (*self._levels, *self._levels[-1:] * missing)

    @property
    def count(self) -> int:
        """Number of different levels."""
        return len(self._levels)

    def sample(self, px: Floats, spacing_px: Floats) -> Floats32:
        """Grey values ``(N, S)`` at pixels ``(N, S, 2)``, smoothed as their ``spacing_px (N,)`` asks."""
        level = np.clip(np.floor(np.log2(np.maximum(spacing_px, 1.0))), 0, len(self._levels) - 1)
        values = np.empty(px.shape[:2], np.float32)
        for number, image in enumerate(self._levels):
            at = np.flatnonzero(level == number)
            values[at] = _interpolated(image, ((px[at] + 0.5) * 0.5**number - 0.5).astype(np.float32))
        return values


@dataclass(frozen=True)
class Templates:
    """Patches of one or several images, brightness and contrast taken out.

    Attributes:
        values: ``(N, S)``, of weighted mean 0 and square 1.
        gradient: ``(2, N, S)`` along x and y, 1/px of their image.
        inverse: ``(N, 2, 2)`` inverse normal matrix of a shift, px^2.
        spacing_px: ``(N,)`` between samples.
        is_usable: ``(N,)`` where the patch tells both coordinates.
    """

    values: Floats32
    gradient: Floats32
    inverse: Floats
    spacing_px: Floats
    is_usable: Bools

    @classmethod
    def of(cls, image: ImagePyramid, px: Floats, spacing_px: Floats) -> Templates:
        """The patches about ``px (N, 2)`` of an image, their samples ``spacing_px (N,)`` apart."""
        at = px[:, None] + _OFFSETS * spacing_px[:, None, None]
        values, contrast = _normalised(image.sample(at, spacing_px))
        step = 0.5 * spacing_px
        slope = (
            np.stack(
                [
                    image.sample(at + step[:, None, None] * axis, spacing_px)
                    - image.sample(at - step[:, None, None] * axis, spacing_px)
                    for axis in np.eye(2)
                ]
            )
            / (spacing_px * np.maximum(contrast, _LEAST_CONTRAST))[:, None]
        )
        # a shift is told only by what neither brightness nor contrast explains
        slope -= (slope * _WEIGHTS).sum(axis=-1, keepdims=True)
        slope -= (slope * values * _WEIGHTS).sum(axis=-1, keepdims=True) * values
        normal = np.einsum("ins,jns,s->nij", slope, slope, _WEIGHTS).astype(np.float64)
        curvature = np.linalg.eigvalsh(normal)[:, 0] * spacing_px**2
        is_usable = (contrast >= _LEAST_CONTRAST) & (curvature >= _LEAST_CURVATURE)
        normal[~is_usable] = np.eye(2)
        return cls(values, slope.astype(np.float32), np.linalg.inv(normal), spacing_px, is_usable)

    def taken(self, index: Ints) -> Templates:
        """Only the patches ``index``."""
        return Templates(
            self.values[index],
            self.gradient[:, index],
            self.inverse[index],
            self.spacing_px[index],
            self.is_usable[index],
        )

    @staticmethod
    def joined(parts: list[Templates]) -> Templates:
        """Several as one."""
        return Templates(
            np.concatenate([one.values for one in parts]),
            np.concatenate([one.gradient for one in parts], axis=1),
            np.concatenate([one.inverse for one in parts]),
            np.concatenate([one.spacing_px for one in parts]),
            np.concatenate([one.is_usable for one in parts]),
        )


def align(image: ImagePyramid, templates: Templates, warp: Floats, px: Floats) -> tuple[Floats, Floats]:
    """Shift patches of other images until they fit this one.

    Args:
        warp: ``(N, 2, 2)`` from offsets in a template's image to offsets in this one, px.
        px: ``(N, 2)`` where they are about.

    Returns:
        Pixels ``(N, 2)``, and the weighted correlation ``(N,)`` of what is there with the template.
    """
    if (fast := loops()) is not None:
        found_px, correlation = fast.alignment.align(
            image.levels,
            image.count,
            templates.values,
            templates.gradient,
            templates.inverse,
            templates.spacing_px.astype(np.float64),
            np.ascontiguousarray(warp, np.float64),
            np.ascontiguousarray(px, np.float64),
            _OFFSETS,
            _WEIGHTS,
            _STEPS,
            _CONVERGED_PX,
            _LONGEST_STEP,
        )
        return np.asarray(found_px), np.asarray(correlation)
    return _align(image, templates, warp, px)


def _align(image: ImagePyramid, templates: Templates, warp: Floats, px: Floats) -> tuple[Floats, Floats]:
    """:func:`align` without compiled loops."""
    px = np.array(px, dtype=np.float64)
    offsets = np.einsum("nij,sj->nsi", warp, _OFFSETS) * templates.spacing_px[:, None, None]
    spacing = templates.spacing_px * np.sqrt(np.abs(np.linalg.det(warp)))
    moving = np.arange(len(px))
    for _ in range(_STEPS):
        found, _ = _normalised(image.sample(px[moving, None] + offsets[moving], spacing[moving]))
        off = (found - templates.values[moving]) * _WEIGHTS
        steepest = np.einsum("ins,ns->ni", templates.gradient[:, moving], off)
        step = -np.einsum("nij,njk,nk->ni", warp[moving], templates.inverse[moving], steepest)
        length = np.linalg.norm(step, axis=1)
        limit = _LONGEST_STEP * spacing[moving]
        step *= np.minimum(1.0, limit / np.maximum(length, 1e-9))[:, None]
        px[moving] += step
        moving = moving[length >= _CONVERGED_PX]
        if len(moving) == 0:
            break
    found, _ = _normalised(image.sample(px[:, None] + offsets, spacing))
    return px, np.asarray((found * templates.values * _WEIGHTS).sum(axis=1), np.float64)


def align_near(
    image: ImagePyramid, templates: Templates, warp: Floats, px: Floats, farthest_px: Floats | float
) -> tuple[Floats, Bools]:
    """:func:`align`, and which results can be believed.

    Args:
        farthest_px: from ``px``, for each ``(N,)`` or all.

    Returns:
        Pixels ``(N, 2)``, and ``(N,)`` where the patches agree near ``px``.
    """
    found_px, correlation = align(image, templates, warp, px)
    zoom = np.sqrt(np.abs(np.linalg.det(warp)))
    good = (correlation > _LEAST_CORRELATION) & (zoom < _MOST_ZOOM) & (zoom > 1.0 / _MOST_ZOOM)
    good &= np.linalg.norm(found_px - px, axis=1) < farthest_px
    return found_px, np.asarray(good, np.bool_)


def central_views(towards: Floats, point: Ints, size: int) -> Ints:
    """Of ``size`` points, which view ``(size,)`` is nearest to the middle of all that see it.

    Args:
        towards: ``(M, 3)`` from the point to the camera, for each view of each point.
        point: ``(M,)``.

    Returns:
        Rows of ``towards``, -1 for a point without views.
    """
    towards = _unit(towards)
    mean = np.zeros((size, 3))
    np.add.at(mean, point, towards)
    nearness = np.einsum("mi,mi->m", towards, _unit(mean)[point])
    order = np.lexsort((-nearness, point))
    points, first = np.unique(point[order], return_index=True)
    rows = np.full(size, -1)
    rows[points] = order[first]
    return rows


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def facing_warp(
    T_camera_world: Floats, T_reference_world: Floats, reference: Ints, points_w: Floats, focal_px: Floats
) -> Floats:
    """``(N, 2, 2)`` from offsets in the image of each point's reference to offsets in a camera's.

    Args:
        T_camera_world: ``(4, 4)``; T_reference_world: ``(K, 4, 4)``.
        reference: ``(N,)`` of each point.
        points_w: ``(N, 3)`` on surfaces that are taken to face their reference.
        focal_px: ``(2,)`` of all, along x and y.
    """
    x, y, z = (points_w @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).T
    zero = np.zeros_like(z)
    projection = np.stack([np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)], 1)
    turn = T_camera_world[:3, :3] @ T_reference_world[:, :3, :3].transpose(0, 2, 1)
    towards = T_reference_world[:, 2][reference]
    depth = (points_w * towards[:, :3]).sum(axis=1) + towards[:, 3]
    warp = projection @ (turn[:, :, :2] / focal_px)[reference] * focal_px[:, None]
    return np.asarray(warp * depth[:, None, None])


def _smoothed(image: Floats32) -> Floats32:
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX), np.float32)


def _interpolated(image: Floats32, px: Floats32) -> Floats32:
    import cv2

    values = np.empty(px.shape[:2], np.float32)
    for start in range(0, len(px), _CHUNK):
        part = px[start : start + _CHUNK]
        values[start : start + _CHUNK] = cv2.remap(
            image,
            np.ascontiguousarray(part[..., 0]),
            np.ascontiguousarray(part[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return values


def _normalised(values: Floats32) -> tuple[Floats32, Floats]:
    """``values (N, S)`` of weighted mean 0 and square 1, and their contrast ``(N,)`` in grey values."""
    centred = values - (values * _WEIGHTS).sum(axis=1, keepdims=True)
    contrast = np.sqrt((centred * centred * _WEIGHTS).sum(axis=1))
    return centred / np.maximum(contrast, 1e-3)[:, None], contrast.astype(np.float64)
