# SPDX-License-Identifier: Apache-2.0
"""The value types that all packages share.

Conventions, everywhere: poses are ``(4, 4)`` float64 named ``T_world_camera`` with
``p_world = T_world_camera @ p_camera``; camera axes are x right, y down, z forward;
the world is the first camera; pixels have integer centres; depth is along z, in
metres, 0 where unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from slamdepth.calibration.wide_lens import WideLens

_UNIT_TOLERANCE = 0.01
_MIRRORED = ((-1, 0), (0, 1))
_UNTIL_SETTLED = (3, 200, 1e-9)
"""OpenCV's criteria: at most 200 steps, or an error of 1e-9 pixels."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with Brown-Conrady distortion, or one with a lens too wide for that.

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels; the centre of the top left pixel is (0, 0).
        distortion: ``(k1, k2, p1, p2, k3)`` as OpenCV orders them, or all zero; with ``k4, k5, k6`` of the
            rational model, eight.
        depth_factor: raw units of a depth image per metre.
        fps: nominal frame rate in Hz.
        lens: the lens of a camera that is no pinhole, None of others. Sequences give its images as a pinhole
            sees them (:class:`slamdepth.datasets.virtual_view.VirtualView`); what needs a pinhole refuses it.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_factor: float = 5000.0
    fps: float = 30.0
    lens: WideLens | None = None

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, self.depth_factor, self.fps, *self.distortion)
        if not all(np.isfinite(values)):
            raise CameraError("camera: intrinsics must be finite numbers")
        if self.width < 1 or self.height < 1:
            raise CameraError(f"camera: width and height must be positive, got {self.width}x{self.height}")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"camera: fx and fy must be positive, got {self.fx}, {self.fy}")
        if self.depth_factor <= 0 or self.fps <= 0:
            raise CameraError("camera: depth_factor and fps must be positive")
        if len(self.distortion) not in (5, 8):
            raise CameraError(
                "camera: distortion needs five numbers [k1, k2, p1, p2, k3], or eight with k4, k5, k6"
            )
        if self.lens is not None and self.is_distorted:
            raise CameraError("camera: a wide lens has its own coefficients, and no distortion besides")

    @classmethod
    def from_file(cls, path: str | Path, notes: list[str] | None = None) -> Camera:
        """Read a ``camera.yaml``, or a calibration of OpenCV, ROS, Kalibr, EuRoC, Basalt or ORB-SLAM.

        Args:
            notes: takes a line for whatever is unusual in the file, or that it was read from another
                format; None: these lines are logged as warnings.

        Raises:
            CameraError: the file is missing or malformed, its lens model is not supported, or no camera
                has such intrinsics; names the file, the key and the allowed ones.
        """
        from slamdepth.calibration import read_camera

        return read_camera(path, cls, notes)

    @property
    def K(self) -> NDArray[np.float64]:
        """The ``(3, 3)`` intrinsic matrix in pixels.

        Raises:
            CameraError: the camera is no pinhole, see :attr:`lens`.
        """
        self._check_pinhole()
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion_array(self) -> NDArray[np.float64]:
        """Distortion as the array ``(5,)`` or ``(8,)`` that OpenCV takes.

        Raises:
            CameraError: the camera is no pinhole, see :attr:`lens`.
        """
        self._check_pinhole()
        return np.asarray(self.distortion, dtype=np.float64)

    @property
    def is_distorted(self) -> bool:
        return any(self.distortion)

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera for images resized to ``width`` x ``height`` pixels.

        Pixel centres are integers, so ``cx' = (cx + 0.5) * sx - 0.5``.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def mirrored(self) -> Camera:
        """The camera whose images are those of this one, left and right exchanged: it sees a mirrored world
        as this one sees the world."""
        k1, k2, p1, p2, *others = self.distortion
        lens = None if self.lens is None else self.lens.turned(_MIRRORED)
        return replace(self, cx=self.width - 1 - self.cx, distortion=(k1, k2, p1, -p2, *others), lens=lens)

    def without_distortion(self) -> Camera:
        """The pinhole camera that undistorted pixels belong to.

        Raises:
            CameraError: the camera is no pinhole, see :attr:`lens`.
        """
        self._check_pinhole()
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def undistort_points(self, points_px: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map raw pixels ``(N, 2)`` to pixels ``(N, 2)`` of :meth:`without_distortion`.

        Raises:
            CameraError: the camera is no pinhole, see :attr:`lens`.
        """
        self._check_pinhole()
        points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 2)
        if not self.is_distorted or len(points) == 0:
            return np.array(points)
        import cv2

        if len(self.distortion) == 5:
            undistorted = cv2.undistortPoints(points[:, None], self.K, self.distortion_array, P=self.K)
        else:  # the rational model is for strong distortion, where OpenCV's five steps are too few
            undistorted = cv2.undistortPoints(
                points[:, None], self.K, self.distortion_array, P=self.K, criteria=_UNTIL_SETTLED
            )
        return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)

    def _check_pinhole(self) -> None:
        if self.lens is not None:
            raise CameraError(
                f"camera: a lens of the model {self.lens.model!r} is no pinhole: undistort its images to a "
                "pinhole view first, as open_dataset and VirtualView do"
            )


@dataclass(frozen=True)
class Frame:
    """One colour image of a sequence, as the camera took it (not undistorted).

    Attributes:
        index: position in its sequence.
        timestamp_s: seconds, strictly increasing over a sequence.
        image_rgb: ``(H, W, 3)`` uint8.
        camera: the camera that took it.
        depth_m: ``(H, W)`` float32 sensor depth in metres registered to the colour
            image, 0 where unknown; None where the sequence has none.
        gravity: ``(3,)`` unit direction of gravity in the camera's frame (x right, y down, z forward), as an
            accelerometer tells it; None where it is not known. Depth models may use it.
        gravity_is_guess: True where depth models may correct ``gravity`` by what the image shows.

    Raises:
        CameraError: an image is not of the camera's size, or gravity is no unit direction (to 1 %).
    """

    index: int
    timestamp_s: float
    image_rgb: NDArray[np.uint8]
    camera: Camera
    depth_m: NDArray[np.float32] | None = None
    gravity: NDArray[np.float64] | None = None
    gravity_is_guess: bool = False

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width, 3)
        if self.image_rgb.shape != expected or self.image_rgb.dtype != np.uint8:
            raise CameraError(
                f"frame {self.index}: image is {self.image_rgb.shape} {self.image_rgb.dtype}, "
                f"the camera says {expected} uint8"
            )
        if self.depth_m is not None and self.depth_m.shape != expected[:2]:
            raise CameraError(
                f"frame {self.index}: depth is {self.depth_m.shape}, the colour image {expected[:2]}"
            )
        if self.gravity is not None:
            _check_gravity(self.index, self.gravity)


def _check_gravity(index: int, gravity: NDArray[np.float64]) -> None:
    if not isinstance(gravity, np.ndarray) or gravity.shape != (3,) or gravity.dtype.kind not in "fiu":
        what = f"{gravity.shape} {gravity.dtype}" if isinstance(gravity, np.ndarray) else repr(gravity)[:60]
        raise CameraError(f"frame {index}: gravity must be an array of three numbers x y z, got {what}")
    length = float(np.linalg.norm(gravity.astype(np.float64)))
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:  # written so that NaN is refused
        raise CameraError(
            f"frame {index}: gravity must be a unit direction, its length is {length:g}: divide what the "
            "accelerometer says by its length, or leave it None"
        )


class DepthKind(str, Enum):
    """What the numbers of a depth map mean."""

    METRIC = "metric depth"
    AFFINE_DEPTH = "affine depth"
    AFFINE_INVERSE_DEPTH = "affine inverse depth"


@dataclass(frozen=True)
class DepthPrediction:
    """A dense map from a depth model, at the resolution of the frame it was made for.

    Attributes:
        values: ``(H, W)`` float32; metres for METRIC, 0 = unknown; unitless otherwise, 0 a value like others.
        kind: what ``values`` means. Only ``slamdepth.depth.alignment`` turns a
            prediction into metres of the map.
        sigma_log: ``(H, W)`` float32 standard deviation of the natural logarithm of the
            depth (about the relative error), or None where the model does not say. Without the error that
            the whole image has in common.
        is_sensor: True where the values were measured rather than predicted, so that
            their errors are independent from pixel to pixel and their scale is exact.
        gravity: direction of gravity as for :class:`Frame` that the model went by, or None.
        gravity_share: how sure the model is of it, 0 to 1; 1 where the frame brought it.
        scale_sigma_log: standard deviation of the natural logarithm of the scale error that the whole image
            has in common; infinite where the image is like nothing the model knows, None where the model
            does not say.
    """

    values: NDArray[np.float32]
    kind: DepthKind
    sigma_log: NDArray[np.float32] | None = None
    is_sensor: bool = False
    gravity: NDArray[np.float64] | None = None
    gravity_share: float = 0.0
    scale_sigma_log: float | None = None


@dataclass(frozen=True)
class WeightsInfo:
    """Where the numbers of a model come from.

    Attributes:
        name: of the file.
        sha256: of the file, or of its tensors.
        trained_on: the data.
        licence: of the weights.
        precision: what the network computes in, such as "int8"; empty where it has no choice.
    """

    name: str
    sha256: str
    trained_on: str
    licence: str
    precision: str = ""


class TrackingStatus(str, Enum):
    """State of the tracker after a frame."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    RELOCALISED = "relocalised"
    REGISTERED = "placed by registration"
    LOST = "lost"


@dataclass(frozen=True)
class StepResult:
    """What one ``Tracker.step`` says about its frame.

    Attributes:
        status: state after this frame.
        T_world_camera: ``(4, 4)``, or None where the frame could not be placed.
        inliers: number of map points that agree with the pose.
        is_keyframe: True where the frame became a keyframe.
        keyframes, loop_closures: totals so far.
        timings_ms: wall time of each stage in milliseconds.
        map_id: the map whose world frame the pose is in, numbered from 0 as maps are started. Where maps
            have been joined, that of the one that went on.
        covariance: ``(6, 6)`` of the pose, in the map's metres and radians, ``(translation, rotation)`` as in
            :func:`slamdepth.geometry.se3_exp`, both along the axes of the world: the true camera centre is
            the pose's plus ``translation``, the true rotation ``so3_exp(rotation) @ R_world_camera``. It is
            of the pose relative to the map around it, which covers the motion of about a second: the drift
            of the map and its scale are not in it. None where the frame has no pose, or where too few
            landmarks determine it (registration of depth).
        quality: probability by ``covariance`` that the pose is within 2 % of the scene's distance and within
            2 degrees, 0 to 1; 0 where there is no covariance.
        moving_share: share of the features that two images 0.15 s apart have in common which move together
            against the static world, as measured last; None where it was not.
    """

    index: int
    timestamp_s: float
    status: TrackingStatus
    T_world_camera: NDArray[np.float64] | None
    inliers: int = 0
    is_keyframe: bool = False
    keyframes: int = 0
    loop_closures: int = 0
    timings_ms: dict[str, float] = field(default_factory=dict)
    map_id: int = 0
    covariance: NDArray[np.float64] | None = None
    quality: float = 0.0
    moving_share: float | None = None


@dataclass(frozen=True)
class Trajectory:
    """Timestamped camera poses.

    Attributes:
        timestamps_s: ``(N,)`` float64, strictly increasing.
        T_world_camera: ``(N, 4, 4)`` float64.
        is_metric: False where the unit of length is unknown.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]
    is_metric: bool = True

    def __post_init__(self) -> None:
        n = len(self.timestamps_s)
        if self.timestamps_s.shape != (n,) or self.T_world_camera.shape != (n, 4, 4):
            raise ValueError(
                f"a trajectory needs (N,) times and (N, 4, 4) poses, got "
                f"{self.timestamps_s.shape} and {self.T_world_camera.shape}"
            )

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @classmethod
    def empty(cls) -> Trajectory:
        """No pose at all."""
        return cls(np.zeros(0), np.zeros((0, 4, 4)))


@dataclass(frozen=True)
class RunStatistics:
    """Counts, times and estimates of one run, for reports and benchmarks.

    Attributes:
        frames: frames given to the tracker.
        tracked: frames that have a pose in this map.
        loop_closures, relocalisations, registrations: how often a loop was closed, and how many frames were
            placed by relocalisation and by point-cloud registration.
        loops_refused: verified loops that were not closed, because they contradict the path.
        timings_ms: mean wall time in milliseconds per call of each stage.
        timing_calls: number of calls of each stage.
        readout_s: readout time of the rolling shutter in seconds, first image row to last; 0 for a global
            shutter, None where the odometry does not model it.
        readout_sigma_s: standard deviation of ``readout_s`` in seconds; None where it was not estimated.
        scale_votes: log ratio of the map's depth to the predicted depth, one per keyframe with enough
            points; their robust centre is 0 at the map's own scale. Empty with a sensor.
        maps_joined: how often two maps of the run became one.
        withdrawn: frames whose pose was taken back, since no motion confirmed it.
    """

    frames: int = 0
    tracked: int = 0
    loop_closures: int = 0
    relocalisations: int = 0
    registrations: int = 0
    timings_ms: dict[str, float] = field(default_factory=dict)
    timing_calls: dict[str, int] = field(default_factory=dict)
    readout_s: float | None = None
    readout_sigma_s: float | None = None
    scale_votes: tuple[float, ...] = ()
    loops_refused: int = 0
    maps_joined: int = 0
    withdrawn: int = 0
