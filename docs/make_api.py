# SPDX-License-Identifier: Apache-2.0
"""The API reference: one HTML page made from the docstrings of what ``slamdepth`` exports.

python docs/make_api.py     (``make docs``; needs the extra ``docs``)
"""

from __future__ import annotations

import sys
from pathlib import Path

import pdoc

import slamdepth

OUTPUT = Path(__file__).resolve().parent / "api"


def main() -> int:
    """Write the page into ``docs/api/``."""
    for name in slamdepth.__all__:
        vars(slamdepth)[name] = getattr(slamdepth, name)  # pdoc does not see names that are imported lazily
    pdoc.render.configure(docformat="google", include_undocumented=False, show_source=False)
    pdoc.pdoc("slamdepth", output_directory=OUTPUT)
    print(OUTPUT / "slamdepth.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
