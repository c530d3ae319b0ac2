# SPDX-License-Identifier: Apache-2.0
"""One BLAS thread for small matrices: two spend more time waiting than working."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any


@lru_cache(maxsize=1)
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit NumPy's and SciPy's BLAS to one thread inside; sums then do not depend on the number of cores."""
    return _controller().limit(limits=1, user_api="blas")
