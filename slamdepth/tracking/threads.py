# SPDX-License-Identifier: Apache-2.0
"""How many cores a thread may use."""

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

    From 3.8 on the first thread that sets it is the only one that may, and others do nothing without a
    word; here the first to enter and the last to leave may be two threads.
    """
    for library in _controller().lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit OpenCV, and NumPy's and SciPy's BLAS, to one thread while any thread is inside.

    For small matrices and images two spend more time waiting than working, all the more where the other
    core is predicting depth; and sums then do not depend on the number of cores. The number is the
    whole process's, so the last to leave sets it back.
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
    """From now on parallel loops of native code started by the calling thread stay in it.

    OpenMP, which torch computes with, keeps the number for each thread that starts a loop,
    so that other threads are not concerned.
    """
    from threadpoolctl import ThreadpoolController

    ThreadpoolController().limit(limits=1, user_api="openmp")
