# SPDX-License-Identifier: Apache-2.0
"""Maps on disk: what a run leaves in ``RUN/map/``, and what other runs go on from."""

from __future__ import annotations

from slamdepth.mapstore.map import Map, Session, remove_map

__all__ = ["Map", "Session", "remove_map"]
