# SPDX-License-Identifier: Apache-2.0
"""The only place that imports Open3D.

Open3D's wheels link against ``libusb-1.0.so.0``, which a bare Linux does not have. The
``libusb-package`` wheel carries that library; it is loaded before Open3D. Elsewhere, and where the
system has its own, nothing is preloaded.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import sys
import threading
from typing import Any

from slamdepth.errors import SlamdepthError

logger = logging.getLogger(__name__)

_LIBUSB = "libusb-1.0.so.0"
_lock = threading.Lock()


def import_open3d() -> Any:
    """Import Open3D, with libusb in place; returns the module. Safe to call from any thread.

    Raises:
        SlamdepthError: Open3D is not installed or one of its libraries is missing.
    """
    with _lock:
        if "open3d" not in sys.modules and sys.platform.startswith("linux"):
            _preload_libusb()
        try:
            return importlib.import_module("open3d")
        except (ImportError, OSError) as error:
            raise SlamdepthError(
                f"Open3D cannot be imported ({error}); 'pip install open3d-cpu libusb-package' installs "
                "what it needs on Linux x86-64, 'pip install open3d' elsewhere"
            ) from error


def _preload_libusb() -> None:
    """Load ``libusb-1.0.so.0`` into the process, where one is installed."""
    try:
        ctypes.CDLL(_LIBUSB, mode=ctypes.RTLD_GLOBAL)
        return
    except OSError:
        pass  # no system library: take the packaged one
    try:
        libusb_package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        # Not fatal by itself: a build of Open3D without camera support does not need it.
        logger.debug("libusb could not be preloaded: %s", error)
