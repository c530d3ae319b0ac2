# SPDX-License-Identifier: Apache-2.0
"""The benchmark of kills: which stages it kills a run in, and when."""

from __future__ import annotations

import random
import signal
import time
from collections import Counter

import pytest

from benchmarks.kills import Kill, in_a_child, next_kills, stage_of
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage

LENGTHS_S = {"opening": 0.4, "tracking, first half": 2.0, "optimising": 0.6, "scoring": 0.001, "report": 5.0}


def test_kills_are_spread_evenly_over_the_stages() -> None:
    rng, tried = random.Random(0), Counter[str]()
    for _ in range(10):
        kills = next_kills(LENGTHS_S, tried, 2, rng)
        stages = [kill.stage for kill in kills]
        assert stages == sorted(stages, key=list(LENGTHS_S).index)
        assert all(0.0 <= kill.after_s <= LENGTHS_S[kill.stage] for kill in kills)
        tried.update(stages)
    assert tried == {stage: 5 for stage in LENGTHS_S if stage != "scoring"}


def test_tracking_counts_as_two_stages() -> None:
    stages = [stage_of(RunProgress(RunStage.TRACKING, done, 300)) for done in (0, 149, 150, 300)]
    assert stages == ["tracking, first half"] * 2 + ["tracking, second half"] * 2
    assert stage_of(RunProgress(RunStage.MESHING)) == "meshing"


def _work(tell: ProgressCallback) -> None:
    for stage in (RunStage.OPTIMISING, RunStage.MESHING, RunStage.REPORTING):
        tell(RunProgress(stage))
        time.sleep(0.2)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_process_is_killed_in_the_stage_that_was_asked_for() -> None:
    killed = in_a_child(_work, Kill("meshing", 0.05))
    assert killed.code == -signal.SIGKILL
    assert [stage for stage, _ in killed.stages] == ["opening", "optimising", "meshing"]
    assert 0.05 <= killed.stages[-1][1] < 0.2


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_process_that_leaves_the_stage_too_soon_is_killed_in_the_next_one() -> None:
    killed = in_a_child(_work, Kill("optimising", 60.0))
    assert killed.code == -signal.SIGKILL
    assert [stage for stage, _ in killed.stages] == ["opening", "optimising", "meshing"]


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_process_that_never_enters_the_stage_ends_by_itself() -> None:
    ended = in_a_child(_work, Kill("scoring", 0.0))
    assert ended.code == 0
    assert [stage for stage, _ in ended.stages][-1] == "writing the report"
