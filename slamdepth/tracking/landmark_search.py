# SPDX-License-Identifier: Apache-2.0
"""Which landmarks an image should show, and which of its features they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.matching import best_matches
from slamdepth.frontend.metric import whole_words
from slamdepth.frontend.pose import pixel_covariance
from slamdepth.geometry import CHI2_2DOF_99, project, transform
from slamdepth.mapping.landmarks import Landmarks
from slamdepth.mapping.map_view import NEAREST_M
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_MARGIN_PX = 8.0  # outside the image
_LEAST_COSINE = 0.5  # of the angle to the ray that the landmark was created along


@dataclass(frozen=True)
class Visible:
    """Landmarks expected in an image.

    Attributes:
        ids: ``(N,)``.
        px: ``(N, 2)`` undistorted pixels.
        covariance_px: ``(N, 2, 2)`` of those, from the landmark alone.
        octave: ``(N,)`` pyramid level it should be found at.
    """

    ids: Ints
    px: Floats
    covariance_px: Floats
    octave: Ints


@dataclass(frozen=True)
class SearchWindow:
    """How far from where it is expected a landmark is sought.

    Attributes:
        pose_px: error of the pose alone, in pixels of the finest level.
        most_px: no search goes farther.
        sigmas: deviations of a landmark's own position to search.
    """

    pose_px: float
    most_px: float
    sigmas: float = 3.0


def visible_landmarks(
    camera: Camera, levels: ScaleLevels, landmarks: Landmarks, T_camera_world: Floats, ids: Ints
) -> Visible:
    """Which of the landmarks ``ids (N,)`` a camera at ``T_camera_world (4, 4)`` should see, and where.

    Args:
        camera: without distortion.
        levels: of the features that the landmarks were created from.
    """
    if (fast := loops()) is not None:
        return Visible(
            *fast.visible.visible(
                ids,
                landmarks.position_w,
                landmarks.covariance_w,
                landmarks.direction_w,
                landmarks.distance_m,
                landmarks.octave,
                np.array(T_camera_world),
                (camera.fx, camera.fy, camera.cx, camera.cy),
                (camera.width, camera.height),
                (levels.factor, levels.count),
                NEAREST_M,
                _MARGIN_PX,
                _LEAST_COSINE,
            )
        )
    points_w = landmarks.position_w[ids]
    points_c = transform(T_camera_world, points_w)
    px, z = project(camera, points_c)
    u, v = px.T
    at = np.flatnonzero(
        (z > NEAREST_M)
        & (u > -_MARGIN_PX)
        & (u < camera.width + _MARGIN_PX)
        & (v > -_MARGIN_PX)
        & (v < camera.height + _MARGIN_PX)
    )
    ids, points_c, px = ids[at], points_c[at], px[at]
    offset = points_w[at] - (-T_camera_world[:3, :3].T @ T_camera_world[:3, 3])
    x, y, z = offset.T
    distance = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-9)
    ok = np.einsum("ni,ni->n", offset, landmarks.direction_w[ids]) > _LEAST_COSINE * distance
    step = np.log(landmarks.distance_m[ids] / distance) / np.log(levels.factor)
    octave = np.rint(landmarks.octave[ids] + step).astype(np.int64)
    ok &= (octave >= -1) & (octave <= levels.count)
    at = np.flatnonzero(ok)
    ids, octave = ids[at], np.minimum(np.maximum(octave[at], 0), levels.count - 1)
    covariance = pixel_covariance(
        camera, T_camera_world, points_c[at], landmarks.covariance_w[ids], np.zeros(len(at))
    )
    return Visible(ids, px[at], covariance, octave)


def match_landmarks(
    visible: Visible,
    landmarks: Landmarks,
    features: Features,
    levels: ScaleLevels,
    window: SearchWindow,
    *,
    max_distance: int,
    ratio: float,
) -> tuple[Ints, Ints, Ints]:
    """Match expected landmarks to features; the search area follows each landmark's uncertainty.

    Args:
        levels: of the features.
        max_distance: largest distance of two descriptors.
        ratio: best over second best distance, at most (Lowe 2004).

    Returns:
        ``(landmark ids, feature indices, descriptor distances)``, one to one.
    """
    words, fast = features.words, loops()
    if fast is not None and words is not None and len(features) and len(visible.ids):
        q, t, distance = fast.matching.match(
            visible.px,
            visible.covariance_px,
            visible.octave,
            whole_words(landmarks.descriptor[visible.ids]).view(np.uint64),
            *features.grid.cells,
            features.px,
            features.octave,
            words,
            levels.sigmas_px,
            window.pose_px,
            window.most_px,
            window.sigmas,
            CHI2_2DOF_99,
            max_distance,
            ratio,
        )
        return visible.ids[q], t, distance
    pose_px = window.pose_px * levels.sigma_px(visible.octave)
    S00, S01, S11 = (visible.covariance_px[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    half_trace = 0.5 * (S00 + S11)
    largest = half_trace + np.sqrt(np.maximum(half_trace**2 - (S00 * S11 - S01**2), 0.0))
    radius = np.minimum(pose_px + window.sigmas * np.sqrt(largest), window.most_px)
    # the ellipse of the pose's error plus the point's own, a du^2 + b du dv + c dv^2 < 1
    along_u, along_v = S00 + pose_px**2 / CHI2_2DOF_99, S11 + pose_px**2 / CHI2_2DOF_99
    scale = CHI2_2DOF_99 * (along_u * along_v - S01 * S01)
    a, b, c = along_v / scale, -2.0 * S01 / scale, along_u / scale
    box = np.sqrt(CHI2_2DOF_99 * np.column_stack([along_u, along_v]))
    q, t = features.grid.pairs_within(visible.px, radius, box)
    ok = np.flatnonzero(np.abs(features.octave.take(t) - visible.octave.take(q)) <= 1)
    q, t = q.take(ok), t.take(ok)
    du = features.px[:, 0].take(t) - visible.px[:, 0].take(q)
    dv = features.px[:, 1].take(t) - visible.px[:, 1].take(q)
    ok = np.flatnonzero((a.take(q) * du + b.take(q) * dv) * du + c.take(q) * dv * dv < 1.0)
    q, t = q.take(ok), t.take(ok)
    distance = features.metric.between(landmarks.descriptor[visible.ids[q]], features.descriptors[t])
    q, t, distance = best_matches(q, t, distance, max_distance=max_distance, ratio=ratio)
    return visible.ids[q], t, distance
