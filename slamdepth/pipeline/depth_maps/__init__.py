# SPDX-License-Identifier: Apache-2.0
"""From images or a video to depth maps in files: numbers, colour images, point clouds."""

from __future__ import annotations

from slamdepth.pipeline.depth_maps.job import make_depth_maps
from slamdepth.pipeline.depth_maps.options import DepthMapOptions, DepthMapResult, DepthMapsInterrupted

__all__ = ["DepthMapOptions", "DepthMapResult", "DepthMapsInterrupted", "make_depth_maps"]
