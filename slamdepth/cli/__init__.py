# SPDX-License-Identifier: Apache-2.0
"""The command line: the only place that prints or configures logging."""

from __future__ import annotations

from slamdepth.cli.app import main

__all__ = ["main"]
