# SPDX-License-Identifier: Apache-2.0
"""Samples: which view of which image each one is, and how it is rendered. Deterministic by seed."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.training.augment import View, augmented_view, matching_view, mixed_view, unaugmented_view
from slamdepth.training.config import AugmentConfig, ViewConfig
from slamdepth.training.data import Place
from slamdepth.training.gravity import gravity_of
from slamdepth.typing import Floats, Floats32

_MAX_PITCH_APART_DEG = 16.0
_MAX_DRAWS = 40


@dataclass(frozen=True)
class SampleKey:
    """Identifies a sample: a view of an image of a place. Copy -1 is the unaugmented view."""

    place: int
    frame: int
    copy: int


@dataclass(frozen=True)
class Partner:
    """A place whose views are mixed into those of others.

    Attributes:
        augment: augmentation of its views.
        weight: relative frequency at which it is drawn.
    """

    place: Place
    augment: AugmentConfig
    weight: float


def plan_samples(places: Sequence[Place], samples: Sequence[int], seed: int) -> list[SampleKey]:
    """The samples of ``places``: each place's number spread over its frames, in random order.

    A place with more frames than samples is thinned evenly; one with fewer is repeated, with
    another augmentation each time.
    """
    keys = []
    for index, (place, count) in enumerate(zip(places, samples, strict=True)):
        frames = len(place)
        if count < frames:
            chosen = np.linspace(0, frames - 1, count).round().astype(int)
            keys += [SampleKey(index, int(frame), 0) for frame in chosen]
        else:
            keys += [SampleKey(index, k % frames, k // frames) for k in range(count)]
    order = np.random.default_rng(seed).permutation(len(keys))
    return [keys[k] for k in order]


def plan_unaugmented(place_index: int, place: Place, limit: int) -> list[SampleKey]:
    """At most ``limit`` unaugmented samples, spread evenly over one place; for evaluation."""
    count = min(limit, len(place))
    chosen = np.linspace(0, len(place) - 1, count).round().astype(int)
    return [SampleKey(place_index, int(frame), -1) for frame in chosen]


def make_view(
    places: Sequence[Place], key: SampleKey, config: ViewConfig, seed: int, partners: Sequence[Partner] = ()
) -> View:
    """Render the view named by ``key``. It depends on ``seed`` and ``key`` only.

    With ``config.upright`` it is rotated upright by its gravity, where known, and mixed only with views
    of the same gravity.

    Args:
        partners: places to mix in, at the frequency ``config.augment.mixed``.
    """
    place = places[key.place]
    frame = place.read(key.frame)
    gravity = gravity_of(place, key.frame, frame) if config.upright else None
    if key.copy < 0:
        return unaugmented_view(frame, config.rows, config.columns, gravity)
    rng = np.random.default_rng([seed, zlib.crc32(place.name.encode()), key.frame, key.copy])

    def drawn() -> tuple[Partner, int]:
        weights = np.array([partner.weight for partner in partners])
        chosen = partners[rng.choice(len(partners), p=weights / weights.sum())]
        return chosen, int(rng.integers(len(chosen.place)))

    size = config.rows, config.columns

    def with_another(view: View) -> View:
        if gravity is None:
            partner, index = drawn()
            return mixed_view(view, augmented_view(partner.place.read(index), *size, partner.augment, rng))
        for _ in range(_MAX_DRAWS):
            partner, index = drawn()
            own = gravity_of(partner.place, index)
            if own is not None and abs(_pitch_deg(own) - _pitch_deg(view.gravity)) < _MAX_PITCH_APART_DEG:
                frame = partner.place.read(index)
                other = matching_view(frame, *size, partner.augment, rng, own, view.gravity)
                return mixed_view(view, other)
        return view

    view = augmented_view(frame, config.rows, config.columns, config.augment, rng, gravity)
    if partners and rng.random() < config.augment.mixed:
        view = with_another(view)
        if rng.random() < config.augment.mixed_again:
            view = with_another(view)
    return view


def _pitch_deg(gravity: Floats) -> float:
    """Angle below the horizon of the optical axis, given ``gravity (3,)`` in the camera frame."""
    return float(np.degrees(np.arcsin(np.clip(gravity[2], -1.0, 1.0))))


def canonical_depth(view: View, config: ViewConfig) -> Floats32:
    """Depth ``(rows, columns)`` in metres at the canonical focal length; 0 if unknown or out of range."""
    known = (view.depth_m >= config.min_depth_m) & (view.depth_m <= config.max_depth_m)
    factor = np.float32(view.focal_px / CANONICAL_FOCAL_PX)
    return np.where(known, view.depth_m / factor, 0.0).astype(np.float32)
