"""Providers of the vehicle's own sensors: wheels, satellites, and inertial measurements.

The speed of the vehicle by its wheels: they roll ahead, and slide neither sideways nor off the ground.

    r = log( X^-1 before^-1 now X )_translation / dt - (v, 0, 0)

X is the place of the axle that does not steer, v the mean speed by the wheels.

The vehicle's place by satellites: r = t + R a - z, with a the antenna's place on the vehicle.

A fix that is older than the frame by dt was taken at exp(-dt xi) a in the vehicle's frame of now, xi its velocity over
the epoch. A fix far off is left out by a gate, which is as wide as the pose is uncertain; what passes is under a robust
loss.

The vehicle's pose, velocity and the biases of its inertial sensors from epoch to epoch, by preintegration.

GTSAM's `CombinedImuFactor` between (pose, velocity, biases) of two epochs (Forster, Carlone, Dellaert, Scaramuzza,
"On-manifold preintegration for real-time visual-inertial odometry", IEEE T-RO 33, 2017). The samples of a frame are
taken for steady over its interval where they last a little longer or shorter than the epoch. Where there are none, or
too few, the vehicle goes straight on, with noise on its acceleration and its rate of turn: the same factor of coarse
samples.

The sensor may sit anywhere on the vehicle (`mounted`).
"""

import logging
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import gtsam
import numpy as np

from factors import (
    PlanarPose,
    Robust,
    SpatialPose,
    prior_factor,
    residual_factor,
)
from saga_fg.errors import InputError
from saga_fg.graph import EGO_BIAS, EGO_POSE, EGO_VELOCITY, Additions, GraphView, NewVariable
from saga_fg.numerics import FloatArray, chi_square_quantile
from saga_fg.providers.odometry import NO_POSE, StartSettings
from saga_fg.settings import Fraction, Positive, PositiveOrInf, Settings, setting, settings_group
from saga_fg.types import ImuSamples

Mounting = tuple[float, float, float, float, float, float]
ON_THE_POSE: Mounting = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
Provider = TypeVar("Provider")


def mounting(name: str, numbers: Mounting) -> gtsam.Pose3:
    """pose_T_sensor of x, y, z (m), roll, pitch, yaw (rad). Raises `InputError` for other than six finite numbers."""
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise InputError(f"{name}: expected six finite numbers x, y, z, roll, pitch, yaw, got {numbers!r}")
    x, y, z, roll, pitch, yaw = numbers
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z]))


def on_pose(provider: Provider, pose_T_vehicle: FloatArray) -> Provider:
    """The provider with its sensor, whose settings say where it is on the vehicle, placed on another pose (4, 4).

    For graphs whose pose is not the vehicle's but, say, a LiDAR's. Providers without a sensor stay as they are.
    """
    settings: Any = provider
    placed: Provider = provider
    onto = gtsam.Pose3(pose_T_vehicle)
    if hasattr(settings, "antenna"):
        placed = replace(settings, antenna=tuple(onto.transformFrom(np.array(settings.antenna)).tolist()))
    if hasattr(settings, "mounted"):
        at = onto.compose(mounting("mounted", settings.mounted))
        placed = replace(settings, mounted=(*at.translation().tolist(), *at.rotation().rpy().tolist()))
    return placed


_OFF = 0.5  # share of an epoch that the wheels must have measured
SIDEWAYS = 0.1  # standard deviation of the velocity to the side and upwards, m/s


