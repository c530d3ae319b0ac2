# SPDX-License-Identifier: Apache-2.0
"""Scale and gravity from inertial data, on exact paths with noise and bias."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import MadeUpDataset

from slamdepth.config import Config
from slamdepth.errors import DatasetError
from slamdepth.geometry import so3_exp, so3_log
from slamdepth.io.imu import STANDARD_GRAVITY, ImuData, read_imu
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.pipeline.scale import settle_scale
from slamdepth.report import ScaleSource
from slamdepth.scale.imu import from_imu
from slamdepth.scale.inertial import align_inertial
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Walk:
    """A body on sums of sines: positions and rotations at any time, in a world with z up."""

    seed: int = 0
    reach_m: float = 0.15
    turn_rad: float = 0.4

    def _sines(self, t: Floats, key: int, slowest_hz: float, fastest_hz: float, order: int) -> Floats:
        rng = np.random.default_rng([self.seed, key])
        w = 2 * np.pi * rng.uniform(slowest_hz, fastest_hz, (4, 3))
        phase = rng.uniform(0, 2 * np.pi, (4, 3)) + order * np.pi / 2
        return np.asarray((w**order * np.sin(w * t[:, None, None] + phase)).sum(axis=1) / 2)

    def position(self, t: Floats) -> Floats:
        return self.reach_m * self._sines(t, 1, 0.1, 0.6, 0)

    def acceleration(self, t: Floats) -> Floats:
        return self.reach_m * self._sines(t, 1, 0.1, 0.6, 2)

    def rotation(self, t: Floats) -> Floats:
        return so3_exp(self.turn_rad * self._sines(t, 2, 0.05, 0.4, 0))

    def rate(self, t: Floats) -> Floats:
        h = 1e-4
        return so3_log(np.swapaxes(self.rotation(t - h), 1, 2) @ self.rotation(t + h)) / (2 * h)


def recorded(
    walk: Walk,
    *,
    seconds: float = 20.0,
    scale: float = 0.4,
    offset_s: float = 0.037,
    noise: float = 1.0,
    R_camera_imu: Floats | None = None,
) -> tuple[Trajectory, ImuData, Floats]:
    """A path in a map ``scale`` times too small, the sensor's data, and gravity in the map.

    ``noise`` 1 is 2 mm and 0.1 degrees of each pose, and a phone's sensor.
    """
    rng = np.random.default_rng([walk.seed, 3])
    R_camera_imu = so3_exp(np.array([0.4, -1.2, 0.7])) if R_camera_imu is None else R_camera_imu
    lever_m, gyro_bias, acc_bias = (
        np.array([0.03, -0.05, 0.02]),
        0.01 * np.ones(3),
        np.array([0.1, -0.1, 0.05]),
    )
    times_s = np.arange(-0.5, seconds + 0.5, 1 / 200)
    R = walk.rotation(times_s)
    force = np.einsum("nji,nj->ni", R, walk.acceleration(times_s) - STANDARD_GRAVITY * DOWN) + acc_bias
    rate = walk.rate(times_s) + gyro_bias
    force += noise * 0.05 * rng.standard_normal(force.shape)
    rate += noise * 0.005 * rng.standard_normal(rate.shape)
    t = np.arange(0.0, seconds, 1 / 30)
    R_body = walk.rotation(t)
    R_camera = R_body @ R_camera_imu.T
    # the sensor sits at lever_m in the camera's frame
    place = walk.position(t) - np.einsum("nij,j->ni", R_camera, lever_m)
    to_map = so3_exp(np.array([0.3, 2.0, -0.5]))
    T = np.tile(np.eye(4), (len(t), 1, 1))
    shake = so3_exp(np.radians(0.1) * noise * rng.standard_normal((len(t), 3)))
    T[:, :3, :3] = to_map @ R_camera @ shake
    T[:, :3, 3] = scale * (place @ to_map.T + 0.002 * noise * rng.standard_normal((len(t), 3)))
    return Trajectory(t, T), ImuData(times_s + offset_s, rate, force), to_map @ DOWN


@pytest.mark.parametrize("seed", range(5))
def test_the_scale_comes_out_to_one_per_cent(seed: int) -> None:
    path, imu, down = recorded(Walk(seed))
    fit = align_inertial(path, imu)
    assert fit.scale == pytest.approx(1 / 0.4, rel=0.01)
    assert abs(math.log(fit.scale * 0.4)) < 4 * max(fit.sigma_log, 0.001)
    assert float(fit.gravity_w @ down) > math.cos(math.radians(1.0))
    assert fit.offset_s == pytest.approx(0.037, abs=0.004)
    assert np.degrees(np.linalg.norm(so3_log(fit.R_camera_imu @ so3_exp(np.array([0.4, -1.2, 0.7])).T))) < 1.0
    assert not fit.is_reversed


@settings(max_examples=10, deadline=None)
@given(st.floats(0.01, 100.0), st.integers(0, 100))
def test_any_scale_and_clock_comes_out_without_noise(scale: float, seed: int) -> None:
    path, imu, _ = recorded(Walk(seed), scale=scale, noise=0.0, offset_s=0.0)
    moved = ImuData(imu.times_s + 1.7e9, imu.rates, imu.forces)
    fit = align_inertial(path, moved)
    assert fit.scale * scale == pytest.approx(1.0, rel=0.01)
    assert fit.offset_s == pytest.approx(1.7e9, abs=0.01)


def test_accelerations_of_the_other_sign_are_recognised() -> None:
    path, imu, _ = recorded(Walk(1))
    estimate, fit = from_imu(path, ImuData(imu.times_s, imu.rates, -imu.forces))
    assert fit.is_reversed
    assert estimate.factor == pytest.approx(2.5, rel=0.01)
    assert "accelerations for specific forces" in estimate.how


def test_motion_that_does_not_excite_is_refused() -> None:
    steady = Walk(2, reach_m=0.0005)
    path, imu, _ = recorded(steady)
    with pytest.raises(DatasetError, match="the motion does not tell the scale"):
        align_inertial(path, imu)
    still = Walk(2, turn_rad=0.001)
    path, imu, _ = recorded(still)
    with pytest.raises(DatasetError, match=r"do not turn alike|turns about one axis"):
        align_inertial(path, imu)


def test_data_of_another_recording_are_refused() -> None:
    path, _, _ = recorded(Walk(3))
    _, other, _ = recorded(Walk(4))
    with pytest.raises(DatasetError, match="do not turn alike"):
        align_inertial(path, other)


def test_too_short_a_time_is_refused() -> None:
    path, imu, _ = recorded(Walk(5), seconds=0.5)
    with pytest.raises(DatasetError, match="too few frames in a row"):
        align_inertial(path, imu)


def test_inertial_data_scale_a_run_and_tell_gravity(tmp_path: Path) -> None:
    path, imu, down = recorded(Walk(1))
    file = tmp_path / "imu.csv"
    table = np.column_stack([imu.times_s, imu.rates, imu.forces])
    np.savetxt(file, table, delimiter=",", header="time [s],gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z")
    made = Reconstruction(path, (), np.ones((3, 3)))
    before = PredictionScale(ScaleSource.NETWORK, "depth predicted by x", None)
    config = Config.from_dict({"scale": {"imu": str(file)}})
    scaled, facts, notes = settle_scale(MadeUpDataset(5), made, before, config)
    assert (facts.source, notes) == (ScaleSource.IMU, ())
    assert facts.factor == pytest.approx(2.5, rel=0.01)
    assert scaled.gravity_w is not None
    assert float(scaled.gravity_w @ down) > math.cos(math.radians(1.0))
    config = Config.from_dict({"scale": {"imu": str(tmp_path / "other.csv")}})
    (tmp_path / "other.csv").write_text(file.read_text().replace("0", "1"))
    same, facts, notes = settle_scale(MadeUpDataset(5), made, before, config)
    assert same is made
    assert any(note.startswith("no scale from the inertial data: ") for note in notes)


# --- files ---------------------------------------------------------------------------------


def rows(step: float, count: int = 40) -> list[list[float]]:
    return [[n * step, 0.1 * n, -0.2, 0.3, 0.0, 9.8, n * 0.01] for n in range(count)]


def test_euroc_files_are_read(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
    head += "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    body = [
        ",".join([str(1403715273262142976 + n * 5000000), *map(str, row[1:])])
        for n, row in enumerate(rows(1))
    ]
    file.write_text("\n".join([head, *body]))
    imu, _ = read_imu(file)
    assert imu.times_s[1] - imu.times_s[0] == pytest.approx(0.005, abs=1e-6)
    np.testing.assert_allclose(imu.rates[3], [0.3, -0.2, 0.3])
    np.testing.assert_allclose(imu.forces[3], [0.0, 9.8, 0.03])


@pytest.mark.parametrize(
    ("head", "order", "factor"),
    [
        ("time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", range(7), (1.0, 1.0)),
        ("Time (s),Acc x (m/s^2),Acc y (m/s^2),Acc z (m/s^2),Gyroscope x (rad/s),Gyroscope y (rad/s),"
         "Gyroscope z (rad/s)", [0, 4, 5, 6, 1, 2, 3], (1.0, 1.0)),
        ("timestamp,accelerometerAccelerationX(G),accelerometerAccelerationY(G),accelerometerAccelerationZ(G),"
         "gyroRotationX(rad/s),gyroRotationY(rad/s),gyroRotationZ(rad/s)", [0, 4, 5, 6, 1, 2, 3],
         (1.0, STANDARD_GRAVITY)),
        ("t,wx [deg/s],wy [deg/s],wz [deg/s],ax,ay,az", range(7), (math.pi / 180, 1.0)),
    ],
)  # fmt: skip
def test_files_of_phone_apps_are_read_by_their_headers(
    tmp_path: Path, head: str, order: list[int], factor: tuple[float, float]
) -> None:
    file = tmp_path / "phone.csv"
    body = [",".join(str(row[index]) for index in order) for row in rows(0.01)]
    file.write_text("\n".join([head, *body]))
    imu, _ = read_imu(file)
    np.testing.assert_allclose(imu.times_s[:3], [0.0, 0.01, 0.02])
    np.testing.assert_allclose(imu.rates[3], factor[0] * np.array([0.3, -0.2, 0.3]))
    np.testing.assert_allclose(imu.forces[3], factor[1] * np.array([0.0, 9.8, 0.03]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,gyro_x,gyro_y\n1,2,3\n", "does not name a time, angular velocities"),
        ("0,1,2,3,4,5,6\n", "holds 1 rows"),
        ("0,1,2,3,4,5,6\n1,2,3\n", ":2: expected 7 columns"),
        ("", "holds 0 rows"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "imu.csv"
    file.write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_imu(file)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_imu(tmp_path / "missing.csv")
