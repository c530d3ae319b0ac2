# SPDX-License-Identifier: Apache-2.0
"""Hyper-parameter search on held-out places with Optuna (Akiba et al., KDD 2019).

The sampler of each trial is seeded by the number of finished trials, so a search that was killed and
resumed makes the same trials as one that was not.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from slamdepth.errors import ConfigError, OutputError
from slamdepth.io import write_text
from slamdepth.training.caches import Encoder, open_encoder, plan_caches
from slamdepth.training.config import SEARCHABLE, SearchRange, TrainConfig, digest
from slamdepth.training.data import PlaceReader
from slamdepth.training.loop import train_depth
from slamdepth.training.output import check_output
from slamdepth.training.progress import Progress, silent
from slamdepth.training.results import TrainResult
from slamdepth.training.store import locked

if TYPE_CHECKING:
    from slamdepth.depth.dinov2 import DinoV2

logger = logging.getLogger(__name__)

FIGURE = "abs_rel_frame_median"
"""The score of a trial: AbsRel after median scaling per view, mean over the held-out places."""

_DIVERGED = 1e3
_HELD_OUT = "held_out"


@dataclass(frozen=True)
class Trial:
    """One training of a search.

    Attributes:
        number: counted from 0.
        settings: the values tried, by dotted name.
        score: mean of :data:`FIGURE` over the held-out places; lower is better.
        held_out: all figures of each held-out place.
    """

    number: int
    settings: dict[str, float]
    score: float
    held_out: dict[str, dict[str, float]]


@dataclass(frozen=True)
class SearchResult:
    """All trials in order, the best of them, and the files."""

    trials: tuple[Trial, ...]
    best: Trial
    best_config: Path
    study: Path


def search_settings(
    config: TrainConfig,
    trials: int,
    *,
    device: str = "cpu",
    progress: Progress = silent,
    backbone: DinoV2 | None = None,
    readers: Mapping[str, PlaceReader] | None = None,
) -> SearchResult:
    """Train with settings drawn from ``config.search`` until ``trials`` trials are done.

    Trials of an earlier call count: the same call resumes a search that was killed, and a larger
    number extends one. A trial trains one member. Two files are written to the folder of the output:
    ``<stem>_search.sqlite3``, the study, and ``<stem>_best.yaml``, ``config`` with the best settings.

    Args:
        backbone, readers: see :func:`~slamdepth.training.loop.train_depth`.

    Raises:
        ConfigError: Optuna is not installed, no setting is to be searched, no place is held out, or
            a range exceeds that of its setting.
        DatasetError, WeightsError, OutputError: see :func:`~slamdepth.training.loop.train_depth`.
    """
    _check(config)
    optuna = _optuna()
    output = check_output(config)
    study_file = output.with_name(f"{output.stem}_search.sqlite3")
    folder = output.with_name(f"{output.stem}_search")
    encoder = Encoder(backbone) if backbone is not None else open_encoder(config.backbone, device)
    planned = plan_caches(config, encoder.key, readers)
    with locked(folder):
        name = digest(config, [plan.folder.name for plan in planned])
        study = _open_study(optuna, study_file, name)
        while (number := len(_finished(optuna, study))) < trials:
            study.sampler = optuna.samplers.TPESampler(seed=config.seed * 100_003 + number)
            trial = study.ask()
            tried = {key: _suggest(trial, key, where) for key, where in config.search.items()}
            settings = with_settings(config, tried).model_copy(
                update={
                    "output": str(folder / f"trial_{number:04d}.safetensors"),
                    "search": {}, "members": 1, "uncertainty": "own",
                }
            )  # fmt: skip

            def record(result: TrainResult, trial: Any = trial) -> None:
                trial.set_user_attr(_HELD_OUT, json.dumps(result.held_out))
                study.tell(trial, _score(result.held_out))

            stage = f"trial {number + 1} of {trials}: "
            done = train_depth(
                settings,
                device=device,
                progress=lambda step, stage=stage: progress(replace(step, stage=stage + step.stage)),  # type: ignore[misc]
                backbone=backbone,
                readers=readers,
                on_result=record,
            )
            done.output.unlink(missing_ok=True)
            logger.info("trial %d: %s gave %.4f", number, tried, _score(done.held_out))
        table = tuple(
            Trial(number, dict(t.params), float(t.value), json.loads(t.user_attrs[_HELD_OUT]))
            for number, t in enumerate(_finished(optuna, study))
        )
    best = min(table, key=lambda trial: trial.score)
    best_config = output.with_name(f"{output.stem}_best.yaml")
    _write_best(best_config, config, best, len(table))
    return SearchResult(table, best, best_config, study_file)


def with_settings(config: TrainConfig, values: Mapping[str, float]) -> TrainConfig:
    """``config`` with the settings ``values``, given by dotted name.

    Raises:
        ConfigError: a value is out of range. The message names its setting.
    """
    tree = config.model_dump(mode="json")
    for name, value in values.items():
        *sections, key = name.split(".")
        branch = tree
        for section in sections:
            branch = branch[section]
        branch[key] = value
    return TrainConfig.from_dict(tree, origin="search")


def _check(config: TrainConfig) -> None:
    if not config.search:
        raise ConfigError(
            "setting 'search': names no setting to tune; give ranges there, such as "
            "'learning_rate: {low: 5e-4, high: 5e-3, log: true}'"
        )
    if not any(source.held_out for source in config.sources):
        raise ConfigError("setting 'sources': a search needs a place under 'held_out' to score by")
    for name, where in config.search.items():
        for value in where.choices or (where.low, where.high):
            assert value is not None
            if SEARCHABLE[name] and value != int(value):
                raise ConfigError(f"setting 'search.{name}': must be whole numbers, got {value:g}")
            with_settings(config, {name: value})


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise ConfigError("a search needs Optuna: install it with pip install 'slamdepth[search]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _open_study(optuna: Any, file: Path, name: str) -> Any:
    """The study ``name`` in ``file``. A trial that was running when a search was killed is marked failed."""
    try:
        storage = optuna.storages.RDBStorage(f"sqlite:///{file}")
        study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True)
        for trial in study.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    except Exception as error:  # sqlite, SQLAlchemy and Optuna have no common base
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise OutputError(f"{file}: cannot be used as a study: {reason}; delete or move it") from error
    earlier = len(_finished(optuna, study))
    if earlier:
        logger.warning("%s: resuming after %d trials", file, earlier)
    return study


def _finished(optuna: Any, study: Any) -> list[Any]:
    return list(study.get_trials(states=(optuna.trial.TrialState.COMPLETE,)))


def _suggest(trial: Any, name: str, where: SearchRange) -> float:
    is_whole = SEARCHABLE[name]
    if where.choices is not None:
        choices = [int(value) if is_whole else value for value in where.choices]
        return float(trial.suggest_categorical(name, choices))
    assert where.low is not None
    assert where.high is not None
    if is_whole:
        return int(trial.suggest_int(name, int(where.low), int(where.high), log=where.log))
    return float(trial.suggest_float(name, where.low, where.high, log=where.log))


def _score(held_out: dict[str, dict[str, float]]) -> float:
    figures = [place.get(FIGURE, math.inf) for place in held_out.values()]
    score = sum(figures) / len(figures)
    return score if math.isfinite(score) else _DIVERGED


def _write_best(path: Path, config: TrainConfig, best: Trial, trials: int) -> None:
    settings = with_settings(config, best.settings).model_dump(mode="json", exclude_none=True)
    settings.pop("search")
    places = ", ".join(best.held_out)
    header = (
        f"# The best of {trials} trials, number {best.number}: {FIGURE} {best.score:.4f} on {places}.\n"
        "# It was selected on these places, so figures on them are no longer a test.\n"
        f"#   slamdepth train-depth {path.name}\n"
    )
    write_text(path, header + yaml.safe_dump(settings, sort_keys=False))
