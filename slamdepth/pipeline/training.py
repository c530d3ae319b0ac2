# SPDX-License-Identifier: Apache-2.0
"""Training of a depth head from settings, with a report folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slamdepth.pipeline.training_data import sequence_readers
from slamdepth.training.config import TrainConfig
from slamdepth.training.progress import Progress, silent

if TYPE_CHECKING:
    from slamdepth.depth.dinov2 import DinoV2
    from slamdepth.training.plan import TrainingPlan
    from slamdepth.training.results import TrainResult
    from slamdepth.training.search import SearchResult


def report_folder(output: Path) -> Path:
    """The folder of plots and figures for the head file ``output``."""
    return output.with_name(f"{output.stem}_training")


def run_training(
    config: TrainConfig, *, device: str = "cpu", progress: Progress = silent, backbone: DinoV2 | None = None
) -> TrainResult:
    """Train the head of ``config`` and write its report to :func:`report_folder`.

    Places may be of every layout in ``slamdepth.datasets``. For arguments and errors see
    :func:`slamdepth.training.loop.train_depth`.
    """
    from slamdepth.report.training import write_training_report
    from slamdepth.training.loop import train_depth

    settings = config.model_dump(mode="json")
    return train_depth(
        config,
        device=device,
        progress=progress,
        backbone=backbone,
        readers=sequence_readers(),
        on_result=lambda result: write_training_report(report_folder(result.output), result, settings),
    )


def plan_run(config: TrainConfig, *, device: str = "cpu", backbone: DinoV2 | None = None) -> TrainingPlan:
    """Estimate the cost of :func:`run_training`; see :func:`slamdepth.training.plan.plan_training`."""
    from slamdepth.training.plan import plan_training

    return plan_training(config, device=device, backbone=backbone, readers=sequence_readers())


def run_search(
    config: TrainConfig,
    trials: int,
    *,
    device: str = "cpu",
    progress: Progress = silent,
    backbone: DinoV2 | None = None,
) -> SearchResult:
    """Search the settings of ``config``; see :func:`slamdepth.training.search.search_settings`."""
    from slamdepth.training.search import search_settings

    return search_settings(
        config, trials, device=device, progress=progress, backbone=backbone, readers=sequence_readers()
    )
