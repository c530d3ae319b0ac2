# SPDX-License-Identifier: Apache-2.0
"""Importing Open3D."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from slamdepth import open3d_loader
from slamdepth.errors import SlamdepthError


def test_open3d_is_imported_once_from_many_threads_of_a_fresh_process() -> None:
    code = (
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from slamdepth.open3d_loader import import_open3d\n"
        "with ThreadPoolExecutor(4) as pool:\n"
        "    modules = list(pool.map(lambda _: import_open3d(), range(8)))\n"
        "assert all(m is modules[0] for m in modules)\n"
        "modules[0].t.geometry.RaycastingScene()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_importing_the_loader_imports_no_open3d() -> None:
    code = "import sys, slamdepth.open3d_loader; assert 'open3d' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_missing_open3d_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(SlamdepthError, match="pip install"), ThreadPoolExecutor(1) as pool:
        pool.submit(open3d_loader.import_open3d).result()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux needs libusb")
@pytest.mark.parametrize("system_has_it", [True, False])
def test_the_systems_libusb_is_preferred_to_the_packaged(
    monkeypatch: pytest.MonkeyPatch, system_has_it: bool
) -> None:
    loaded = []

    def load(name: str, mode: int = 0) -> None:
        if name == "libusb-1.0.so.0" and not system_has_it:
            raise OSError("no such file")
        loaded.append((name, mode))

    monkeypatch.setattr(ctypes, "CDLL", load)
    open3d_loader._preload_libusb()
    ((name, mode),) = loaded
    assert mode == ctypes.RTLD_GLOBAL
    assert (name == "libusb-1.0.so.0") == system_has_it
    assert "libusb" in name
