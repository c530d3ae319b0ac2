# SPDX-License-Identifier: Apache-2.0
"""A batch: which runs are still to be done, who does them, and the table of all at the end."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamdepth.datasets.addresses import without_secret
from slamdepth.errors import ConfigError, OutputError
from slamdepth.io import write_json
from slamdepth.pipeline.batch.cluster import check_ray, run_on_cluster
from slamdepth.pipeline.batch.inputs import Recording
from slamdepth.pipeline.batch.job import Job, Outcome, State, is_finished, read_report
from slamdepth.pipeline.batch.local import run_here
from slamdepth.pipeline.folder import make_folder, writable_folder
from slamdepth.report.batch import batch_row, write_batch_page

TABLE = "batch.json"
PAGE = "batch.html"


@dataclass(frozen=True)
class BatchProgress:
    """State of a batch, whenever a run starts or ends.

    Attributes:
        name: of the run.
        outcome: what became of it.
        ended, total: runs.
        running: names of those that run now.
    """

    name: str
    outcome: Outcome
    ended: int
    total: int
    running: tuple[str, ...]


def run_batch(
    recordings: Sequence[Recording],
    output: str | Path,
    *,
    jobs: int = 1,
    options: Sequence[str] = (),
    ray: str | None = None,
    progress: Callable[[BatchProgress], None] | None = None,
    stop: threading.Event | None = None,
) -> dict[str, Any]:
    """Run many recordings, each with ``slamdepth run`` in a process of its own.

    A run that fails stops no other. A batch that is given again goes on where it stopped: runs that came to
    their end with the same options are not repeated, half ones go on from their last checkpoint, failed ones
    are done again. ``batch.json`` and ``batch.html`` in ``output`` are written anew whenever a run ends.

    Args:
        recordings: what to run, see :func:`find_recordings`.
        output: folder of the batch; each run has a folder of its own in it.
        jobs: runs at a time, each on its share of the processors.
        options: of ``slamdepth run``, for all.
        ray: address of a Ray cluster, or ``"local"``; None: processes of this machine.
        progress: called when a run starts and when it ends, from any thread.
        stop: set it to end the runs in progress and to start no more.

    Returns:
        The content of ``batch.json``.

    Raises:
        ConfigError: ``jobs`` is below 1, or Ray is asked for and not installed.
        OutputError: ``output`` is no folder of a batch, or cannot be written.
    """
    if jobs < 1:
        raise ConfigError(f"the number of jobs must be 1 or more, got {jobs}")
    if ray is not None:
        check_ray()
    folder = writable_folder(Path(output))
    before = _earlier(folder)
    make_folder(folder)
    batch = _Batch(folder, recordings, tuple(options), before, progress or (lambda state: None))
    batch.write()
    stopped = stop or threading.Event()
    if ray is None:
        run_here(batch.to_do, jobs, batch.tell, stopped)
    else:
        run_on_cluster(batch.to_do, jobs, ray, batch.tell, stopped)
    return batch.write(with_page=True)


class _Batch:
    """The jobs of a batch and what is known of each; :meth:`tell` may be called from any thread."""

    def __init__(
        self,
        folder: Path,
        recordings: Sequence[Recording],
        options: tuple[str, ...],
        before: dict[str, dict[str, Any]],
        progress: Callable[[BatchProgress], None],
    ) -> None:
        self._folder, self._progress = folder, progress
        self._lock = threading.Lock()
        names = _names(recordings, options, before, folder)
        self._jobs = [
            _job(name, (one.path, *options, *one.options), folder.absolute(), before.get(name, {}))
            for name, one in zip(names, recordings, strict=True)
        ]
        self._outcomes = {job.name: self._known(job, before) for job in self._jobs}
        self._reused = [name for name, outcome in self._outcomes.items() if outcome.state is State.DONE]

    @staticmethod
    def _known(job: Job, before: dict[str, dict[str, Any]]) -> Outcome:
        entry = before.get(job.name, {})
        same = tuple(entry.get("arguments", ())) == _shown(job.arguments)
        if same and entry.get("state") == State.DONE.value and is_finished(job.folder):
            return Outcome(State.DONE, wall_s=entry.get("wall_s"))
        return Outcome(State.WAITING)

    @property
    def to_do(self) -> list[Job]:
        """The jobs that have not come to their end."""
        return [job for job in self._jobs if self._outcomes[job.name].state is not State.DONE]

    def tell(self, job: Job, outcome: Outcome) -> None:
        """Take note of a job that starts or ends."""
        with self._lock:
            self._outcomes[job.name] = outcome
            if outcome.state is not State.RUNNING:
                self._write(with_page=True)
            states = [one.state for one in self._outcomes.values()]
            running = [name for name, one in self._outcomes.items() if one.state is State.RUNNING]
            ended = sum(state not in (State.WAITING, State.RUNNING) for state in states)
            self._progress(BatchProgress(job.name, outcome, ended, len(states), tuple(running)))

    def write(self, *, with_page: bool = False) -> dict[str, Any]:
        """Write ``batch.json``, and ``batch.html``; returns the content of the former."""
        with self._lock:
            return self._write(with_page=with_page)

    def _write(self, *, with_page: bool) -> dict[str, Any]:
        runs = [self._entry(job) for job in self._jobs]
        counts = {state.value: sum(run["state"] == state.value for run in runs) for state in State}
        content = {"format": 1, "counts": counts, "not_repeated": self._reused, "runs": runs}
        write_json(self._folder / TABLE, content)
        if with_page:
            write_batch_page(self._folder / PAGE, content)
        return content

    def _entry(self, job: Job) -> dict[str, Any]:
        outcome = self._outcomes[job.name]
        report = read_report(job.folder) if outcome.state is State.DONE else None
        return {
            "name": job.name,
            "state": outcome.state.value,
            "error": outcome.error or None,
            "arguments": list(_shown(job.arguments)),
            "wall_s": outcome.wall_s,
            **batch_row(report),
        }


def _job(name: str, arguments: tuple[str, ...], output: Path, entry: dict[str, Any]) -> Job:
    """A job; it goes on with what a stopped or killed batch left, not with what failed."""
    is_same = tuple(entry.get("arguments", ())) == _shown(arguments)
    return Job(name, arguments, output, is_same and entry.get("state") != State.FAILED.value)


def _earlier(folder: Path) -> dict[str, dict[str, Any]]:
    """The runs of an earlier batch in the folder, by name.

    Raises:
        OutputError: the folder holds something else.
    """
    path = folder / TABLE
    if not path.exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise OutputError(f"{folder}: is not empty and holds no earlier batch; name a new folder")
        return {}
    try:
        runs = json.loads(path.read_text(encoding="utf-8"))["runs"]
        return {str(run["name"]): dict(run) for run in runs}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OutputError(
            f"{path}: is damaged ({error}); name a new folder, the runs in this one stay"
        ) from error


def _names(
    recordings: Sequence[Recording], options: tuple[str, ...], before: dict[str, dict[str, Any]], folder: Path
) -> list[str]:
    """A folder name for each recording: the one it had before, else its own, made unique.

    A folder that another recording had, now or earlier, is never given away.
    """
    had: dict[tuple[str, ...], list[str]] = {}
    for name, entry in before.items():
        arguments = tuple(map(str, entry.get("arguments", ())))
        for key in (arguments, arguments[:1]):
            had.setdefault(key, []).append(name)
    names: dict[int, str] = {}
    for is_exact in (True, False):  # with the same options first, then with others
        for number, one in enumerate(recordings):
            key = _shown((one.path, *options, *one.options) if is_exact else (one.path,))
            free = [name for name in had.get(key, ()) if name not in names.values()]
            if number not in names and free:
                names[number] = free[0]
    taken = {*before, *names.values()}
    for number, one in enumerate(recordings):
        if number in names:
            continue
        stem = _stem(one.path)
        name, count = stem, 2
        while name in taken or (folder / name).exists():
            name, count = f"{stem}-{count}", count + 1
        names[number] = name
        taken.add(name)
    return [names[number] for number in range(len(recordings))]


def _shown(arguments: tuple[str, ...]) -> tuple[str, ...]:
    """Arguments as ``batch.json`` has them: without what is secret in the address of a live source."""
    return (without_secret(arguments[0]), *arguments[1:])


def _stem(path: str) -> str:
    """A folder name for a recording."""
    place = Path(without_secret(path))
    stem = place.name if place.is_dir() else place.stem
    stem = stem or place.resolve().name
    safe = "".join(c if c.isalnum() or c in "._-" else "-" for c in stem).strip(".-")
    return safe if safe and safe != "logs" else "run"
