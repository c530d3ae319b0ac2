# SPDX-License-Identifier: Apache-2.0
"""Keypoints with descriptors, spread over the image; extractors by name.

An extractor is one file in ``slamdepth/frontend/extractors/`` with a class under
``@register_extractor``; the files are imported when the first extractor is made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.errors import ConfigError, TrackingError, WeightsError
from slamdepth.frontend.matching import PixelGrid, match_all
from slamdepth.frontend.metric import ORB, DescriptorMetric, has_words, whole_words
from slamdepth.io import sha256_of
from slamdepth.registry import Registry
from slamdepth.types import Camera, WeightsInfo
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class ScaleLevels:
    """The scale levels of an extractor's keypoints.

    Attributes:
        factor: ratio of a level's size to that of the previous one.
        count: number of levels.
        growth: a keypoint's standard deviation grows with this power of its size.
    """

    factor: float
    count: int
    growth: float = 1.0

    def of(self, size: Floats) -> Ints:
        """Levels ``(N,)`` of keypoints of these sizes, 1 being the finest; may be past the last level."""
        levels: Ints = np.maximum(np.rint(np.log(size) / np.log(self.factor)), 0).astype(np.int64)
        return levels

    def sigma_px(self, octave: Ints) -> Floats:
        """Standard deviations ``(N,)`` of keypoints in pixels; one pixel at the finest level."""
        return self.sigmas_px.take(octave)

    @cached_property
    def sigmas_px(self) -> Floats:
        """:meth:`sigma_px` of each level, ``(count,)``."""
        return self.factor ** (self.growth * np.arange(self.count, dtype=np.float64))


class ImageMatcher(Protocol):
    """Matches the features of two images jointly, as LightGlue does."""

    def __call__(self, a: Features, b: Features) -> tuple[Ints, Ints]:
        """Pairs, as indices ``(P,)`` in ``a`` and ``b``, one to one."""
        ...


@dataclass(frozen=True)
class Features:
    """The keypoints of one image.

    Attributes:
        raw_px: ``(N, 2)`` float64 pixels of the image as taken.
        px: ``(N, 2)`` float64 pixels after undistortion; all geometry uses these.
        octave: ``(N,)`` int level of the extractor's :class:`ScaleLevels`, 0 the finest.
        sigma_px: ``(N,)`` float64 standard deviation of ``px``.
        descriptors: ``(N, D)``, of the width and type that ``metric`` is for.
        metric: how descriptors are compared.
        orb_descriptors: gives ORB descriptors ``(M, 32)`` of the same image, for place
            recognition; None where ``descriptors`` are ORB's.
        matcher: matches whole images; None compares descriptors pairwise.

    Raises:
        TrackingError: the descriptors are not those of the metric.
    """

    raw_px: Floats
    px: Floats
    octave: Ints
    sigma_px: Floats
    descriptors: NDArray[Any]
    metric: DescriptorMetric = ORB
    orb_descriptors: Callable[[], NDArray[np.uint8]] | None = None
    matcher: ImageMatcher | None = None

    def __post_init__(self) -> None:
        want, have = self.metric.empty(), self.descriptors
        if have.dtype != want.dtype or have.shape != (len(self.px), want.shape[1]):
            raise TrackingError(
                f"features: {len(self.px)} keypoints need descriptors ({len(self.px)}, {want.shape[1]}) "
                f"{want.dtype}, got {have.shape} {have.dtype}"
            )

    def __len__(self) -> int:
        return len(self.px)

    @cached_property
    def grid(self) -> PixelGrid:
        """``px`` in a grid of cells; cached, as a keyframe is searched many times."""
        return PixelGrid(self.px)

    @cached_property
    def words(self) -> NDArray[np.uint64] | None:
        """Descriptors as 64-bit words ``(N, W)``; None where another distance than Hamming's counts."""
        return whole_words(self.descriptors).view(np.uint64) if has_words(self.metric) else None

    @property
    def place_descriptors(self) -> NDArray[np.uint8]:
        """ORB descriptors ``(M, 32)`` of the image, for place recognition."""
        return self.descriptors if self.orb_descriptors is None else self.orb_descriptors()

    def match(self, other: Features, among: Ints, *, ratio: float) -> tuple[Ints, Ints]:
        """Match the keypoints ``among`` of this image with all of another, anywhere in it.

        Args:
            among: ``(K,)`` unique indices, ascending.
            ratio: of Lowe's test; not used where there is a ``matcher``.

        Returns:
            Pairs as indices into ``among`` and into ``other``, one to one.
        """
        if self.matcher is None:
            a, b, _ = match_all(self.descriptors[among], other.descriptors, metric=self.metric, ratio=ratio)
            return a, b
        a, b = self.matcher(self, other)
        place = np.full(len(self), -1, dtype=np.int64)
        place[among] = np.arange(len(among))
        chosen = np.flatnonzero(place[a] >= 0)
        return place[a[chosen]], b[chosen]


class FeatureExtractor(Protocol):
    """Finds features in a grey image.

    Attributes:
        levels: what ``Features.octave`` counts.
    """

    levels: ScaleLevels

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        """Features of a ``(H, W)`` uint8 image taken by ``camera``."""
        ...


ExtractorFactory = Callable[[FeatureConfig], FeatureExtractor]


class _Known(NamedTuple):
    factory: ExtractorFactory
    needs_weights: bool


EXTRACTORS: Registry[_Known] = Registry(
    "feature",
    package="slamdepth.frontend.extractors",
    unknown="features.name: no feature is called '{name}'; known: {choices}",
)


def register_extractor(
    name: str, *, needs_weights: bool = False
) -> Callable[[ExtractorFactory], ExtractorFactory]:
    """Class decorator: make an extractor available as ``features.name`` in the settings.

    Args:
        needs_weights: it is a network, whose file ``features.weights`` names.

    Raises:
        ConfigError: another feature has the name.
    """

    def register(factory: ExtractorFactory) -> ExtractorFactory:
        EXTRACTORS.add(name, _Known(factory, needs_weights), factory)
        return factory

    return register


def feature_names() -> list[str]:
    """Every name :func:`create_extractor` knows, in order."""
    return EXTRACTORS.names()


def needs_weights(name: str) -> bool:
    """Whether the feature called ``name`` is a network, whose file the settings must name.

    Raises:
        ConfigError: no extractor has that name; lists those that exist.
    """
    return EXTRACTORS.get(name).needs_weights


def create_extractor(config: FeatureConfig) -> FeatureExtractor:
    """Build the extractor that ``config.name`` names.

    Raises:
        ConfigError: no extractor has that name (lists those that exist), the installed
            OpenCV lacks it, or it needs a weights file or takes none.
        WeightsError: its weights are missing or of another layout.
    """
    known = EXTRACTORS.get(config.name)
    files = [name for name in (config.weights, config.matcher) if name is not None]
    if known.needs_weights and config.weights is None:
        raise ConfigError(
            f"feature '{config.name}' is a network: name its ONNX file with --features-weights FILE"
        )
    if files and not known.needs_weights:
        raise ConfigError(f"feature '{config.name}' takes no weights file; leave out {files[0]}")
    for file in files:
        if not Path(file).expanduser().is_file():
            raise WeightsError(f"{file}: no such file with weights of feature '{config.name}'")
    return known.factory(config)


def feature_weights(config: FeatureConfig) -> tuple[WeightsInfo, ...]:
    """The weights files that ``config`` names; what they were trained on is unknown."""
    files = [Path(name).expanduser() for name in (config.weights, config.matcher) if name is not None]
    return tuple(WeightsInfo(file.stem, sha256_of(file), "unknown", "unknown") for file in files)
