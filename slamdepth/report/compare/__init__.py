# SPDX-License-Identifier: Apache-2.0
"""Runs side by side: figures, paths over one another, a table and a page."""

from __future__ import annotations

from slamdepth.report.compare.comparison import Comparison, compare_runs
from slamdepth.report.compare.page import build_compare_html, compare_table

__all__ = ["Comparison", "build_compare_html", "compare_runs", "compare_table"]
