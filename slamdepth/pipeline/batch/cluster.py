# SPDX-License-Identifier: Apache-2.0
"""Jobs on a Ray cluster (the extra ``ray``), whose machines share the folders of input and output.

A worker that dies takes its run with it, and Ray starts the job again elsewhere; the half run is replaced.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any

from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.pipeline.batch.job import Job, Outcome, State, run_job

LOCAL = "local"
_RETRIES = 3
_LOOK_EVERY_S = 0.5


def check_ray() -> None:
    """Refuse to go on without Ray.

    Raises:
        ConfigError: it is not installed.
    """
    if importlib.util.find_spec("ray") is None:
        raise ConfigError("--ray needs the package 'ray': pip install 'slamdepth[ray]'")


def run_on_cluster(
    jobs: Sequence[Job],
    at_a_time: int,
    address: str,
    tell: Callable[[Job, Outcome], None],
    stop: threading.Event,
) -> None:
    """Run every job on a Ray cluster; see :func:`slamdepth.pipeline.batch.local.run_here`.

    Args:
        address: of the cluster, such as ``ray://host:10001`` or ``auto``; ``local`` starts one here.
        at_a_time: jobs at once on one machine: each asks for its share of the processors.

    Raises:
        ConfigError: Ray is not installed.
        SlamdepthError: there is no cluster at the address.
    """
    check_ray()
    import ray

    was_running = ray.is_initialized()
    if not was_running:
        try:
            ray.init(
                address=None if address == LOCAL else address,
                log_to_driver=False,
                logging_level=logging.ERROR,
                include_dashboard=False if address == LOCAL else None,
            )
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise SlamdepthError(f"{address}: no Ray cluster answers: {error}") from error
    try:
        _run(ray, jobs, at_a_time, tell, stop)
    finally:
        if not was_running:
            ray.shutdown()


def _run(
    ray: Any, jobs: Sequence[Job], at_a_time: int, tell: Callable[[Job, Outcome], None], stop: threading.Event
) -> None:
    cores = max(
        1, int(min(node["Resources"].get("CPU", 1) for node in ray.nodes() if node["Alive"])) // at_a_time
    )
    remote = ray.remote(num_cpus=cores, max_retries=_RETRIES)(_work)
    waiting = {remote.remote(job, cores): job for job in jobs}
    for job in jobs:
        tell(job, Outcome(State.RUNNING))
    while waiting and not stop.is_set():
        ready, _ = ray.wait(list(waiting), timeout=_LOOK_EVERY_S)
        for one in ready:
            job = waiting.pop(one)
            try:
                tell(job, ray.get(one))
            except ray.exceptions.RayError as error:
                first = str(error).strip().partition("\n")[0]
                tell(job, Outcome(State.FAILED, f"Ray lost it {_RETRIES + 1} times: {first}"))
    for one, job in waiting.items():
        ray.cancel(one, force=True)
        tell(job, Outcome(State.STOPPED, "stopped before its end"))


def _work(job: Job, cores: int) -> Outcome:
    """On a worker: run one job with so many threads, for which Ray has set processors aside."""
    return run_job(job, (), threading.Event(), threads=cores)
