# SPDX-License-Identifier: Apache-2.0
"""The viewer in a browser, by viser (extra ``viewer``): a finished run, or one while it runs."""

from __future__ import annotations

from slamdepth.viewer.live import LiveView
from slamdepth.viewer.run_view import RunView
from slamdepth.viewer.server import address_of, start_server, stop_server

__all__ = ["LiveView", "RunView", "address_of", "start_server", "stop_server"]
