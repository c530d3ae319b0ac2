# SPDX-License-Identifier: Apache-2.0
"""From a sequence to a run folder: dataset, tracker, mesh, scores, report."""

from __future__ import annotations

from slamdepth.pipeline.options import RunInterrupted, RunOptions, RunProgress, RunResult, RunStage
from slamdepth.pipeline.run import run
from slamdepth.pipeline.tracking import Watcher

__all__ = ["RunInterrupted", "RunOptions", "RunProgress", "RunResult", "RunStage", "Watcher", "run"]
