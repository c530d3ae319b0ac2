# SPDX-License-Identifier: Apache-2.0
"""How many cores a thread may use."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any


@lru_cache(maxsize=1)
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit NumPy's and SciPy's BLAS to one thread inside.

    For small matrices two spend more time waiting than working, and sums then do not depend
    on the number of cores.
    """
    return _controller().limit(limits=1, user_api="blas")


def one_thread_here() -> None:
    """From now on parallel loops of native code started by the calling thread stay in it.

    OpenMP, which torch computes with, keeps the number for each thread that starts a loop,
    so that other threads are not concerned.
    """
    from threadpoolctl import ThreadpoolController

    ThreadpoolController().limit(limits=1, user_api="openmp")
