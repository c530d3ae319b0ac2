# SPDX-License-Identifier: Apache-2.0
"""Which features a training needs, and the folders they are cached in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2, load_dinov2, working_type
from slamdepth.errors import ConfigError
from slamdepth.training.config import Teaches, TrainConfig, ViewConfig, digest
from slamdepth.training.data import Place, PlaceReader, data_folder, open_place
from slamdepth.training.features import FeatureCache, build_cache
from slamdepth.training.progress import Progress, silent
from slamdepth.training.views import Partner, SampleKey, plan_plain, plan_samples

_JUDGED_VIEWS = 50
_T = TypeVar("_T")
_VIEW_VERSION = 4
"""Counts up where the same settings make other views or features."""


@dataclass(frozen=True)
class PlannedCache:
    """One cache before it is filled: a source's samples, or the plain views of a held-out place.

    Attributes:
        folder: where it is kept; its name hashes all that decides on its content.
        keys: its samples, in order.
        view: how they are made.
        members: heads that learn from it; None where all do.
        partners: what is mixed into them: all places that are trained on.
        held_out: name of the place where it is for judging, else None.
        teaches: what is learnt from it.
    """

    folder: Path
    places: tuple[Place, ...]
    keys: tuple[SampleKey, ...]
    view: ViewConfig
    held_out: str | None = None
    partners: tuple[Partner, ...] = ()
    members: tuple[int, ...] | None = None
    teaches: Teaches = "both"


@dataclass(frozen=True)
class Encoder:
    """A backbone whose features are cached.

    Attributes:
        backbone: frozen, in the precision it computes in.
        sha256: of its file; "given" where it came from no file.
    """

    backbone: DinoV2
    sha256: str = "given"

    @property
    def key(self) -> str:
        """Differs where features do: bfloat16 rounds otherwise than float32."""
        return f"{self.sha256} {self.backbone.cls_token.dtype}"


def open_encoder(file: str | None, device: str = "cpu") -> Encoder:
    """The backbone of ``file`` (default: the cached one), in the precision ``device`` is best at.

    Raises:
        WeightsError: it is missing or damaged.
    """
    path = store.find_backbone(file)
    sha256 = store.verify(path)
    return Encoder(load_dinov2(path, device).to(working_type(device)), sha256)


def plan_caches(
    config: TrainConfig, encoder_key: str, readers: Mapping[str, PlaceReader] | None = None
) -> list[PlannedCache]:
    """Open every place of ``config`` and say what is to be computed of it.

    A source that no member learns from is opened, since its places may be mixed into
    others, but has no cache.

    Args:
        encoder_key: of the backbone whose features they are, see :class:`Encoder`.
        readers: readers beside those of :mod:`slamdepth.training.readers`.

    Raises:
        ConfigError: a place is both trained on and held out, or none is trained on.
        DatasetError: a place is missing or malformed.
    """
    roots = [data_folder(source.folder) for source in config.sources]
    both = list(zip(roots, config.sources, strict=True))
    trained = {(root / place.name).resolve() for root, source in both for place in source.places}
    judged = {(root / name).resolve() for root, source in both for name in source.held_out}
    if trained & judged:
        raise ConfigError(f"setting 'sources': {min(trained & judged).name} is held out and also trained on")
    for member in range(config.members):
        teachers = [source for source in config.sources if source.places and source.teaches != "down"]
        if not any(_teaches(source.members, member) for source in teachers):
            raise ConfigError(f"setting 'sources': there is no place to train on for member {member}")

    def where(view: ViewConfig, places: tuple[Place, ...], *more: object) -> Path:
        made_of = [place.fingerprint for place in places]
        name = digest(view, _VIEW_VERSION, config.head.taps, config.seed, encoder_key, made_of, *more)
        return store.cache_dir() / "features" / name

    planned = []
    for folder, source in both:
        if not source.places:
            continue
        places = tuple(open_place(folder / place.name, source.reader, readers) for place in source.places)
        keys = plan_samples(places, [place.samples for place in source.places], config.seed)[: source.limit]
        view = config.view
        if source.augment is not None:
            view = view.model_copy(update={"augment": source.augment})
        planned.append(
            PlannedCache(
                where(view, places, source.places, source.limit),
                places,
                tuple(keys),
                view,
                members=source.members,
                teaches=source.teaches,
            )
        )
    partners = tuple(
        Partner(place, cache.view.augment, sum(key.place == index for key in cache.keys))
        for cache in planned
        if cache.teaches != "down"
        for index, place in enumerate(cache.places)
    )
    mixing = [(p.place.fingerprint, p.augment.model_dump_json(), p.weight) for p in partners]
    planned = [
        replace(
            cache,
            partners=partners,
            folder=cache.folder.with_name(digest(cache.view, cache.folder.name, mixing)),
        )
        if cache.view.augment.mixed
        else cache
        for cache in planned
        if any(_teaches(cache.members, member) for member in range(config.members))
    ]
    for folder, source in both:
        for name in source.held_out:
            place = open_place(folder / name, source.reader, readers)
            keys = plan_plain(0, place, _JUDGED_VIEWS)
            planned.append(
                PlannedCache(where(config.view, (place,), "plain"), (place,), tuple(keys), config.view, name)
            )
    return planned


def _teaches(members: tuple[int, ...] | None, member: int) -> bool:
    return members is None or member in members


def of_member(planned: Sequence[PlannedCache], each: Sequence[_T], member: int) -> list[_T]:
    """Of what there is ``each`` planned cache, what belongs to those that ``member`` is trained on."""
    return [
        one
        for plan, one in zip(planned, each, strict=True)
        if plan.held_out is None and plan.teaches != "down" and _teaches(plan.members, member)
    ]


def of_gravity(planned: Sequence[PlannedCache], each: Sequence[_T]) -> list[_T]:
    """The same of what the network learns from that finds out which way is down: views as they were
    taken but for how they are turned."""
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
    """Compute what is missing of ``planned``; errors of :func:`build_cache`."""
    cache = build_cache(
        planned.folder, planned.places, planned.keys, planned.view, backbone, config.head.taps, config.seed,
        device=device, partners=planned.partners, progress=progress, stage=stage,
    )  # fmt: skip
    return replace(cache, teaches=planned.teaches)


def benchmarks_seen(planned: list[PlannedCache]) -> dict[str, tuple[str, ...]]:
    """The benchmarks a head trained on ``planned`` has seen, each with the places of it."""
    seen: dict[str, tuple[str, ...]] = {}
    for cache in planned:
        for place in cache.places if cache.held_out is None else ():
            if place.benchmark is not None:
                seen[place.benchmark] = (*seen.get(place.benchmark, ()), place.name)
    return seen
