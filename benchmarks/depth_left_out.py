# SPDX-License-Identifier: Apache-2.0
"""Train a depth head once without each place of its training data and judge it on that place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.depth_judged import judged_row
from slamdepth.depth.base import DepthModel
from slamdepth.errors import ConfigError
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.data import data_folder

DEFAULT_CONFIG = Path(__file__).resolve().parents[1] / "slamdepth/training/configs/dinov2_head_frozen.yaml"
"""The settings of the heads that the shipped ones were adapted from."""


def places_of(base: TrainConfig) -> tuple[str, ...]:
    """The places that can be left out: those of the first source."""
    return tuple(place.name for place in base.sources[0].places)


def unmixed(base: TrainConfig) -> TrainConfig:
    """``base`` with one head and without the sources that mix views of several places.

    The features of a place are then the same whichever other place is left out, and are computed once.

    Raises:
        ConfigError: all sources mix views.
    """
    sources = tuple(
        source.model_copy(update={"members": None})
        for source in base.sources
        if not (source.augment or base.view.augment).mixed
    )
    if not sources:
        raise ConfigError("the settings have no source whose views are not mixed")
    return base.model_copy(update={"sources": sources, "members": 1})


def config_without(
    base: TrainConfig,
    left_out: str | None,
    output: Path,
    *,
    samples: int | None = None,
    changes: Mapping[str, Any] | None = None,
) -> TrainConfig:
    """``base`` without one place, or with all of them.

    Each place becomes a source of its own, so that its cached features serve all trainings; the ``limit`` of
    a source is spread over its places. With fewer members than ``base`` has, the first ones are trained, and
    sources that only the others learn from are dropped. Uncertainty is the members' own: learning it out of
    fold would take one more training for each place.

    Args:
        samples: the most views of a place.
        changes: other settings by name.

    Raises:
        ConfigError: ``left_out`` is no place of ``base``, or a setting is out of range.
    """
    if left_out is not None and left_out not in places_of(base):
        raise ConfigError(f"'{left_out}' cannot be left out; there are: {', '.join(places_of(base))}")
    count = (changes or {}).get("members", base.members)
    sources = []
    for source in base.sources:
        members = None if source.members is None else [m for m in source.members if m < count]
        if members == []:
            continue
        total = sum(place.samples for place in source.places)
        share = min(1.0, source.limit / total) if source.limit else 1.0
        for place in source.places:
            if source.folder == base.sources[0].folder and place.name == left_out:
                continue
            views = max(1, round(place.samples * share))
            views = views if samples is None else min(views, samples)
            one = {**place.model_dump(), "samples": views}
            sources.append(
                {**source.model_dump(), "places": [one], "members": members, "held_out": [], "limit": None}
            )
    values = {**base.model_dump(), **(changes or {}), "sources": sources, "output": str(output)}
    values |= {"trained_on": "", "uncertainty": "own"}
    return TrainConfig.from_dict(values, origin="benchmarks.depth")


def left_out_rows(
    base: TrainConfig,
    folder: Path,
    places: Sequence[str],
    unseen: Sequence[Path],
    *,
    train: Callable[[TrainConfig], object],
    load: Callable[[Path], DepthModel],
    samples: int | None = None,
    changes: Mapping[str, Any] | None = None,
    stride: int | None = None,
    max_frames: int | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Train without each of ``places`` and judge on it; train on all and judge on ``unseen``.

    Args:
        folder: of the trained heads and their figures; what is there is not computed again.
        unseen: data that shows none of the places.
        train: trains and writes the head to ``config.output``.
        load: makes a model of a head's file.
        samples, changes: as of :func:`config_without`.
        stride, max_frames: as of :func:`~benchmarks.depth_judged.judged_row`.

    Returns:
        The rows of the places, and those of ``unseen``.

    Raises:
        ConfigError: one of ``places`` is no place of ``base``, or a setting is out of range.
        DatasetError: there is no data to judge on.
    """
    root = data_folder(base.sources[0].folder).resolve()
    of_places: list[dict[str, Any]] = []
    of_unseen: list[dict[str, Any]] = []
    for left_out in (*places, *([None] if unseen else [])):
        label = f"without-{left_out}" if left_out else "all-places"
        config = config_without(base, left_out, Path(label), samples=samples, changes=changes)
        key = digest(config)
        head = folder / f"{label}-{key}.safetensors"

        def make(config: TrainConfig = config, head: Path = head) -> DepthModel:
            if not head.is_file():
                train(TrainConfig.from_dict({**config.model_dump(), "output": str(head)}))
            return load(head)

        for path in [root / left_out] if left_out else unseen:
            data = path.resolve()
            row = judged_row(
                folder / f"{label}@{data.name}.json", label, make, data, {"training": key},
                stride=stride, max_frames=max_frames,
            )  # fmt: skip
            (of_places if left_out else of_unseen).append(row)
    return of_places, of_unseen
