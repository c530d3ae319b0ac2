# SPDX-License-Identifier: Apache-2.0
"""A run that was killed, from its last checkpoint to its end."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any

from slamdepth.config import Config
from slamdepth.datasets import ReadOptions
from slamdepth.errors import DatasetError
from slamdepth.pipeline.checkpoint import read_begun, read_latest
from slamdepth.pipeline.folder import is_run
from slamdepth.pipeline.job import Begun
from slamdepth.pipeline.options import ProgressCallback, RunOptions, RunResult
from slamdepth.pipeline.run import run_job

logger = logging.getLogger(__name__)


def is_finished(folder: str | Path) -> bool:
    """Whether a run folder holds a run that ended, so that there is nothing to go on with.

    Raises:
        DatasetError: it holds no run.
    """
    path = Path(folder).expanduser()
    if not path.is_dir() or not is_run(path):
        raise DatasetError(f"{path}: holds no run; name the folder of a run that was killed")
    return read_begun(path) is None and (path / "report.json").is_file()


def resume(
    folder: str | Path,
    *,
    sequence: str | Path | None = None,
    progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
) -> RunResult:
    """Go on with a run that was killed, as if it had never been.

    The trajectory is the same to the byte: the tracker goes on from its last checkpoint, and what follows
    tracking is done again. A run that was killed before its first checkpoint starts again.

    Args:
        folder: of the run.
        sequence: where its sequence is now. Default: where it was.
        progress, stop: as for :func:`slamdepth.run`.

    Raises:
        InputError: the folder holds no run to go on with, its checkpoint is damaged, or its sequence is
            another one.
    """
    path = Path(folder).expanduser()
    if is_finished(path):
        raise DatasetError(f"{path}: the run is finished; there is nothing to go on with")
    begun = read_begun(path)
    if begun is None:
        raise DatasetError(f"{path}: the run left nothing to go on with; start it again with --overwrite")
    options, config, about = _asked(begun, path, sequence)
    latest = read_latest(path)
    if latest is None:
        logger.warning("%s: was killed before its first checkpoint, and starts again", path)
    return run_job(options, config, progress, stop, Begun(about, latest))


def _asked(
    begun: dict[str, Any], path: Path, sequence: str | Path | None
) -> tuple[RunOptions, Config, dict[str, Any]]:
    """Options and settings of the run, and what is known of its sequence."""
    try:
        given = dict(begun["options"])
        for name in ("sequence", "camera_file", "start_map"):
            given[name] = None if given[name] is None else Path(given[name])
        given["reading"] = ReadOptions(**given["reading"])
        given["exports"] = tuple(given["exports"])
        if sequence is not None:
            given["sequence"] = Path(sequence)
        options = RunOptions(output=path, **given)
        return options, Config.from_dict(begun["config"], origin=f"{path}"), dict(begun["sequence"])
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: what the run was asked for cannot be read: {error}") from error
