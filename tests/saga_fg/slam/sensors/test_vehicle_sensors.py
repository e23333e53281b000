"""Sensors of the vehicle in a running graph: a drive through a tunnel, jumps, gaps, wrong places, and time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
import pytest

from saga_fg import Detections, Frame, InputError
from saga_fg.estimators import BatchSolver, IncrementalSmoother
from saga_fg.graph import EGO_BIAS, EGO_POSE
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.providers import Gps, Imu, StartSettings, Wheels
from saga_fg.providers.vehicle_sensors import mounting
from saga_fg.slam.mapping import MeasuredMotion
from saga_fg.slam.sensors import SensorBuffer, SensorConsistency, SensorSettings, sensor_providers

H, PERIOD, GRAVITY = 0.01, 0.2, 9.81
START = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2
IMU = Imu(StartSettings(planar=False), accelerometer_bias=0.05, gyroscope_bias=2e-3, max_gap=0.02)
SETTINGS = SensorSettings(Gps(1.0, 1.0, gate=1.0, outlier_scale=3.0), IMU, Wheels(0.05, 0.005))


@dataclass
class Vehicle:
    """True motion over level ground in steps of `H`: pose (4, 4), speed, acceleration and turn rate at each."""

    poses: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    rate: np.ndarray

    @classmethod
    def drive(cls, seconds: float = 8.0) -> "Vehicle":
        t = np.arange(0, seconds, H)
        acceleration, rate = 1.5 * np.sin(0.9 * t), 0.3 * np.sin(0.7 * t)
        speed = 8.0 + np.cumsum(acceleration) * H
        poses = [np.eye(4)]
        for v, w in zip(speed[:-1], rate[:-1], strict=True):
            poses.append(poses[-1] @ gtsam.Pose3.Expmap(np.array([0, 0, w * H, v * H, 0, 0])).matrix())
        return cls(np.array(poses), speed, acceleration, rate)


@dataclass
class Run:
    """What a drive left: the smoother, buffer, truth and the estimated path (K, 4, 4) of the vehicle."""

    smoother: IncrementalSmoother | BatchSolver
    buffer: SensorBuffer
    truth: np.ndarray
    path: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        return np.linalg.norm(self.path[:, :3, 3] - self.truth[:, :3, 3], axis=1)

    def misfits(self, sensors: tuple[str, ...], settings: SensorSettings) -> dict[str, str]:
        consistency = SensorConsistency(sensors, settings)
        consistency.observe(self.smoother.graph())
        return consistency.misfits


def run(
    sensors: tuple[str, ...],
    settings: SensorSettings = SETTINGS,
    *,
    blind: tuple[float, float] = (np.inf, np.inf),
    imu_gap: tuple[float, float] = (np.inf, np.inf),
    jump: Callable[[float], float] = lambda time: 0.0,
    true: SensorSettings | None = None,
    pose_T_vehicle: np.ndarray | None = None,
    seed: int = 0,
    batch: bool = False,
    seconds: float = 8.0,
) -> Run:
    """A drive with odometry that does not see the way ahead within `blind`, s, and says so.

    true: settings by which the sensors are simulated, where these differ from those of the estimate
    """
    rng, vehicle, true = np.random.default_rng(seed), Vehicle.drive(seconds), true or settings
    X = np.eye(4) if pose_T_vehicle is None else pose_T_vehicle
    smoother = BatchSolver() if batch else IncrementalSmoother(lag=None)
    buffer, providers = SensorBuffer(), sensor_providers(settings, sensors, X)
    imu_T_vehicle = mounting("", true.imu.mounted).inverse()
    R = imu_T_vehicle.rotation().matrix()
    lever = mounting("", true.imu.mounted).translation()
    bias = np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 1e-3, 3)])
    noise = np.repeat([IMU.accelerometer_noise, IMU.gyroscope_noise], 3) / np.sqrt(H)
    change = np.gradient(vehicle.rate, H)
    every, truth, last = round(PERIOD / H), [], np.eye(4)
    for i in range(len(vehicle.poses)):
        time = i * H
        if i:
            force = np.array([vehicle.acceleration[i - 1], vehicle.speed[i - 1] * vehicle.rate[i - 1], GRAVITY])
            before = np.array([0.0, 0.0, vehicle.rate[i - 1]])
            force += np.cross([0, 0, change[i - 1]], lever) + np.cross(before, np.cross(before, lever))
            sample = np.concatenate([R @ force, R @ before]) + bias + noise * rng.normal(size=6)
            if not imu_gap[0] <= time < imu_gap[1]:
                buffer.add_imu(time, sample[:3], sample[3:])
            if i % 5 == 0:
                scale = 1 + 0.002 * rng.normal()
                buffer.add_wheels(time, float(vehicle.speed[i - 5 : i].mean() * scale + 0.02 * rng.normal()))
        if i % 20 == 3:
            antenna = vehicle.poses[i] @ [*true.gps.antenna, 1.0]
            buffer.add_gps(time, antenna[:3] + rng.normal(0, true.gps.deviation, 3) + [jump(time), 0.0, 0.0])
        if i % every:
            continue
        world_T_pose = vehicle.poses[i] @ inverse_transform(X)
        motion = inverse_transform(last) @ world_T_pose if truth else world_T_pose
        sigma = np.array([3e-4] * 3 + [0.01, 0.01, 0.01])
        lost = blind[0] <= time < blind[1]
        measured = motion @ gtsam.Pose3.Expmap(sigma * rng.normal(size=6)).matrix() if truth else motion
        if lost:
            measured[:3, 3] *= 0.7  # what constant velocity makes of it
            sigma[3:] = [5.0, 0.3, 0.02]
        covariance = np.diag(sigma**2) if truth else START
        frame = Frame(time, "ego", Detections.empty(), ego=buffer.take(time))
        smoother.step(time, [MeasuredMotion(measured, covariance), *providers], frame)
        truth.append(vehicle.poses[i])
        last = world_T_pose
    found = smoother.graph()
    path = [found.state(found.of(EGO_POSE, k)[0].key).matrix() @ X for k in range(len(truth))]
    return Run(smoother, buffer, np.array(truth), np.array(path))


def test_through_a_tunnel_the_other_sensors_carry_the_pose():
    alone = run((), blind=(3.0, 6.5)).errors.max()
    assert alone > 6.0
    for sensors, most in ((("wheels",), 1.0), (("imu",), 1.0), (("wheels", "imu"), 0.6), (("gps",), 3.0)):
        assert run(sensors, blind=(3.0, 6.5)).errors.max() < most, sensors


def test_the_batch_finds_the_same():
    sensors = ("gps", "imu", "wheels")
    online, whole = (run(sensors, blind=(1.0, 2.0), batch=batch, seconds=3.0) for batch in (False, True))
    np.testing.assert_allclose(online.path, whole.path, atol=2e-3)


def test_a_jump_of_a_kilometre_neither_crashes_nor_pulls():
    found = run(("gps", "wheels"), jump=lambda time: 1000.0 if 3 < time < 4 else 0.0)
    assert found.errors.max() < 1.0
    assert found.misfits(("gps", "wheels"), SETTINGS) == {}
    forever = run(("gps",), jump=lambda time: 1000.0 if time > 2 else 0.0)
    assert forever.errors.max() < 1.0
    assert "gps: " in forever.misfits(("gps",), SETTINGS)["gps"]


def test_a_gap_of_the_samples_is_bridged_and_said(caplog):
    found = run(("imu",), imu_gap=(3.0, 4.5))
    assert "imu: no measurements for 0.20 s before 3.20 s" in caplog.text
    assert caplog.text.count("no measurements") == 1
    assert found.errors.max() < 0.7
    assert found.misfits(("imu",), SETTINGS) == {}


def test_sensors_anywhere_on_the_vehicle_and_poses_of_another_sensor():
    placed = SensorSettings(
        replace(SETTINGS.gps, antenna=(-1.0, 0.5, 1.2)),
        replace(IMU, mounted=(0.5, -0.3, 0.4, 0.1, -0.2, 1.2)),
        SETTINGS.wheels,
    )
    lidar_T_vehicle = inverse_transform(yaw_transform(0.8, 0.3, 1.7, 0.4))
    sensors = ("gps", "imu", "wheels")
    found = run(sensors, placed, blind=(3.0, 6.5), pose_T_vehicle=lidar_T_vehicle, batch=True)
    assert found.errors.max() < 0.6
    assert found.misfits(sensors, placed) == {}
    bias: Any = found.smoother.state(found.smoother.graph().of(EGO_BIAS, found.smoother.graph().epoch)[0].key)
    assert np.abs(bias.vector()[3:]).max() < 0.005


def test_a_sensor_in_another_place_is_named(subtests):
    assert run(("gps", "imu", "wheels"), batch=True).misfits(("gps", "imu", "wheels"), SETTINGS) == {}
    for sensor, true in [
        ("gps", SensorSettings(replace(SETTINGS.gps, antenna=(4.0, -4.0, 1.0)), IMU, SETTINGS.wheels)),
        ("imu", SensorSettings(SETTINGS.gps, replace(IMU, mounted=(0, 0, 0, 0.3, 0, 0)), SETTINGS.wheels)),
        ("imu", SensorSettings(SETTINGS.gps, replace(IMU, mounted=(0, 0, 0, 0, 0, 0.6)), SETTINGS.wheels)),
    ]:
        with subtests.test(sensor=sensor, true=true):
            found = run(("gps", "imu", "wheels"), true=true, batch=True).misfits(("gps", "imu", "wheels"), SETTINGS)
            assert next(iter(found)) == sensor  # the one that fits least comes first
            assert found[sensor].startswith(f"{sensor}: ")
            assert "check " in found[sensor]


def test_measurements_come_in_order_of_time():
    buffer = SensorBuffer()
    buffer.add_imu(1.0, np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match=r"imu: expected a time after 1\.0+ s, got 0\.9"):
        buffer.add_imu(0.9, np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match=r"imu: acceleration\[0\]: expected a finite number"):
        buffer.add_imu(1.1, np.array([np.nan, 0, 0]), np.zeros(3))
    buffer.take(2.0)
    with pytest.raises(InputError, match=r"wheels: 1\.5.* comes too late"):
        buffer.add_wheels(1.5, 3.0)
    with pytest.raises(InputError, match=r"time: expected one after 2\.0"):
        buffer.take(2.0)
    with pytest.raises(InputError, match=r"gps\.gate: expected 1"):
        SensorSettings(Gps())
    with pytest.raises(InputError, match="expected some of gps, imu, wheels, got 'radar'"):
        sensor_providers(SETTINGS, ["radar"], np.eye(4))


def test_a_gap_after_the_first_sample_is_not_filled():
    buffer = SensorBuffer()
    buffer.take(0.0)
    for time in (1.0, 1.1, 1.9, 2.0):  # 0.8 s without samples
        buffer.add_imu(time, np.array([time, 0.0, 0.0]), np.zeros(3))
    found = buffer.take(2.0)
    np.testing.assert_allclose(found.imu.dt, 0.1)
    buffer = SensorBuffer()
    buffer.take(0.0)
    for time in (0.1, 1.3, 1.4):
        buffer.add_wheels(time, 5.0)
    assert buffer.take(1.4).wheels.dt == pytest.approx(0.1 + 0.5 + 0.1)


def test_two_silences_in_a_row_are_not_filled():
    buffer = SensorBuffer()
    buffer.take(0.0)
    for time in (0.01, 0.02, 0.03):
        buffer.add_imu(time, np.zeros(3), np.zeros(3))
    buffer.take(0.03)
    for time in (5.03, 10.03, 10.04):
        buffer.add_imu(time, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(buffer.take(10.04).imu.dt, [0.01, 0.01, 0.01])


def test_a_buffer_gives_each_pose_what_came_since_the_one_before():
    buffer = SensorBuffer()
    buffer.take(0.0)
    for k in range(1, 11):
        buffer.add_imu(0.03 * k, np.array([k, 0.0, 0.0]), np.zeros(3))
        buffer.add_wheels(0.03 * k, float(k))
    buffer.add_gps(0.07, np.array([1.0, 2.0, 3.0]))
    first, second = buffer.take(0.1), buffer.take(0.2)
    assert first.imu.dt.sum() == pytest.approx(0.1)
    assert second.imu.dt.sum() == pytest.approx(0.1)
    assert first.imu.acceleration[:, 0].tolist() == [1, 2, 3, 4]
    assert second.imu.acceleration[0, 0] == 4
    assert first.wheels.speed == pytest.approx((0.03 * (1 + 2 + 3) + 0.01 * 4) / 0.1)
    assert first.gps.age == pytest.approx(0.03)
    assert second.gps is None
