# SPDX-License-Identifier: Apache-2.0
"""A loop around ``Tracker.step`` with a webcam, or with a video file in its place.

python docs/examples/webcam_loop.py 0 --camera webcam.yaml --output webcam.txt

Ctrl-C ends the loop; the trajectory of the frames so far is optimised and written.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

import slamdepth


def frames(source: str, camera: slamdepth.Camera) -> Iterator[slamdepth.Frame]:
    """Read frames until the source ends.

    Args:
        source: index of a webcam, such as ``"0"``, or a video file.
        camera: intrinsics of the source, at its resolution.
    """
    is_live = source.isdecimal()
    capture = cv2.VideoCapture(int(source)) if is_live else cv2.VideoCapture(source)
    try:
        start_s = time.monotonic()
        for index in itertools.count():
            is_decoded, image_bgr = capture.read()
            if not is_decoded:
                return
            timestamp_s = time.monotonic() - start_s if is_live else index / camera.fps
            image_rgb = np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB), np.uint8)
            yield slamdepth.Frame(index, timestamp_s, image_rgb, camera)
    finally:
        capture.release()


def track(source: str, camera: slamdepth.Camera, depth: str) -> slamdepth.Reconstruction:
    """Track until the source ends or Ctrl-C is pressed; print the camera's position of every frame."""
    model = slamdepth.create_depth_model(depth)
    with slamdepth.Tracker(camera, depth_model=model) as tracker:
        try:
            for frame in frames(source, camera):
                result = tracker.step(frame)
                if result.T_world_camera is None:
                    print(f"{result.timestamp_s:7.2f} s  {result.status.value}")
                else:
                    x, y, z = result.T_world_camera[:3, 3]
                    print(f"{result.timestamp_s:7.2f} s  {x:7.3f} {y:7.3f} {z:7.3f} m")
        except KeyboardInterrupt:
            print("stopped")
        return tracker.finish()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description="Track a webcam.")
    parser.add_argument("source", help="index of a webcam, or a video file")
    parser.add_argument("--camera", type=Path, required=True, help="camera.yaml")
    parser.add_argument("--depth", default="dinov2", help="depth model (default: dinov2)")
    parser.add_argument("--output", type=Path, default=Path("webcam.txt"), help="trajectory (TUM format)")
    options = parser.parse_args(arguments)
    try:
        camera = slamdepth.Camera.from_file(options.camera)
        reconstruction = track(options.source, camera, options.depth)
        slamdepth.write_tum_trajectory(options.output, reconstruction.trajectory)
    except slamdepth.SlamdepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{options.output}: {len(reconstruction.trajectory)} poses")
    return 0


if __name__ == "__main__":
    sys.exit(main())
