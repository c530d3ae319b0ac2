# SPDX-License-Identifier: Apache-2.0
"""Versions and hardware of a run, without names of hosts, users or folders."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "torch",
    "gtsam",
    "open3d-cpu",
    "open3d",
    "kiss-icp",
    "evo",
    "matplotlib",
)
"""Packages whose version can change a result."""


def versions() -> dict[str, str | None]:
    """Versions of slamdepth, Python and the packages that can change a result.

    ``commit`` is that of the checkout slamdepth runs from, with ``+changes`` where tracked
    files differ from it, and None for an installed copy.
    """
    found: dict[str, str | None] = {
        "slamdepth": _version("slamdepth"),
        "commit": _commit(),
        "python": platform.python_version(),
    }
    found.update({name: version for name in PACKAGES if (version := _version(name))})
    return found


def hardware() -> dict[str, str | int | float | None]:
    """Processor, usable cores, memory and, where torch is loaded and sees one, the GPU."""
    return {
        "cpu": _cpu_model(),
        "cores": _usable_cores(),
        "memory_gib": _memory_gib(),
        "gpu": _gpu(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    commit = _git(root, "rev-parse", "HEAD")
    if not commit:
        return None
    return f"{commit}+changes" if _git(root, "status", "--porcelain", "--untracked-files=no") else commit


def _git(root: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _cpu_model() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or None
    names = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(names, None) or platform.processor() or None


def _usable_cores() -> int | None:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count()


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _gpu() -> str | None:
    """The GPU that torch sees, where it is loaded already: loading it takes seconds."""
    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return None
    return str(torch.cuda.get_device_name())
