# SPDX-License-Identifier: Apache-2.0
"""Common parts of the converters: write a sequence in TUM layout, whole or not at all."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets import write_camera
from slamdepth.errors import DatasetError, OutputError, SlamdepthError
from slamdepth.io import format_timestamp, read_depth_raw, write_text, write_tum_trajectory
from slamdepth.types import Camera, Trajectory


@dataclass(frozen=True)
class SourceFrame:
    """One frame to convert; names in the output come from ``name``."""

    name: str
    timestamp_s: float
    image_path: Path
    depth_path: Path | None


def write_sequence(
    output: Path,
    frames: Sequence[SourceFrame],
    camera: Camera,
    ground_truth: Trajectory | None,
    *,
    link: bool,
    unknown_raw: Sequence[int] = (),
) -> None:
    """Write ``rgb.txt depth.txt groundtruth.txt camera.yaml`` and the images.

    Args:
        output: folder to make; it must not exist or be empty.
        frames: in order of time.
        camera: goes to ``camera.yaml``; depth keeps its raw units.
        ground_truth: camera-to-world poses, or None.
        link: link to the original images instead of copying them.
        unknown_raw: raw depth values that become 0, the only unknown value of the TUM layout; such an
            image is encoded again, without loss.

    Raises:
        DatasetError: the output folder has something in it.
        OutputError: it cannot be written; nothing is left behind.
        ImageDecodeError: a depth image does not decode.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise DatasetError(f"{output}: is there already and not empty; delete it or name another folder")
    staging = output.with_name(f".{output.name}.converting")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        (staging / "rgb").mkdir(parents=True)
        if any(frame.depth_path for frame in frames):
            (staging / "depth").mkdir()
        colour_lines, depth_lines = ["# timestamp filename\n"], ["# timestamp filename\n"]
        for frame in frames:
            time = format_timestamp(frame.timestamp_s)
            target = f"rgb/{frame.name}{frame.image_path.suffix}"
            _place(frame.image_path, staging / target, link)
            colour_lines.append(f"{time} {target}\n")
            if frame.depth_path is not None:
                target = f"depth/{frame.name}{frame.depth_path.suffix}"
                if not _write_without(unknown_raw, frame.depth_path, staging / target):
                    _place(frame.depth_path, staging / target, link)
                depth_lines.append(f"{time} {target}\n")
        write_text(staging / "rgb.txt", "".join(colour_lines))
        if len(depth_lines) > 1:
            write_text(staging / "depth.txt", "".join(depth_lines))
        if ground_truth is not None:
            write_tum_trajectory(staging / "groundtruth.txt", ground_truth)
        write_camera(staging / CAMERA_FILE, camera)
        staging.replace(output)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _place(source: Path, target: Path, link: bool) -> None:
    if link:
        target.symlink_to(source.resolve())
    else:
        shutil.copyfile(source, target)


def _write_without(unknown_raw: Sequence[int], source: Path, target: Path) -> bool:
    """Write ``source`` with ``unknown_raw`` values set to 0; False, and no file, if it has none."""
    if not unknown_raw:
        return False
    raw = read_depth_raw(source)
    unknown = np.isin(raw, unknown_raw)
    if not unknown.any():
        return False
    ok, data = cv2.imencode(".png", np.where(unknown, np.uint16(0), raw))
    assert ok
    target.write_bytes(data.tobytes())
    return True


def run_converter(
    description: str | None, convert: Callable[[Path, Path, bool], int], argv: list[str] | None
) -> int:
    """Command line of a converter: ``SOURCE OUTPUT [--link]``; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="folder to convert")
    parser.add_argument("output", type=Path, help="folder to make")
    parser.add_argument(
        "--link",
        action="store_true",
        help="link to the original images instead of copying; 'slamdepth run' then needs --follow-links",
    )
    args = parser.parse_args(argv)
    try:
        count = convert(args.source, args.output, args.link)
    except SlamdepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{args.output}: {count} frames")
    return 0
