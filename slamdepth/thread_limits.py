# SPDX-License-Identifier: Apache-2.0
"""Limits on the threads that native libraries start."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

_lock = threading.Lock()
_inside = 0
_limit: Any = None
_opencv_threads = 1


@lru_cache(maxsize=1)
def _controller() -> Any:
    # it knows the libraries that are loaded by now
    import cv2  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _take_control() -> None:
    """Make the calling thread the one that threadpoolctl lets set OpenBLAS' number of threads.

    Since version 3.8 the first thread that sets it is the only one that may, and calls of others are
    ignored silently; here the first to enter and the last to leave may be two threads.
    """
    for library in _controller().lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit OpenCV, and NumPy's and SciPy's BLAS, to one thread while any thread is inside.

    On small matrices and images two threads wait more than they work, the more so while the other core
    predicts depth, and sums would depend on the number of cores. The limit applies to the whole
    process, so the last to leave restores it.
    """
    import cv2

    global _inside, _limit, _opencv_threads
    with _lock:
        if _inside == 0:
            _take_control()
            _limit = _controller().limit(limits=1, user_api="blas")
            _opencv_threads = cv2.getNumThreads()
            cv2.setNumThreads(1)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _take_control()
                _limit.restore_original_limits()
                cv2.setNumThreads(_opencv_threads)


def one_thread_here() -> None:
    """Let parallel loops of native code that the calling thread starts run in that thread alone.

    OpenMP, which torch uses, keeps the limit per thread that starts a loop; other threads are not affected.
    """
    from threadpoolctl import ThreadpoolController

    ThreadpoolController().limit(limits=1, user_api="openmp")
