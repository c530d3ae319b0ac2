# SPDX-License-Identifier: Apache-2.0
"""Runs as processes of their own: job and result are JSON files, and a crash is a result too."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.rows import Row
from slamdepth.pipeline.options import RunOptions

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Job:
    """One task of a worker process.

    Attributes:
        kind: measure a run, or predict depth for later runs.
        pace: ``"sequence"`` gives no frame before its timestamp, ``"fast"`` gives each at once.
        cache: folder of the predictions of kind ``"predict"``.
        depth_folder: folder of predictions that replace the depth of the frames.
        vocabulary: file of ORB-SLAM3's vocabulary.
    """

    sequence: str
    row: Row
    kind: Literal["run", "predict"] = "run"
    pace: Literal["sequence", "fast"] = "sequence"
    stride: int = 1
    max_frames: int | None = None
    cache: str | None = None
    depth_folder: str | None = None
    vocabulary: str | None = None

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Job:
        """The job that ``dataclasses.asdict`` turned into ``values``."""
        return cls(**{**values, "row": Row(**values["row"])})

    def indices(self, frames: int) -> range:
        """The frames to play of a sequence of ``frames`` frames."""
        return RunOptions(Path(self.sequence), max_frames=self.max_frames, stride=self.stride).indices(frames)


def run_job(job: Job, *, timeout_s: float | None = None) -> dict[str, Any]:
    """Run a job in a fresh process and wait for it.

    Args:
        timeout_s: seconds after which the process is stopped.

    Returns:
        The result; ``status`` is "ok", "failed" or "not installed", the latter two with a ``message`` of
        one line.
    """
    with tempfile.TemporaryDirectory(prefix="slam-benchmark-") as name:
        folder = Path(name)
        job_file, result_file, log_file = folder / "job.json", folder / "result.json", folder / "log.txt"
        job_file.write_text(json.dumps(asdict(job)), encoding="utf-8")
        command = [sys.executable, "-m", "benchmarks.worker", str(job_file), str(result_file)]
        with open(log_file, "wb") as log:
            try:
                code = subprocess.run(
                    command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=log, timeout=timeout_s, check=False
                ).returncode
            except subprocess.TimeoutExpired:
                return {"status": "failed", "message": f"stopped after {timeout_s:g} s"}
        if result_file.is_file():  # even if a peer crashed afterwards, in its destructor
            try:
                return dict(json.loads(result_file.read_text(encoding="utf-8")))
            except ValueError:
                pass
        return {"status": "failed", "message": _reason(code, log_file)}


def _reason(code: int, log_file: Path) -> str:
    lines = log_file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = f": {lines[-1].strip()}" if lines else ""
    if code < 0:
        try:
            return f"crashed with {signal.Signals(-code).name}{last}"
        except ValueError:
            return f"crashed with signal {-code}{last}"
    return f"ended with code {code}{last}"
