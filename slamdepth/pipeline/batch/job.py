# SPDX-License-Identifier: Apache-2.0
"""One run of a batch: its command, its process, and what became of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from slamdepth.errors import DatasetError
from slamdepth.pipeline.checkpoint import read_begun
from slamdepth.pipeline.folder import as_argument

LOGS = "logs"
_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_LOOK_EVERY_S = 0.1
_PATIENCE_S = 10.0  # from the polite signals to the one that cannot be refused

# Asks Linux to end this process with the one that started it, then becomes the command.
_WITH_PARENT = """
import os, sys
if sys.platform == "linux":
    import ctypes
    ctypes.CDLL(None).prctl(1, 9)
os.execv(sys.executable, [sys.executable, "-m", "slamdepth", *sys.argv[1:]])
"""


class State(str, Enum):
    """What became of a run of a batch."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True)
class Job:
    """One run of a batch.

    Attributes:
        name: of its folder in that of the batch.
        arguments: of ``slamdepth run``: the recording, then options.
        output: folder of the batch.
        may_go_on: a half run in the folder is of the same arguments, so that it need not start again.
    """

    name: str
    arguments: tuple[str, ...]
    output: Path
    may_go_on: bool = False

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.output / self.name

    @property
    def log(self) -> Path:
        """What the run printed."""
        return self.output / LOGS / f"{self.name}.log"

    def command(self) -> list[str]:
        """The command line of the run: from its last checkpoint, else from the start."""
        if self.may_go_on and _is_half(self.folder):
            given = ["run", "--resume", str(self.folder)]
        else:
            recording, *options = self.arguments
            given = ["run", as_argument(recording), *options, "--output", str(self.folder), "--overwrite"]
        return [sys.executable, "-c", _WITH_PARENT, *given]


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes:
        error: of a run that failed, in one line.
        wall_s: seconds that it took; None where it was not run this time.
    """

    state: State
    error: str = ""
    wall_s: float | None = None


def run_job(
    job: Job, cores: Collection[int], stop: threading.Event, *, threads: int | None = None
) -> Outcome:
    """Run a job in a process of its own, to its end.

    Args:
        cores: processors that it may use; none: any.
        stop: set it to end the process.
        threads: that native libraries start. Default: one for each of ``cores``.
    """
    job.log.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    with job.log.open("wb") as log:
        process = subprocess.Popen(
            job.command(),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **thread_limits(len(cores) if threads is None else threads)},
            start_new_session=True,  # Ctrl-C at the terminal is ours to pass on
        )
        if cores and hasattr(os, "sched_setaffinity"):
            with suppress(OSError):  # it has ended already
                os.sched_setaffinity(process.pid, cores)
        while process.poll() is None:
            if stop.wait(_LOOK_EVERY_S):
                _end(process)
    wall_s = time.monotonic() - started
    if process.returncode == 0 and is_finished(job.folder):
        return Outcome(State.DONE, wall_s=wall_s)
    if stop.is_set():
        return Outcome(State.STOPPED, "stopped before its end", wall_s)
    return Outcome(State.FAILED, failure(job.log, process.returncode), wall_s)


def thread_limits(count: int) -> dict[str, str]:
    """Environment by which native libraries start ``count`` threads; none where it is 0."""
    return {name: os.environ.get(name, str(count)) for name in _THREAD_LIMITS} if count else {}


def share_cores(jobs: int) -> list[list[int]]:
    """The processors of each of ``jobs`` jobs at a time: equal parts, one at least; unlimited for one job."""
    available = getattr(os, "sched_getaffinity", None)
    cores: Sequence[int] = sorted(available(0)) if available else range(os.cpu_count() or 1)
    if jobs == 1:
        return [[]]
    each = max(1, len(cores) // jobs)
    return [[cores[(n * each + k) % len(cores)] for k in range(each)] for n in range(jobs)]


def is_finished(folder: Path) -> bool:
    """True where a run came to its end and was not interrupted."""
    report = read_report(folder)
    return report is not None and not report.get("options", {}).get("interrupted", False)


def _is_half(folder: Path) -> bool:
    """True where a run was begun and did not come to its end."""
    try:
        return read_begun(folder) is not None
    except DatasetError:  # damaged, or of another version
        return False


def read_report(folder: Path) -> dict[str, Any] | None:
    """``report.json`` of a run; None where there is none that can be read."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return report if isinstance(report, dict) else None


def failure(log: Path, code: int) -> str:
    """Why a run failed, in one line: its own last error, or the signal that ended it."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"ended by {name}" + (": out of memory?" if name == "SIGKILL" else "")
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    said = [line.strip() for line in lines if line.strip()]
    return (errors or said or [f"ended with exit code {code}"])[-1]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a run at once: after the first signal alone it would finish with the frames it has."""
    deadline = time.monotonic() + _PATIENCE_S
    for number in (signal.SIGTERM, signal.SIGTERM):
        if process.poll() is None:
            process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
    with suppress(subprocess.TimeoutExpired):
        process.wait(max(0.0, deadline - time.monotonic()))
    if process.poll() is None:
        process.kill()
        process.wait()
