"""The vehicle's pose, velocity and the biases of its inertial sensors from epoch to epoch, by preintegration.

GTSAM's `CombinedImuFactor` between (pose, velocity, biases) of two epochs (Forster, Carlone, Dellaert, Scaramuzza,
"On-manifold preintegration for real-time visual-inertial odometry", IEEE T-RO 33, 2017). The samples of a frame are
taken for steady over its interval where they last a little longer or shorter than the epoch. Where there are none, or
too few, the vehicle goes straight on, with noise on its acceleration and its rate of turn: the same factor of one
coarse sample.

The sensor may sit anywhere on the vehicle (`mounted`). Its turn there can be a variable for all time: the factor is
then between the poses of the sensor, and the velocity is the sensor's.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np

from factors import ImuBias, ResidualFactor, SpatialPose, Vector, prior_factor
from saga_fg.errors import InputError
from saga_fg.graph.keys import EGO_BIAS, EGO_CALIBRATION, EGO_POSE, EGO_VELOCITY
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.providers.mounting import INERTIAL, ON_THE_POSE, Mounting, mounting
from saga_fg.providers.start import StartSettings
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.types.ego_measurements import ImuSamples

_LOG = logging.getLogger(__name__)
INTEGRATION_NOISE = 1e-4  # noise density of integrating the position, m/s/sqrt(Hz)
UNKNOWN_ACCELERATION = 3.0  # noise density of the acceleration in gaps of the samples, m/s^2/sqrt(Hz)
UNKNOWN_TURN = 0.3  # noise density of the turn rate in gaps of the samples, rad/s/sqrt(Hz)
ROTATION_DEVIATION = 0.05  # standard deviation of the sensor's rotation beforehand, by axis, rad


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
    gravity: NonNegative = setting(9.81, "gravity, m/s^2")
    max_gap: Positive = setting(
        0.05, "longest time of an epoch without samples, s; where they lack more, the epoch is bridged as unknown"
    )
    mounted: Mounting = setting(ON_THE_POSE, "x, y, z (m), roll, pitch, yaw (rad) of the sensor in the vehicle's frame")
    estimate_rotation: bool = setting(False, "true: the sensor's rotation on the vehicle is a variable of the graph")
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
        onto = self._place if self.estimate_rotation else gtsam.Pose3()  # the sensor's pose in place of the vehicle's
        measured = self._preintegrated(view, view.state(pose).compose(onto), view.state(bias))
        begin = gtsam.NavState(view.state(pose).compose(onto), view.state(velocity))
        moved = measured.predict(begin, view.state(bias))
        new = [
            NewVariable(EGO_VELOCITY, 0, np.array(moved.velocity()), label="vehicle's velocity"),
            NewVariable(EGO_BIAS, 0, view.state(bias), label="imu bias"),
        ]
        if not view.now(EGO_POSE):
            new.append(NewVariable(EGO_POSE, 0, moved.pose().compose(onto.inverse()), label="vehicle"))
        if self.estimate_rotation:
            rotation, more = self._rotation(view)
            keys = (pose, velocity, now[0], now[1], bias, now[2], rotation)
            return Additions([*new, *more.variables], [*list(more.factors), self._turned(keys, measured)])  # type: ignore[arg-type]
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

    def _rotation(self, view: GraphView) -> tuple[int, Additions]:
        """Key of the sensor's rotation (3,), as a rotation vector from where the settings have it."""
        key = view.key(EGO_CALIBRATION, INERTIAL, static=True)
        if INERTIAL in view.static(EGO_CALIBRATION):
            return key, Additions()
        new = NewVariable(EGO_CALIBRATION, INERTIAL, np.zeros(3), static=True, label="rotation of the imu")
        return key, Additions([new], [prior_factor(key, np.zeros(3), ROTATION_DEVIATION**2 * np.eye(3))])

    def _turned(self, keys: tuple[int, ...], measured: gtsam.PreintegratedCombinedMeasurements) -> ResidualFactor:
        types = (SpatialPose(), Vector(3), SpatialPose(), Vector(3), ImuBias(), ImuBias(), Vector(3))
        native = gtsam.CombinedImuFactor(*keys[:6], measured)  # type: ignore[call-overload]
        covariance = native.noiseModel().covariance()
        return ResidualFactor(keys, types, partial(_turned, native, self._place), covariance, name="inertial samples")

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
            turned = pose.rotation() if self.estimate_rotation else pose.compose(self._place).rotation()
            up = turned.matrix().T @ [[0.0], [0.0], [self.gravity]]
            corrected = bias.vector()[None]  # what sensors with these biases would say of straight on
            samples = ImuSamples(np.array([view.dt]), up.T + corrected[:, :3], corrected[:, 3:])
        parameters = self._parameters(known)
        measured = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
        share = view.dt / float(samples.dt.sum())
        for dt, acceleration, rate in zip(samples.dt, samples.acceleration, samples.angular_rate, strict=True):
            measured.integrateMeasurement(acceleration, rate, share * float(dt))
        return measured

    def _parameters(self, known: bool) -> gtsam.PreintegrationCombinedParams:
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(self.gravity)
        if not self.estimate_rotation:
            parameters.setBodyPSensor(self._place)
        noises = (self.accelerometer_noise, self.gyroscope_noise)
        for name, deviation in (
            ("Accelerometer", noises[0] if known else UNKNOWN_ACCELERATION),
            ("Gyroscope", noises[1] if known else UNKNOWN_TURN),
            ("Integration", INTEGRATION_NOISE),
            ("BiasAcc", self.accelerometer_drift),
            ("BiasOmega", self.gyroscope_drift),
        ):
            getattr(parameters, f"set{name}Covariance")(_isotropic(deviation))
        return parameters


def _turned(native: gtsam.CombinedImuFactor, place: gtsam.Pose3, *states: Any) -> FloatArray:
    first, v1, second, v2, bias1, bias2, rotation = states
    mounted = place.compose(gtsam.Pose3(gtsam.Rot3.Expmap(rotation), np.zeros(3)))
    return np.asarray(native.evaluateError(first.compose(mounted), v1, second.compose(mounted), v2, bias1, bias2))


def _isotropic(deviation: float) -> FloatArray:
    return np.asarray(deviation**2 * np.eye(3))
