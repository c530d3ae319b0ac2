# SPDX-License-Identifier: Apache-2.0
"""Which view of which pair a sample is, and making it; the same for the same seed."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.training.augment import View, augmented_view, matching_view, mixed_view, plain_view
from slamdepth.training.config import AugmentConfig, ViewConfig
from slamdepth.training.data import Place
from slamdepth.training.gravity import down_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PITCH_APART_DEG = 16.0
_TRIES = 40


@dataclass(frozen=True)
class SampleKey:
    """Which view of which pair a sample is; copy -1 is the plain, unaugmented view."""

    place: int
    frame: int
    copy: int


@dataclass(frozen=True)
class Partner:
    """A place whose views are mixed into others.

    Attributes:
        augment: what is done to its views.
        weight: how often it is drawn, beside the others.
    """

    place: Place
    augment: AugmentConfig
    weight: float


def plan_samples(places: Sequence[Place], samples: Sequence[int], seed: int) -> list[SampleKey]:
    """Which views to make: each place's number spread over its frames, in random order.

    A place with more frames than samples is thinned evenly; one with fewer is shown
    several times, each copy augmented anew.
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


def plan_plain(place_index: int, place: Place, limit: int) -> list[SampleKey]:
    """At most ``limit`` unaugmented views of one place, spread over it; for judging."""
    count = min(limit, len(place))
    chosen = np.linspace(0, len(place) - 1, count).round().astype(int)
    return [SampleKey(place_index, int(frame), -1) for frame in chosen]


def make_view(
    places: Sequence[Place], key: SampleKey, config: ViewConfig, seed: int, partners: Sequence[Partner] = ()
) -> View:
    """The view ``key`` names; the same for the same seed whatever else is made.

    With ``config.upright`` it is turned by its gravity, where that is known, and what is mixed into it
    shares its gravity.

    Args:
        partners: what is mixed into it, as often as ``config.augment.mixed`` says.
    """
    place = places[key.place]
    frame = place.read(key.frame)
    down = down_of(place, key.frame, frame) if config.upright else None
    if key.copy < 0:
        return plain_view(frame, config.rows, config.columns, down)
    rng = np.random.default_rng([seed, zlib.crc32(place.name.encode()), key.frame, key.copy])

    def drawn() -> tuple[Partner, int]:
        weights = np.array([partner.weight for partner in partners])
        chosen = partners[rng.choice(len(partners), p=weights / weights.sum())]
        return chosen, int(rng.integers(len(chosen.place)))

    size = config.rows, config.columns

    def with_another(view: View) -> View:
        if down is None:
            partner, index = drawn()
            return mixed_view(view, augmented_view(partner.place.read(index), *size, partner.augment, rng))
        for _ in range(_TRIES):
            partner, index = drawn()
            own = down_of(partner.place, index)
            if own is not None and abs(_pitch_deg(own) - _pitch_deg(view.down)) < _PITCH_APART_DEG:
                frame = partner.place.read(index)
                other = matching_view(frame, *size, partner.augment, rng, own, view.down)
                return mixed_view(view, other)
        return view

    view = augmented_view(frame, config.rows, config.columns, config.augment, rng, down)
    if partners and rng.random() < config.augment.mixed:
        view = with_another(view)
        if rng.random() < config.augment.mixed_again:
            view = with_another(view)
    return view


def _pitch_deg(down: NDArray[np.float64]) -> float:
    """How far a camera in whose frame gravity points along ``down (3,)`` looks below the horizon."""
    return float(np.degrees(np.arcsin(np.clip(down[2], -1.0, 1.0))))


def canonical_depth(view: View, config: ViewConfig) -> NDArray[np.float32]:
    """``(rows, columns)`` depth at the canonical focal length; 0 where unknown or out of range."""
    known = (view.depth_m >= config.min_depth_m) & (view.depth_m <= config.max_depth_m)
    factor = np.float32(view.focal_px / CANONICAL_FOCAL_PX)
    return np.where(known, view.depth_m / factor, 0.0).astype(np.float32)
