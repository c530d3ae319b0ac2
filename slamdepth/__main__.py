# SPDX-License-Identifier: Apache-2.0
"""``python -m slamdepth`` is ``slamdepth``."""

from __future__ import annotations

from slamdepth.cli import main

if __name__ == "__main__":
    main()
