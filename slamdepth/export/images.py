# SPDX-License-Identifier: Apache-2.0
"""The images of an export and their camera: undistorted, or as the recording has them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.dense.frames import velocity_at
from slamdepth.dense.rectify import Rectifier
from slamdepth.errors import DatasetError
from slamdepth.export.scene import ExportScene, View
from slamdepth.frontend.rolling_shutter import at_middle_row, inverse_depth, row_phase
from slamdepth.geometry import invert, transform
from slamdepth.types import Camera
from slamdepth.typing import Bools, Bytes, Floats, Ints

if TYPE_CHECKING:
    from slamdepth.datasets import Dataset

_SAME_TIME_S = 1e-6
_FEW = 8  # observations of an inverse depth


class ImageMode(str, Enum):
    """Which images an export holds."""

    UNDISTORTED = "undistorted"
    RAW = "raw"
    NONE = "none"


@dataclass(frozen=True)
class Window:
    """The part of an undistorted image that shows something everywhere: ``[top:bottom, left:right]``."""

    left: int
    top: int
    right: int
    bottom: int


class ExportImages:
    """Images of a scene, and where the keypoints are in them.

    Undistorted images are those of a pinhole camera with a global shutter: lens distortion is removed, and
    the rolling shutter as far as the camera's motion tells it at the scene's usual distance. They are cropped
    to the part where all pixels have a source. They have the size of the recording, which may be larger than
    what was tracked.

    Args:
        scene: what is exported.
        dataset: the recording; None where images are not asked for and the scene knows its camera.
        mode: which images.

    Attributes:
        camera: of the exported images; integer pixel centres.
        magnification: pixels of the exported images in one of those that were tracked.

    Raises:
        DatasetError: there is no recording, and the camera is unknown; or it is another recording.
    """

    def __init__(self, scene: ExportScene, dataset: Dataset | None, mode: ImageMode) -> None:
        self._scene, self._dataset, self.mode = scene, dataset, mode
        self._rows = {time_s: row for row, time_s in enumerate(scene.trajectory.timestamps_s.tolist())}
        self._full = self._full_camera()
        self._tracked = scene.camera or self._full
        self.magnification = self._full.width / self._tracked.width
        self._inverse_depth = _usual_inverse_depth(scene)
        self._rectifier = Rectifier(self._full, scene.readout_s)
        self.camera, self._window = self._exported_camera()

    def image(self, view: View) -> Bytes:
        """The image of a view, ``(H, W, 3)`` uint8 RGB of the exported camera.

        Raises:
            DatasetError: the recording has no frame of this time.
            ImageDecodeError: the frame does not decode.
        """
        assert self._dataset is not None
        image_rgb = self._dataset.read_original(self.index(view)).image_rgb
        if self._window is None:
            return image_rgb
        at = self._window
        image = self._rectifier.color(
            image_rgb, self._rectifier.positions(self._velocity(view), self._inverse_depth)
        )
        return np.ascontiguousarray(image[at.top : at.bottom, at.left : at.right])

    def keypoints(self, view: View) -> tuple[Floats, Bools]:
        """Pixels ``(N, 2)`` of a view's keypoints in its exported image, and which of them it shows."""
        raw = self._at_full_size(view.keypoints_px)
        if self._window is None:
            return raw, np.ones(len(raw), np.bool_)
        px, velocity = self._full.undistort_points(raw), self._velocity(view)
        if velocity is not None and self._scene.readout_s:
            inverse = np.full(len(px), self._inverse_depth)
            phase, pinhole = row_phase(raw, self._full), self._full.without_distortion()
            px = at_middle_row(pinhole, px, phase, inverse, velocity, self._scene.readout_s)
        px = px - [self._window.left, self._window.top]
        size = [self.camera.width - 0.5, self.camera.height - 0.5]
        shown = np.asarray(((px >= -0.5) & (px < size)).all(axis=1), np.bool_)
        return px, shown

    def project(self, view: View, points_w: Floats) -> tuple[Floats, Bools]:
        """Pixels ``(M, 2)`` of points in the exported image, and which lie in front of the camera."""
        import cv2

        points_c = transform(invert(view.T_world_camera), points_w)
        ahead: Bools = points_c[:, 2] > 0
        if len(points_c) == 0:
            return np.zeros((0, 2)), ahead
        safe = np.where(ahead[:, None], points_c, [0.0, 0.0, 1.0])
        zero = np.zeros(3)
        px, _ = cv2.projectPoints(safe, zero, zero, self.camera.K, self.camera.distortion_array)
        return np.asarray(px[:, 0], np.float64), ahead

    def index(self, view: View) -> int:
        """Number of a view's frame in the recording.

        Raises:
            DatasetError: it has no frame of this time.
        """
        assert self._dataset is not None
        times_s = self._dataset.timestamps_s
        at = (
            int(np.clip(np.searchsorted(times_s, view.timestamp_s), 1, len(times_s) - 1))
            if len(times_s) > 1
            else 0
        )
        near = min((max(at - 1, 0), at), key=lambda k: abs(float(times_s[k]) - view.timestamp_s))
        if abs(float(times_s[near]) - view.timestamp_s) > _SAME_TIME_S:
            raise DatasetError(
                f"{self._dataset.path}: has no frame of {view.timestamp_s:.6f} s, which the run has a pose "
                "of: name the recording of this run by --recording"
            )
        return near

    def _full_camera(self) -> Camera:
        if self._dataset is not None and self._scene.views:
            return self._dataset.read_original(self.index(self._scene.views[0])).camera
        if self._scene.camera is None:
            raise DatasetError("the camera of this run is in its recording only: name it by --recording")
        return self._scene.camera

    def _at_full_size(self, px: Floats) -> Floats:
        factor = [self._full.width / self._tracked.width, self._full.height / self._tracked.height]
        return (px + 0.5) * factor - 0.5

    def _velocity(self, view: View) -> Floats | None:
        row = self._rows.get(view.timestamp_s)
        return None if row is None else velocity_at(self._scene.trajectory, row)

    def _exported_camera(self) -> tuple[Camera, Window | None]:
        if self.mode is ImageMode.RAW:
            return self._full, None
        at = _sound_window(self._rectifier)
        pinhole = self._full.without_distortion()
        cropped = replace(
            pinhole,
            width=at.right - at.left,
            height=at.bottom - at.top,
            cx=pinhole.cx - at.left,
            cy=pinhole.cy - at.top,
        )
        return cropped, at


