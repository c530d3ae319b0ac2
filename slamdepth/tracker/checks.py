# SPDX-License-Identifier: Apache-2.0
"""What every tracker asks of a frame."""

from __future__ import annotations

from slamdepth.errors import CameraError, TrackingError
from slamdepth.types import Camera, Frame


def check_frame(frame: Frame, camera: Camera, last_time_s: float, finished: bool) -> None:
    """Refuse a frame that breaks the contract of ``Tracker.step``.

    Raises:
        TrackingError: the tracker has finished, or time does not increase.
        CameraError: the frame was taken by another camera.
    """
    if finished:
        raise TrackingError("this tracker has finished; make a new one for another sequence")
    if not frame.timestamp_s > last_time_s:
        raise TrackingError(
            f"frame {frame.index}: time must increase, got {frame.timestamp_s} s after {last_time_s} s"
        )
    if frame.camera != camera:
        raise CameraError(f"frame {frame.index} was taken by another camera than the tracker's")
