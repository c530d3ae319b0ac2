#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Convert a sequence of ICL-NUIM (Handa et al., ICRA 2014) to the TUM layout.

    python data_scripts/convert_icl_nuim.py living_room_traj0_frei_png living_room_traj0_tum [--link]

The source is an unpacked "TUM RGB-D compatible PNGs" archive: ``rgb/N.png``,
``depth/N.png``, ``associations.txt`` with ``N depth/N.png N rgb/N.png`` lines, and one
``*.gt.freiburg`` with ``N tx ty tz qx qy qz qw`` lines. There are no times in it, so the
frame number over 30 Hz is taken. The poses are of the renderer's world with y up, the
images of a camera with y down: each pose is conjugated with diag(1, -1, 1, 1).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from tum_layout import SourceFrame, run_converter, write_sequence

from slamdepth.datasets.orientation import check_size
from slamdepth.datasets.sequence import first_image
from slamdepth.errors import DatasetError
from slamdepth.io import read_lines, read_tum_trajectory
from slamdepth.types import Camera, Trajectory

FRAME_RATE_HZ = 30.0
CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5, depth_factor=5000.0, fps=FRAME_RATE_HZ)

_FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def convert(source: Path, output: Path, link: bool = False) -> int:
    """Convert ``source``; returns the number of frames.

    Raises:
        SlamdepthError: a file is missing or malformed, or ``output`` cannot be written.
    """
    if not source.is_dir():
        raise DatasetError(f"{source}: no such folder")
    frames = read_associations(source / "associations.txt")
    sample_path, sample_shape = first_image(tuple(frame.image_path for frame in frames))
    check_size(sample_path, sample_shape, CAMERA)
    write_sequence(output, frames, CAMERA, read_ground_truth(source), link=link)
    return len(frames)


def read_associations(path: Path) -> list[SourceFrame]:
    """Frames of ``N depth/N.png N rgb/N.png`` lines; the two pairs may come in either order.

    Raises:
        DatasetError: the file is missing or empty, a line is malformed, an image does not
            exist, or the numbers do not increase; names file and line.
    """
    frames: list[SourceFrame] = []
    last = -1
    for number, line in read_lines(path):
        fields = line.split()
        named = {Path(name).parent.name: path.parent / name for name in fields[1::2]}
        if len(fields) != 4 or set(named) != {"rgb", "depth"} or not fields[0].isdecimal():
            raise DatasetError(f"{path}:{number}: expected 'N depth/N.png N rgb/N.png', found {line[:80]!r}")
        for image in named.values():
            if not image.is_file():
                raise DatasetError(f"{path}:{number}: {image} does not exist")
        index = int(fields[0])
        if index <= last:
            raise DatasetError(f"{path}:{number}: frame {index} does not come after {last}")
        last = index
        frames.append(SourceFrame(f"{index:06d}", index / FRAME_RATE_HZ, named["rgb"], named["depth"]))
    if not frames:
        raise DatasetError(f"{path}: lists no images; expected 'N depth/N.png N rgb/N.png' a line")
    return frames


def read_ground_truth(source: Path) -> Trajectory | None:
    """The poses of the one ``*.gt.freiburg`` in ``source``, conjugated; None without one.

    Raises:
        DatasetError: there are several, or a line is malformed.
    """
    found = sorted(source.glob("*.gt.freiburg"))
    if not found:
        return None
    if len(found) > 1:
        raise DatasetError(f"{source}: several ground truths: {', '.join(path.name for path in found)}")
    numbered, _ = read_tum_trajectory(found[0])
    return Trajectory(numbered.timestamps_s / FRAME_RATE_HZ, _FLIP_Y @ numbered.T_world_camera @ _FLIP_Y)


def main(argv: list[str] | None = None) -> int:
    """Run the script; returns its exit code."""
    return run_converter(__doc__, convert, argv)


if __name__ == "__main__":
    sys.exit(main())
