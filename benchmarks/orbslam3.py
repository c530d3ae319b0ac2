# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3 (Campos et al., T-RO 2021) through ``pyorbslam3``: a peer, never a dependency.

GPL-3.0; only the benchmark imports it, and only where the extra ``bench`` is installed.
"""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from benchmarks.system import Estimate, NotInstalled
from slamdepth.errors import TrackingError
from slamdepth.io import read_tum_trajectory
from slamdepth.types import Camera, Frame, Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

Mode = Literal["mono", "rgbd"]

HOW_TO_INSTALL = "not installed: pip install '.[bench]'"


def import_pyorbslam3() -> Any:
    """Import the Python binding.

    Raises:
        NotInstalled: the package, or a system library that it needs, is missing.
    """
    try:
        return importlib.import_module("pyorbslam3")
    except ModuleNotFoundError as error:
        raise NotInstalled(HOW_TO_INSTALL) from error
    except ImportError as error:
        raise NotInstalled(
            f"pyorbslam3 misses a library ({error}): apt-get install libgl1 libegl1 libopengl0 libsm6 "
            "libice6 libx11-6 libxext6"
        ) from error


class OrbSlam3:
    """ORB-SLAM3 with the settings of its own TUM examples and the sequence's camera.

    Args:
        mode: ``"rgbd"`` takes ``frame.depth_m`` as sensor depth and skips frames without.
        vocabulary: DBoW2 text file.

    Raises:
        NotInstalled: ``pyorbslam3`` is missing.
    """

    def __init__(self, camera: Camera, mode: Mode, vocabulary: Path) -> None:
        binding = import_pyorbslam3()
        self._mode = mode
        self._folder = tempfile.TemporaryDirectory(prefix="orbslam3-")
        settings = Path(self._folder.name) / "settings.yaml"
        settings.write_text(settings_text(camera), encoding="utf-8")
        sensor = binding.Sensor.MONOCULAR if mode == "mono" else binding.Sensor.RGBD
        self._slam = binding.Slam(str(vocabulary), str(settings), sensor)
        self._times: list[float] = []

    def step(self, frame: Frame) -> None:
        if self._mode == "mono":
            self._slam.track_monocular(frame.image_rgb, frame.timestamp_s)
        elif frame.depth_m is not None:
            self._slam.track_rgbd(frame.image_rgb, frame.depth_m, frame.timestamp_s)
        else:
            return
        self._times.append(frame.timestamp_s)

    def finish(self) -> Estimate:
        """Stop the threads and read the poses of the biggest map.

        Raises:
            TrackingError: it never initialised.
        """
        self._slam.shutdown()
        folder = Path(self._folder.name)
        all_file, keyframe_file = folder / "frames.txt", folder / "keyframes.txt"
        self._slam.save_trajectory_euroc(str(all_file))  # the TUM writer refuses monocular maps
        self._slam.save_keyframe_trajectory_euroc(str(keyframe_file))
        is_metric = self._mode == "rgbd"
        trajectory = _read(all_file, np.array(self._times), is_metric)
        keyframes = _read(keyframe_file, np.array(self._times), is_metric)
        if trajectory is None:
            raise TrackingError("it tracked no frame")
        return Estimate(trajectory, keyframes, {"keyframes": len(keyframes) if keyframes else 0})


def settings_text(camera: Camera) -> str:
    """Text of the settings file; ORB and depth threshold are those of ORB-SLAM3's ``TUM1.yaml``."""
    k1, k2, p1, p2, k3 = camera.distortion
    return f"""%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {camera.fx:.9f}
Camera1.fy: {camera.fy:.9f}
Camera1.cx: {camera.cx:.9f}
Camera1.cy: {camera.cy:.9f}
Camera1.k1: {k1:.9f}
Camera1.k2: {k2:.9f}
Camera1.p1: {p1:.9f}
Camera1.p2: {p2:.9f}
Camera1.k3: {k3:.9f}
Camera.width: {camera.width}
Camera.height: {camera.height}
Camera.fps: {round(camera.fps)}
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def _read(path: Path, times_s: NDArray[np.float64], is_metric: bool) -> Trajectory | None:
    """Read a EuRoC file of nanoseconds and ``x y z qx qy qz qw``; times are snapped to ``times_s (N,)``."""
    if not path.is_file():
        return None
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    rows = [row for row in rows if len(row) == 8]
    if not rows or len(times_s) == 0:
        return None
    seconds = np.array([float(row[0]) for row in rows]) * 1e-9
    nearest = times_s[np.abs(seconds[:, None] - times_s).argmin(axis=1)]
    order = np.argsort(nearest, kind="stable")
    tum = path.with_suffix(".tum")
    text, last = [], -np.inf
    for k in order:
        if nearest[k] > last:
            last = float(nearest[k])
            text.append(f"{last:.6f} {' '.join(rows[k][1:])}")
    tum.write_text("\n".join(text) + "\n", encoding="utf-8")
    trajectory, _ = read_tum_trajectory(tum)
    return Trajectory(trajectory.timestamps_s, trajectory.T_world_camera, is_metric)
