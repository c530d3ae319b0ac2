# SPDX-License-Identifier: Apache-2.0
"""Files in and out: cameras, TUM trajectories, images, point clouds, text, JSON and checksums."""

from __future__ import annotations

from slamdepth.io.camera import write_camera
from slamdepth.io.hashing import sha256_of
from slamdepth.io.images import (
    decode_image,
    decode_image_rgb,
    metres_of_raw,
    read_depth_file,
    read_depth_m,
    read_depth_raw,
    read_image_rgb,
    write_depth_mm,
    write_npy,
    write_png,
)
from slamdepth.io.outputs import results_folder, writable, writable_file
from slamdepth.io.ply import encode_ply, write_point_cloud
from slamdepth.io.text import parse_float, read_json, read_lines, replacing, write_json, write_text
from slamdepth.io.trajectory import TrajectoryWriter, format_timestamp, write_tum_trajectory
from slamdepth.io.trajectory_reader import read_trajectory_pair, read_tum_trajectory

__all__ = [
    "TrajectoryWriter",
    "decode_image",
    "decode_image_rgb",
    "encode_ply",
    "format_timestamp",
    "metres_of_raw",
    "parse_float",
    "read_depth_file",
    "read_depth_m",
    "read_depth_raw",
    "read_image_rgb",
    "read_json",
    "read_lines",
    "read_trajectory_pair",
    "read_tum_trajectory",
    "replacing",
    "results_folder",
    "sha256_of",
    "writable",
    "writable_file",
    "write_camera",
    "write_depth_mm",
    "write_json",
    "write_npy",
    "write_png",
    "write_point_cloud",
    "write_text",
    "write_tum_trajectory",
]