@dataclass(frozen=True)
class Wheels(Settings):
    """Adds the speed by the wheels (`frame.ego.wheels`) between the vehicle's poses in space of two epochs."""

    deviation: Positive = setting(
        0.1, "standard deviation of a speed without one of its own, m/s; higher: trusted less"
    )
    share: Fraction = setting(0.01, "standard deviation of a speed as a share of it: radius of the wheels, slip")
    outlier_scale: Positive = setting(
        3.0, "residual from which the Cauchy loss discounts a speed, as of spinning wheels, standard deviations"
    )
    mounted: Mounting = setting(
        ON_THE_POSE, "x, y, z (m), roll, pitch, yaw (rad) of the axle that does not steer, in the vehicle's frame"
    )
    name = "wheels"

    def __post_init__(self) -> None:
        super().__post_init__()
        mounting("mounted", self.mounted)

    @property
    def _place(self) -> gtsam.Pose3:
        return mounting("mounted", self.mounted)

    def factors(self, view: GraphView) -> Additions:
        wheels = None if view.frame is None or view.frame.ego is None else view.frame.ego.wheels
        before, now = view.before(EGO_POSE).get(0), view.now(EGO_POSE).get(0)
        if wheels is None or before is None or view.dt == 0 or wheels.dt < _OFF * view.dt:
            return Additions()
        if now is None:
            raise InputError(NO_POSE)
        if now.dim != 6:
            raise InputError("wheels: expected the vehicle's pose in space, got one in the plane")
        ahead = np.hypot(self.deviation if wheels.deviation is None else wheels.deviation, self.share * wheels.speed)
        R = np.diag(np.square([ahead, SIDEWAYS, SIDEWAYS]))
        residual = partial(_residual, self._place, view.dt, wheels.speed)
        robust = Robust("cauchy", self.outlier_scale)
        keys, types = [before.key, now.key], [SpatialPose(), SpatialPose()]
        factor = residual_factor(keys, types, residual, R, robust=robust, name="speed of the wheels")
        return Additions(factors=[factor])


def _residual(place: gtsam.Pose3, dt: float, speed: float, before: Any, now: Any) -> FloatArray:
    moved = gtsam.Pose3.Logmap(before.compose(place).between(now.compose(place)))[3:] / dt
    moved[0] -= speed
    return np.asarray(moved)


_LOG = logging.getLogger(__name__)
GRAVITY = 9.81  # m/s^2, which differs by 0.3 % at most from place to place, less than a bias


@dataclass(frozen=True)
class Gps(Settings):
    """Adds GPS fixes (`frame.ego.gps`) on the vehicle's pose that pass the gate."""

    deviation: Positive = setting(1.0, "standard deviation of a horizontal coordinate of fixes without a covariance, m")
    height_deviation: Positive = setting(2.0, "standard deviation of the height of fixes without a covariance, m")
    antenna: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "position of the antenna in the vehicle's frame, m")
    gate: Fraction = setting(0.999, "gate probability: share of true fixes inside the chi-square gate; 1: use all")
    outlier_scale: PositiveOrInf = setting(
        math.inf, "residual from which the Cauchy loss discounts a fix, standard deviations; .inf: never"
    )
    name = "gps"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.antenna) != 3 or not all(map(math.isfinite, self.antenna)):
            raise InputError(f"antenna: expected three finite numbers, got {self.antenna!r}")

    def factors(self, view: GraphView) -> Additions:
        fix = None if view.frame is None or view.frame.ego is None else view.frame.ego.gps
        pose = view.now(EGO_POSE).get(0)
        if fix is None:
            return Additions()
        if pose is None:
            raise InputError(NO_POSE)
        dim = 2 if pose.dim == 3 else 3
        if len(fix.position) < dim:
            raise InputError("gps: expected a place of 3 coordinates, as poses are in space, got 2")
        z = fix.position[:dim].copy()
        z[:2] -= view.origin
        R = fix.covariance
        if R is None:
            R = np.diag(np.square([self.deviation, self.deviation, self.height_deviation]))
        R = R[:dim, :dim]
        robust = None if math.isinf(self.outlier_scale) else Robust("cauchy", self.outlier_scale)
        antenna = _moved_back(view, pose.key, np.array(self.antenna), fix.age)[:dim]
        of_pose = PlanarPose() if dim == 2 else SpatialPose()
        factor = residual_factor([pose.key], [of_pose], partial(_off, z, antenna), R, robust=robust, name="fix")
        if self.gate < 1:
            values = gtsam.Values()
            values.insert(pose.key, view.state(pose.key))
            _, (J,), (r,) = factor.linearisation(values)
            S = J[0] @ view.covariance(pose.key) @ J[0].T + R
            if float(r @ np.linalg.solve(S, r)) > chi_square_quantile(self.gate, dim):
                _LOG.warning(
                    "%s at %.2f s: a fix %.1f m off is left out", self.name, view.time, float(np.linalg.norm(r))
                )
                return Additions()
        return Additions(factors=[factor])


