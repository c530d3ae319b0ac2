# SPDX-License-Identifier: Apache-2.0
"""Figures as PNG, or as inline SVG in the colours of the page, light or dark.

Only matplotlib's object-oriented API is used: no pyplot, no global figure state. SVG is drawn in placeholder
colours, which are replaced by CSS variables in the finished file.
"""

from __future__ import annotations

import html
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamdepth.io import replacing

if TYPE_CHECKING:
    from collections.abc import Iterable

INK, MUTED, RULE = "#010101", "#020202", "#030303"
ESTIMATE, TRUTH, SCALED, GOOD, WARN, BAD = "#040404", "#050505", "#060606", "#070707", "#080808", "#090909"

_CSS_NAMES = {
    INK: "ink",
    MUTED: "muted",
    RULE: "rule",
    ESTIMATE: "estimate",
    TRUTH: "truth",
    SCALED: "scaled",
    GOOD: "good",
    WARN: "warn",
    BAD: "bad",
}
_STYLE = {
    "svg.fonttype": "none",
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "text.color": INK,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "path.simplify_threshold": 0.2,
}


def styled(name: str) -> Any:
    """Context in which a figure is drawn and turned into SVG; ``name`` makes its ids unique."""
    import matplotlib

    return matplotlib.rc_context({**_STYLE, "svg.hashsalt": name})


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[Any, Any]:
    """A figure of ``width`` x ``height`` inches and its ``(rows, columns)`` array of axes."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **layout)


def legend_above(axes: Any, columns: int = 4, handles: Iterable[Any] | None = None) -> None:
    """A one-line legend above the right end of ``axes``, where no curve crosses it."""
    options = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": columns, "borderpad": 0.1}
    if handles is None:
        axes.legend(**options)
    else:
        axes.legend(handles=list(handles), **options)


def to_png(figure: Any, dpi: int = 120) -> bytes:
    """The figure as a PNG file, without the version of matplotlib in it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def write_png(figure: Any, path: Path) -> None:
    """Write the figure to ``path``.

    Raises:
        OutputError: the file cannot be written.
    """
    with replacing(path) as partial:
        partial.write_bytes(to_png(figure))


def to_svg(figure: Any, description: str) -> str:
    """The figure as an ``<svg>`` element for a page, named ``description`` to screen readers."""
    buffer = io.StringIO()
    unsigned = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, dpi=144, metadata=unsigned)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<style type="text/css">.*?</style>', "", svg, count=1, flags=re.DOTALL)
    svg = re.sub(r"font-family: [^;\"]*;?", "", svg)
    svg = re.sub(r"font: ([0-9.]+)px [^;\"]*", r"font-size: \1px", svg)
    for colour, name in _CSS_NAMES.items():
        svg = svg.replace(colour, f"var(--{name})")
    size = re.search(r'width="([0-9.]+)pt" height="[0-9.]+pt" ', svg[:600])
    if size:
        svg = svg.replace(size.group(0), f'style="width: {float(size.group(1)) / 72 * 96:.0f}px" ', 1)
    label = html.escape(description, quote=True)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
