# SPDX-License-Identifier: Apache-2.0
"""Many recordings: each run in a process of its own, here or on a Ray cluster."""

from __future__ import annotations

from slamdepth.pipeline.batch.inputs import Recording, find_recordings
from slamdepth.pipeline.batch.run import BatchProgress, run_batch

__all__ = ["BatchProgress", "Recording", "find_recordings", "run_batch"]