def _off(z: FloatArray, antenna: FloatArray, pose: gtsam.Pose2 | gtsam.Pose3) -> FloatArray:
    return np.asarray(pose.transformFrom(antenna) - z)


def _moved_back(view: GraphView, key: int, antenna: FloatArray, age: float) -> FloatArray:
    """Place of the antenna `age` s ago in the frame of the present pose; its present place without an earlier pose."""
    before = view.before(EGO_POSE).get(0)
    if age == 0 or before is None or view.dt == 0:
        return antenna
    motion: Any = view.state(before.key).between(view.state(key))
    share: Any = type(motion).Expmap(-age / view.dt * type(motion).Logmap(motion))
    dim = 2 if isinstance(motion, gtsam.Pose2) else 3
    return np.concatenate([share.transformFrom(antenna[:dim]), antenna[dim:]])


INTEGRATION_NOISE = 1e-4  # noise density of integrating the position, m/s/sqrt(Hz)
UNKNOWN_ACCELERATION = 3.0  # noise density of the acceleration in gaps of the samples, m/s^2/sqrt(Hz)
UNKNOWN_TURN_DENSITY = 0.3  # noise density of the turn rate in gaps of the samples, rad/s/sqrt(Hz)
_COARSE = 0.1  # s, of samples in gaps: with one for all of it a place would tell the velocity