def _usual_inverse_depth(scene: ExportScene) -> float:
    """Median 1/m of the landmarks in the views; 0, where only turning matters, without landmarks."""
    found = []
    for view in scene.views:
        rows: Ints = view.point_rows[view.point_rows >= 0]
        if len(rows) >= _FEW:
            found.append(np.median(inverse_depth(invert(view.T_world_camera), scene.points_m[rows])))
    return float(np.median(found)) if found else 0.0


def _sound_window(rectifier: Rectifier) -> Window:
    """The largest part found whose pixels all come from inside the raw image, for a camera at rest.

    The side with the largest share of pixels without a source is given up first.
    """
    width, height = rectifier.raw.width, rectifier.raw.height
    positions = rectifier.positions(None, 0.0)
    left, top, right, bottom = 0, 0, width, height
    if positions is None:
        return Window(left, top, right, bottom)
    x, y = positions[..., 0], positions[..., 1]
    lost = ~((x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5))
    while right - left > 1 and bottom - top > 1:
        shares = (
            lost[top:bottom, left].mean(),
            lost[top, left:right].mean(),
            lost[top:bottom, right - 1].mean(),
            lost[bottom - 1, left:right].mean(),
        )
        worst = int(np.argmax(shares))
        if shares[worst] == 0:
            break
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    return Window(left, top, right, bottom)
