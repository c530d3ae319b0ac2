# SPDX-License-Identifier: Apache-2.0
"""The feature caches that a training needs, and their folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2, load_dinov2, working_type
from slamdepth.errors import ConfigError
from slamdepth.training.config import SourceConfig, Supervision, TrainConfig, ViewConfig, digest
from slamdepth.training.data import Place, PlaceReader, data_folder, open_place, split_numbers
from slamdepth.training.features import FeatureCache, Tapped, build_cache
from slamdepth.training.progress import Progress, silent
from slamdepth.training.views import Partner, SampleKey, plan_samples, plan_unaugmented

_HELD_OUT_VIEWS = 50
_T = TypeVar("_T")
_VIEW_VERSION = 4
"""To be raised when the same settings give other views or features."""


@dataclass(frozen=True)
class PlannedCache:
    """One cache before it is filled: the samples of a source, or unaugmented views of a held-out place.

    Attributes:
        folder: where it is kept; its name is a hash of everything that determines its content.
        places: the places that ``keys`` refer to.
        keys: its samples, in order.
        view: how they are rendered.
        tapped: what of the backbone is kept.
        held_out: name of the place if it is for evaluation, else None.
        partners: places mixed into its views: all that are trained on.
        members: ensemble members trained on it; None for all.
        supervision: what its samples supervise.
    """

    folder: Path
    places: tuple[Place, ...]
    keys: tuple[SampleKey, ...]
    view: ViewConfig
    tapped: Tapped
    held_out: str | None = None
    partners: tuple[Partner, ...] = ()
    members: tuple[int, ...] | None = None
    supervision: Supervision = "both"

    @property
    def trains_depth(self) -> bool:
        """True if depth heads are trained on it."""
        return self.held_out is None and self.supervision != "gravity"


@dataclass(frozen=True)
class Encoder:
    """A backbone whose features are cached.

    Attributes:
        backbone: the frozen network, in the precision it computes in.
        sha256: hash of its weights file; "given" if it was passed in memory.
    """

    backbone: DinoV2
    sha256: str = "given"

    @property
    def key(self) -> str:
        """Identifies the features: weights and precision, since bfloat16 rounds differently from float32."""
        return f"{self.sha256} {self.backbone.cls_token.dtype}"


def open_encoder(file: str | None, device: str = "cpu") -> Encoder:
    """The backbone in ``file`` (default: the cached one), in the preferred precision of ``device``.

    Raises:
        WeightsError: it is missing or damaged.
    """
    path = store.find_backbone(file)
    sha256 = store.verify(path)
    return Encoder(load_dinov2(path, device).to(working_type(device)), sha256)


def tapped_by(config: TrainConfig) -> Tapped:
    """What a training reads of the backbone: all taps, or what comes before the first block it changes."""
    if config.adapters is None:
        return Tapped(config.head.taps)
    first = config.adapters.first
    return Tapped(tuple(tap for tap in config.head.taps if tap < first), first)


def plan_caches(
    config: TrainConfig, encoder_key: str, readers: Mapping[str, PlaceReader] | None = None
) -> list[PlannedCache]:
    """Open every place of ``config`` and determine the caches it needs.

    A source that trains no member is opened, since its places may be mixed into others, but gets no
    cache.

    Args:
        encoder_key: identifies the backbone and its precision, see :class:`Encoder`.
        readers: further readers, in addition to those of :mod:`slamdepth.training.readers`.

    Raises:
        ConfigError: a place is both trained on and held out, or a member has nothing to train on.
        DatasetError: a place is missing or malformed.
    """
    sources = [(data_folder(source.folder), source) for source in config.sources]
    _check_places(config, sources)

    whole, tapped = Tapped(config.head.taps), tapped_by(config)

    def where(view: ViewConfig, places: tuple[Place, ...], read: Tapped, *more: object) -> Path:
        fingerprints = [place.fingerprint for place in places]
        name = digest(view, _VIEW_VERSION, read, config.seed, encoder_key, fingerprints, *more)
        return store.cache_dir() / "features" / name

    training = []
    for folder, source in sources:
        if not source.places:
            continue
        places = tuple(open_place(folder / place.name, source.reader, readers) for place in source.places)
        keys = plan_samples(places, [place.samples for place in source.places], config.seed)[: source.limit]
        view = config.view
        if source.augment is not None:
            view = view.model_copy(update={"augment": source.augment})
        training.append(
            PlannedCache(
                where(view, places, tapped, source.places, source.limit),
                places,
                tuple(keys),
                view,
                tapped,
                members=source.members,
                supervision=source.supervision,
            )
        )
    held_out = []
    for folder, source in sources:
        for name in source.held_out:
            place = open_place(folder / name, source.reader, readers)
            keys = plan_unaugmented(0, place, _HELD_OUT_VIEWS)
            at = where(config.view, (place,), whole, "plain")
            held_out.append(PlannedCache(at, (place,), tuple(keys), config.view, whole, name))
    members = range(config.members)
    return [
        cache for cache in _with_partners(training) if any(_trains(cache.members, m) for m in members)
    ] + held_out


def _check_places(config: TrainConfig, sources: Sequence[tuple[Path, SourceConfig]]) -> None:
    """Raise ConfigError if a place is trained on and held out, or a member has nothing to train on."""
    trained = [folder / place.name for folder, source in sources for place in source.places]
    held_out = [folder / name for folder, source in sources for name in source.held_out]
    if both := [path.name for path in trained if any(_overlap(path, other) for other in held_out)]:
        raise ConfigError(f"setting 'sources': {min(both)} is held out and also trained on")
    depth = [source for source in config.sources if source.places and source.supervision != "gravity"]
    for member in range(config.members):
        if not any(_trains(source.members, member) for source in depth):
            raise ConfigError(f"setting 'sources': there is no place to train on for member {member}")


def _overlap(one: Path, other: Path) -> bool:
    """True if two places, each a folder or some numbers in it, have images in common."""
    (folder, numbers), (other_folder, other_numbers) = split_numbers(one), split_numbers(other)
    if folder.resolve() != other_folder.resolve():
        return False
    if numbers is None or other_numbers is None:
        return True
    return numbers[0] <= other_numbers[1] and other_numbers[0] <= numbers[1]


def _with_partners(training: Sequence[PlannedCache]) -> list[PlannedCache]:
    """The caches with partners and another folder where their views are mixed."""
    partners = tuple(
        Partner(place, cache.view.augment, sum(key.place == index for key in cache.keys))
        for cache in training
        if cache.trains_depth
        for index, place in enumerate(cache.places)
    )
    mixing = [(p.place.fingerprint, p.augment.model_dump_json(), p.weight) for p in partners]
    return [
        replace(
            cache,
            partners=partners,
            folder=cache.folder.with_name(digest(cache.view, cache.folder.name, mixing)),
        )
        if cache.view.augment.mixed
        else cache
        for cache in training
    ]


def _trains(members: tuple[int, ...] | None, member: int) -> bool:
    return members is None or member in members


def of_member(planned: Sequence[PlannedCache], each: Sequence[_T], member: int) -> list[_T]:
    """The elements of ``each``, one per planned cache, that ``member`` is trained on."""
    return [
        one
        for plan, one in zip(planned, each, strict=True)
        if plan.trains_depth and _trains(plan.members, member)
    ]


def of_gravity(planned: Sequence[PlannedCache], each: Sequence[_T]) -> list[_T]:
    """The elements of ``each``, one per planned cache, that the gravity network is trained on.

    These are the upright views that are not mixed.
    """
    return [
        one
        for plan, one in zip(planned, each, strict=True)
        if plan.held_out is None and plan.view.upright and not plan.view.augment.mixed
    ]


def fill_cache(
    planned: PlannedCache,
    config: TrainConfig,
    backbone: DinoV2,
    *,
    device: str = "cpu",
    progress: Progress = silent,
    stage: str = "features",
) -> FeatureCache:
    """Compute the missing samples of ``planned`` and open the cache.

    Raises:
        DatasetError: an image or its depth cannot be read.
        OutputError: the folder cannot be written or the disk is too small.
    """
    cache = build_cache(
        planned.folder, planned.places, planned.keys, planned.view, backbone, planned.tapped, config.seed,
        device=device, partners=planned.partners, progress=progress, stage=stage,
    )  # fmt: skip
    return replace(cache, supervision=planned.supervision)


def benchmarks_seen(planned: Sequence[PlannedCache]) -> dict[str, tuple[str, ...]]:
    """The benchmarks that a head trained on ``planned`` has seen, each with its places."""
    seen: dict[str, tuple[str, ...]] = {}
    for cache in planned:
        for place in cache.places if cache.held_out is None else ():
            if place.benchmark is not None:
                seen[place.benchmark] = (*seen.get(place.benchmark, ()), place.name)
    return seen
