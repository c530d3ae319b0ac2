# SPDX-License-Identifier: Apache-2.0
"""Jobs in processes of this machine."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from slamdepth.pipeline.batch.job import Job, Outcome, State, run_job, share_cores


def run_here(
    jobs: Sequence[Job],
    at_a_time: int,
    tell: Callable[[Job, Outcome], None],
    stop: threading.Event,
) -> None:
    """Run every job, ``at_a_time`` of them at once, each on its share of the processors.

    Args:
        tell: called when a job starts (its state is RUNNING) and when it ends, from any thread.
        stop: set it to end those that run, and to start no more.
    """
    shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    for cores in share_cores(at_a_time):
        shares.put(cores)

    def work(job: Job) -> None:
        if stop.is_set():
            return
        cores = shares.get()
        try:
            tell(job, Outcome(State.RUNNING))
            tell(job, run_job(job, cores, stop))
        except OSError as error:
            tell(job, Outcome(State.FAILED, f"could not be started: {error}"))
        finally:
            shares.put(cores)

    with ThreadPoolExecutor(at_a_time, thread_name_prefix="slamdepth-batch") as pool:
        waiting = [pool.submit(work, job) for job in jobs]
        try:
            for one in waiting:
                one.result()
        except BaseException:
            stop.set()  # such as a second Ctrl-C: no process is left behind
            raise
