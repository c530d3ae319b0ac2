# SPDX-License-Identifier: Apache-2.0
"""The report as files of a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamdepth.io import write_json, write_text
from slamdepth.report.data import ReportData
from slamdepth.report.html import build_html
from slamdepth.report.summary import build_summary


def write_report(run_folder: str | Path, data: ReportData) -> dict[str, Any]:
    """Write ``report.json`` and ``report.html`` into ``run_folder``, each whole or not at all.

    The figures are written before the page is drawn.

    Returns:
        The content of ``report.json``.

    Raises:
        OutputError: the folder cannot be written.
    """
    summary = build_summary(data)
    write_json(Path(run_folder) / "report.json", summary)
    write_text(Path(run_folder) / "report.html", build_html(data, summary))
    return summary
