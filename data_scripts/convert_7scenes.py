#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Convert a sequence of 7-Scenes (Microsoft Research, non-commercial) to the TUM layout.

    python data_scripts/convert_7scenes.py redkitchen/seq-01 redkitchen_seq-01_tum [--link]

Times are the frame number over 30 Hz. Depth stays in millimetres, which ``camera.yaml``
says; 65535, unknown in 7-Scenes, becomes 0. Invalid poses are left out.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tum_layout import SourceFrame, run_converter, write_sequence

from slamdepth.datasets.readers.sevenscenes import UNKNOWN_RAW_DEPTH, SevenScenesReader
from slamdepth.datasets.registry import open_dataset
from slamdepth.datasets.sequence import ImageSequence
from slamdepth.errors import DatasetError


def convert(source: Path, output: Path, link: bool = False) -> int:
    """Convert ``source``; returns the number of frames.

    Raises:
        SlamdepthError: ``source`` is no 7-Scenes sequence, or ``output`` cannot be written.
    """
    dataset = open_dataset(source)
    if not isinstance(dataset, ImageSequence) or not SevenScenesReader().matches(source):
        raise DatasetError(f"{source}: is no 7-Scenes sequence; it needs {SevenScenesReader.needs}")
    frames = [
        SourceFrame(image_path.name.partition(".")[0], float(time_s), image_path, depth_path)
        for time_s, image_path, depth_path in zip(
            dataset.timestamps_s, dataset.image_paths, dataset.depth_paths, strict=True
        )
    ]
    write_sequence(
        output, frames, dataset.camera, dataset.ground_truth, link=link, unknown_raw=UNKNOWN_RAW_DEPTH
    )
    return len(frames)


def main(argv: list[str] | None = None) -> int:
    """Run the script; returns its exit code."""
    return run_converter(__doc__, convert, argv)


if __name__ == "__main__":
    sys.exit(main())