@dataclass(frozen=True)
class Imu(Settings):
    """Adds the vehicle's pose in space, velocity and biases at every epoch, and inertial samples (`frame.ego.imu`)."""

    start: StartSettings = settings_group(lambda: StartSettings(planar=False), "first pose, in space")
    start_velocity: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "first velocity in the world, m/s")
    start_velocity_deviation: Positive = setting(10.0, "standard deviation of the first velocity, m/s")
    accelerometer_noise: Positive = setting(0.02, "noise density of the accelerometer, m/s^2/sqrt(Hz)")
    gyroscope_noise: Positive = setting(0.002, "noise density of the gyroscope, rad/s/sqrt(Hz)")
    accelerometer_bias: Positive = setting(0.1, "standard deviation of the first bias of the accelerometer, m/s^2")
    gyroscope_bias: Positive = setting(0.01, "standard deviation of the first bias of the gyroscope, rad/s")
    accelerometer_drift: Positive = setting(1e-3, "random walk of the bias of the accelerometer in one second, m/s^2")
    gyroscope_drift: Positive = setting(1e-4, "random walk of the bias of the gyroscope in one second, rad/s")
    max_gap: Positive = setting(
        0.05, "longest time of an epoch without samples, s; where they lack more, the epoch is bridged as unknown"
    )
    mounted: Mounting = setting(ON_THE_POSE, "x, y, z (m), roll, pitch, yaw (rad) of the sensor in the vehicle's frame")
    name = "imu"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start.planar:
            raise InputError("start.planar: expected false, inertial sensors move a pose in space")
        mounting("mounted", self.mounted)

    @property
    def _place(self) -> gtsam.Pose3:
        return mounting("mounted", self.mounted)

    def predict(self, view: GraphView) -> Additions:
        before = view.before(EGO_VELOCITY)
        if not before:
            return self._start(view)
        kinds = (EGO_POSE, EGO_VELOCITY, EGO_BIAS)
        pose, velocity, bias = (view.before(kind)[0].key for kind in kinds)
        if not isinstance(view.state(pose), gtsam.Pose3):
            raise InputError("imu: expected the vehicle's pose in space (start.planar: false), got one in the plane")
        now = [view.key(kind, 0) for kind in kinds]
        measured = self._preintegrated(view, view.state(pose), view.state(bias))
        moved = measured.predict(gtsam.NavState(view.state(pose), view.state(velocity)), view.state(bias))
        new = [
            NewVariable(EGO_VELOCITY, 0, np.array(moved.velocity()), label="vehicle's velocity"),
            NewVariable(EGO_BIAS, 0, view.state(bias), label="imu bias"),
        ]
        if not view.now(EGO_POSE):
            new.append(NewVariable(EGO_POSE, 0, moved.pose(), label="vehicle"))
        return Additions(new, [gtsam.CombinedImuFactor(pose, velocity, now[0], now[1], bias, now[2], measured)])

    def factors(self, view: GraphView) -> Additions:
        return Additions()

    def _start(self, view: GraphView) -> Additions:
        first = self.start.additions(view)
        velocity, bias = view.key(EGO_VELOCITY, 0), view.key(EGO_BIAS, 0)
        deviations = np.repeat([self.accelerometer_bias, self.gyroscope_bias], 3)
        start = np.array(self.start_velocity)
        return Additions(
            [
                *first.variables,
                NewVariable(EGO_VELOCITY, 0, start, label="vehicle's velocity"),
                NewVariable(EGO_BIAS, 0, gtsam.imuBias.ConstantBias(), label="imu bias"),
            ],
            [
                *list(first.factors),  # type: ignore[arg-type]
                prior_factor(velocity, start, self.start_velocity_deviation**2 * np.eye(3)),
                gtsam.PriorFactorConstantBias(
                    bias, gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(deviations)
                ),
            ],
        )

    def _preintegrated(
        self, view: GraphView, pose: gtsam.Pose3, bias: gtsam.imuBias.ConstantBias
    ) -> gtsam.PreintegratedCombinedMeasurements:
        ego = None if view.frame is None else view.frame.ego
        samples = None if ego is None else ego.imu
        if samples is not None and abs(view.dt - float(samples.dt.sum())) > self.max_gap:
            _LOG.warning(
                "%s at %.2f s: samples of %.2f s for an epoch of %.2f s; it is bridged without them",
                self.name, view.time, float(samples.dt.sum()), view.dt,
            )  # fmt: skip
            samples = None
        known = samples is not None
        if samples is None:
            up = pose.compose(self._place).rotation().matrix().T @ [[0.0], [0.0], [GRAVITY]]
            corrected = bias.vector()[None]  # what sensors with these biases would say of straight on
            steps, steady = math.ceil(view.dt / _COARSE) or 1, np.hstack([up.T + corrected[:, :3], corrected[:, 3:]])
            each = np.repeat(steady, steps, axis=0)
            samples = ImuSamples(np.full(steps, view.dt / steps), each[:, :3], each[:, 3:])
        parameters = self._parameters(known)
        measured = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
        share = view.dt / float(samples.dt.sum())
        for dt, acceleration, rate in zip(samples.dt, samples.acceleration, samples.angular_rate, strict=True):
            measured.integrateMeasurement(acceleration, rate, share * float(dt))
        return measured

    def _parameters(self, known: bool) -> gtsam.PreintegrationCombinedParams:
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
        parameters.setBodyPSensor(self._place)
        noises = (self.accelerometer_noise, self.gyroscope_noise)
        for name, deviation in (
            ("Accelerometer", noises[0] if known else UNKNOWN_ACCELERATION),
            ("Gyroscope", noises[1] if known else UNKNOWN_TURN_DENSITY),
            ("Integration", INTEGRATION_NOISE),
            ("BiasAcc", self.accelerometer_drift),
            ("BiasOmega", self.gyroscope_drift),
        ):
            getattr(parameters, f"set{name}Covariance")(deviation**2 * np.eye(3))
        return parameters
