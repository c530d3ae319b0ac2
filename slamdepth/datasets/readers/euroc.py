# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV (Burri et al., IJRR 2016) and TUM-VI (Schubert et al., IROS 2018): the left camera.

``mav0/cam0/data.csv`` lists ``timestamp [ns],filename`` of images in ``mav0/cam0/data``. EuRoC has the camera
and its place on the body in ``mav0/cam0/sensor.yaml``, TUM-VI in ``dso/camchain.yaml`` as Kalibr writes it.
Ground truth is of the body (the inertial sensor) and becomes that of the camera by ``T_BS``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.calibration import read_values
from slamdepth.calibration.dialects import number_of
from slamdepth.datasets.image_files import list_images
from slamdepth.datasets.poses import checked_pose
from slamdepth.datasets.recording import FileRecording, camera_for, recorded_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import check_overlap, first_image
from slamdepth.errors import DatasetError
from slamdepth.geometry import invert
from slamdepth.io import read_lines, read_tum_trajectory
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Floats

_TRUTHS = ("state_groundtruth_estimate0/data.csv", "mocap0/data.csv")
_CAMERA = "cam0"
_USUAL = ("columns are read", "times are in nanoseconds")
"""What is said of any file, but is so in every one of this layout."""


@register_reader
class EurocReader:
    """Opens EuRoC and TUM-VI folders."""

    name = "euroc"
    needs = "mav0/cam0/data.csv and the images it lists; optional sensor.yaml, imu0, ground truth"

    def matches(self, path: Path) -> bool:
        return (path / "mav0" / _CAMERA).is_dir() or (path / _CAMERA / "data.csv").is_file()

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        root = path / "mav0" if (path / "mav0").is_dir() else path
        whole = path if root is not path else path.parent
        notes: list[str] = []
        timestamps_s, images = _list(root / _CAMERA)
        _, shape = first_image(tuple(images))
        sensor = _sensor(root, whole)
        taken_by, source = camera_for(path, shape, camera, lambda: sensor.camera(shape, notes), sensor.how)
        truth = _truth(root, whole, timestamps_s, sensor.T_body_camera, notes)
        recording = FileRecording(
            whole.resolve().name,
            path,
            taken_by,
            timestamps_s,
            images,
            truth=truth,
            notes=notes,
            source=source,
        )
        imu = root / "imu0" / "data.csv"
        recording.imu_path = imu if imu.is_file() else None
        return recording


@dataclass(frozen=True)
class _Sensor:
    """What a file says of the camera, where it says so, and the camera's pose on the body; None where it does
    not."""

    file: Path | None = None
    values: dict[Any, Any] = field(default_factory=dict)
    how: str = ""
    T_body_camera: Floats | None = None

    def camera(self, shape: tuple[int, ...], notes: list[str]) -> Camera | None:
        return None if self.file is None else recorded_camera(self.file, self.values, shape, notes)


def _list(folder: Path) -> tuple[Floats, list[Path]]:
    """Times ``(N,)`` in seconds and images, by ``data.csv`` or, where there is none, by their names."""
    path, data = folder / "data.csv", folder / "data"
    if path.is_file():
        rows = [(number, line.split(",")) for number, line in read_lines(path)]
        entries = [(number, fields[0].strip(), data / fields[-1].strip()) for number, fields in rows]
    else:
        entries = [(number, image.stem, image) for number, image in enumerate(list_images(data), 1)]
        path = data
    times_ns: list[int] = []
    for number, text, image in entries:
        if not text.isdecimal() or len(text) > 19 or not image.name or image == data:
            raise DatasetError(f"{path}:{number}: expected 'timestamp [ns],filename', found {text[:80]!r}")
        if times_ns and int(text) <= times_ns[-1]:
            raise DatasetError(f"{path}:{number}: time {text} does not come after {times_ns[-1]}")
        times_ns.append(int(text))
    if not times_ns:
        raise DatasetError(f"{path}: lists no images; expected 'timestamp [ns],filename' a line")
    return np.array(times_ns, dtype=np.float64) / 1e9, [image for _, _, image in entries]


def _sensor(root: Path, whole: Path) -> _Sensor:
    file = root / _CAMERA / "sensor.yaml"
    if file.is_file():
        values = read_values(file)
        return _Sensor(file, values, "sensor.yaml of cam0", _matrix(file, values.get("T_BS")))
    chains = (whole / "dso" / "camchain.yaml", whole / "camchain.yaml")
    chain = next((one for one in chains if one.is_file()), None)
    if chain is None:
        return _Sensor()
    left = read_values(chain).get(_CAMERA)
    if not isinstance(left, dict):
        raise DatasetError(f"{chain}: has no camera {_CAMERA}")
    T_camera_body = _matrix(chain, left.get("T_cam_imu"))
    T_body_camera = None if T_camera_body is None else invert(T_camera_body)
    return _Sensor(chain, left, f"{_CAMERA} of {chain.name}", T_body_camera)


def _matrix(path: Path, value: Any) -> Floats | None:
    """A pose of a YAML file, as a list of rows or as EuRoC's rows, cols and data; None where it is absent."""
    if value is None:
        return None
    rows: Any = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = [number_of(n) for row in rows for n in (row if isinstance(row, list) else [row])]
        T = checked_pose(np.array(numbers).reshape(4, 4))
    except (TypeError, ValueError, OverflowError):
        T = None
    if T is None:
        raise DatasetError(
            f"{path}: the pose of the camera on the body is no rigid transform of 4 x 4 numbers"
        )
    return T


def _truth(
    root: Path, whole: Path, timestamps_s: Floats, T_body_camera: Floats | None, notes: list[str]
) -> Trajectory | None:
    files = [*(root / name for name in _TRUTHS), whole / "dso" / "gt_imu.csv"]
    path = next((one for one in files if one.is_file()), None)
    if path is None:
        return None
    body, repairs = read_tum_trajectory(path, timestamps_s)
    notes += [note for note in repairs if not any(usual in note for usual in _USUAL)]
    check_overlap(timestamps_s, body, path)
    if T_body_camera is None:
        notes.append("ground truth is of the body: where the camera is on it is not known")
        return body
    notes.append("ground truth of the body is that of the camera by T_BS")
    return Trajectory(body.timestamps_s, body.T_world_camera @ T_body_camera, body.is_metric)
