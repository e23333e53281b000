"""The vehicle's sensors beside its LiDAR: joined between keyframes, wheels compared with scans.

Wheels of another size than the vehicle believes err by some per cent. Their scale k is estimated from the steps s that
registration determines, as x ahead:

    s_registered = k s_wheels + noise of variance v,        k ~ N(1, 0.05^2)

Until k is known, speeds enter the graph only where scans leave motions open; from then on they are multiplied by it.
A warning says where it is off 1 by more than `_SURE` deviations, that of k and the `share` of the settings together.
Wheels whose steps are far from those of the scans are left out.

Inertial samples predict each scan: from the pose, velocity and biases of the newest keyframe in the graph, by
preintegration as in `saga_fg.providers.Imu`. The graph has the same samples as factors between keyframes.
"""

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from data_tools.lidar import Scan, ScanSequence, scan_context
from pipelines.slam.odometry import LidarOdometry, Odometry, OdometrySettings, OdometryStep, checked_step
from saga_fg import InputError
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import EGO_BIAS, EGO_POSE, EGO_VELOCITY, FactorProvider
from saga_fg.numerics import FloatArray, carried_covariance, checked_transform, inverse_transform, yaw_transform
from saga_fg.providers import GRAVITY, Imu, Wheels, mounting, on_pose
from saga_fg.slam.sensors import SensorConsistency, SensorName, SensorSettings, sensor_providers
from saga_fg.types import Detections, EgoMeasurements, Frame, ImuSamples, WheelSpeed

_LOG = logging.getLogger(__name__)


_SCALE = 0.05  # standard deviation of the scale of wheels
_STEP_NOISE = 0.02  # m, of a step that registration determines: it errs with the map
_KNOWN_SCALE = 0.005  # standard deviation at which the scale is as good as known
_BELIEVED = 0.3  # share of a step by which registration may differ: beyond, wheels slipped, or it erred


@dataclass(eq=False)
class WheelScale:
    """Ratio of distances travelled to those that the wheels tell, from steps that registration determines.

    refused: steps of which the two differ too much to compare them
    """

    refused: int = 0
    _information: float = _SCALE**-2
    _weighted: float = _SCALE**-2

    @property
    def value(self) -> float:
        """The estimate of k."""
        return self._weighted / self._information

    @property
    def known(self) -> bool:
        """True if more steps hardly change it."""
        return self._information > _KNOWN_SCALE**-2

    def update(self, predicted: float, driven: float, variance: float) -> None:
        """Take a step ahead of the wheels, in true metres so far, and that by registration, m, with its variance."""
        if abs(driven - predicted) > _BELIEVED * abs(predicted):
            self.refused += 1
            return
        wheels, weight = predicted / self.value, 1 / (variance + _STEP_NOISE**2)
        self._information += weight * wheels**2
        self._weighted += weight * wheels * driven


_MOVING = 1.0  # m/s from which a speed tells a scale
_SURE = 3.0  # deviations
_REFUSED = 15  # steps that scans contradict, after which wheels are left out


class WheelComparison:
    """Takes each speed before its scan is placed (`corrected`), and the scan after (`compared`).

    settings: of the wheels; ego_T_lidar: (4, 4) pose of the LiDAR on the vehicle; scale: of the wheels
    """

    def __init__(self, settings: Wheels, ego_T_lidar: FloatArray) -> None:
        self._settings, self.scale = settings, WheelScale()
        self._lidar_T_axle = inverse_transform(ego_T_lidar) @ mounting("mounted", settings.mounted).matrix()
        self._last: OdometryStep | None = None
        self._judged = False

    def corrected(self, wheels: WheelSpeed | None) -> WheelSpeed | None:
        """The speed to use; None if wheels are left out."""
        if wheels is None or (self._judged and not self.scale.known):
            return None
        return replace(wheels, speed=self.scale.value * wheels.speed) if self._judged else wheels

    def compared(self, wheels: WheelSpeed | None, step: OdometryStep) -> tuple[WheelSpeed | None, str]:
        """The speed that enters the graph with a scan that was placed, and once, in words, what does not fit."""
        shown = step.registration is not None and not step.degenerate
        used = self.corrected(wheels) if self._judged or not shown else None
        last, self._last = self._last, step if shown else None
        if self._judged or wheels is None or last is None or not shown:
            return used, ""
        dt = step.timestamp - last.timestamp
        moved = inverse_transform(last.map_T_lidar @ self._lidar_T_axle) @ step.map_T_lidar @ self._lidar_T_axle
        driven = float(gtsam.Pose3.Logmap(gtsam.Pose3(moved))[3])
        if abs(driven) >= _MOVING * dt and abs(wheels.dt - dt) <= dt / 2:
            variance = (dt * self._settings.deviation) ** 2
            self.scale.update(self.scale.value * wheels.speed * dt, driven, variance)
            self._judged = self.scale.known or self.scale.refused >= _REFUSED
        return used, self._misfit() if self._judged else ""

    def _misfit(self) -> str:
        name, ratio = self._settings.name, 1 / self.scale.value
        if not self.scale.known:
            return f"{name}: {self.scale.refused} times their speed is far from that by the scans; they are left out"
        allowed = _SURE * float(np.hypot(self._settings.share, _KNOWN_SCALE))
        if abs(ratio - 1) <= allowed:
            return ""
        return (
            f"{name}: their speed is {ratio:.3f} times that by the scans, where its settings allow {allowed:.1%} off; "
            f"it is multiplied by {self.scale.value:.3f} from here on"
        )


_KNOWN_SPEED = 1.0  # m/s, standard deviation of the velocity in the graph up to which it predicts


class InertialPrediction:
    """Predicts the motion of the LiDAR to each scan by the samples since the scan before, and the graph's newest state.

    settings: of the sensor, placed on the pose of the LiDAR
    """

    def __init__(self, settings: Imu) -> None:
        self._parameters = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
        self._parameters.setBodyPSensor(mounting("mounted", settings.mounted))
        self._max_gap = settings.max_gap
        self._state: gtsam.NavState | None = None
        self._bias, self._known, self._time = gtsam.imuBias.ConstantBias(), False, 0.0

    def begin(self, smoother: IncrementalSmoother) -> None:
        """Go on from the newest state of a graph."""
        graph = smoother.graph()
        pose, velocity, bias = (graph.of(kind, graph.epoch)[0].key for kind in (EGO_POSE, EGO_VELOCITY, EGO_BIAS))
        self._state = gtsam.NavState(graph.state(pose), graph.state(velocity))
        self._bias, self._time = graph.state(bias), graph.time
        self._known = bool(np.linalg.eigvalsh(smoother.covariance(velocity))[-1] < _KNOWN_SPEED**2)

    def velocity(self, time: float, samples: ImuSamples | None) -> FloatArray | None:
        """Velocity (6,), rad/s and m/s, of the LiDAR since the scan before; NaN for an unknown translation.

        None without a state, and where samples are missing.
        """
        before, dt = self._state, time - self._time
        if before is None or samples is None or abs(dt - float(samples.dt.sum())) > self._max_gap:
            self._state = None
            return None
        measured = gtsam.PreintegratedImuMeasurements(self._parameters, self._bias)
        for length, force, rate in zip(samples.dt.tolist(), samples.acceleration, samples.angular_rate, strict=True):
            measured.integrateMeasurement(force, rate, length)
        now = measured.predict(before, self._bias)
        self._state, self._time = now, time
        xi = gtsam.Pose3.Logmap(before.pose().between(now.pose())) / dt
        return np.asarray(xi if self._known else np.concatenate([xi[:3], np.full(3, np.nan)]))


@dataclass(frozen=True, eq=False)
class Vehicle:
    """The vehicle that carries the LiDAR.

    ego_T_lidar (4, 4) pose of the LiDAR on it
    sensors     names of those whose measurements come with the scans; settings: noise and places of all of them
    """

    ego_T_lidar: FloatArray = field(default_factory=lambda: np.eye(4))
    sensors: Collection[SensorName] = ()
    settings: SensorSettings = field(default_factory=SensorSettings)

    def __post_init__(self) -> None:
        if isinstance(self.sensors, str):
            raise InputError(f"sensors: expected a list of names, such as [{self.sensors!r}], got a string")
        checked_transform("ego_T_lidar", self.ego_T_lidar)


def mean_speed(wheels: Sequence[WheelSpeed], deviation: float) -> WheelSpeed:
    """The mean of speeds, whose errors are independent; deviation: of those without one of their own, m/s."""
    dt = np.array([one.dt for one in wheels])
    share, stated = dt / dt.sum() if dt.sum() > 0 else np.full(len(dt), 1 / len(dt)), None
    if any(one.deviation is not None for one in wheels):
        own = [deviation if one.deviation is None else one.deviation for one in wheels]
        stated = float(np.linalg.norm(share * own))
    return WheelSpeed(float(share @ [one.speed for one in wheels]), float(dt.sum()), stated)


class VehicleSensors:
    """Sensors of the vehicle in a graph of the poses of its LiDAR, and what they measured since the last keyframe.

    others_read: whether other providers may read what sensors measure that are not among the vehicle's
    """

    def __init__(self, vehicle: Vehicle, others_read: bool = False) -> None:
        self.names, self._settings, self.ego_T_lidar = tuple(vehicle.sensors), vehicle.settings, vehicle.ego_T_lidar
        self.lidar_T_ego, self._others_read = inverse_transform(self.ego_T_lidar), others_read
        self._since: list[tuple[float, EgoMeasurements]] = []  # the last keyframe, by the times of their scans
        self._warned: set[str] = set()
        self.consistency = SensorConsistency(self.names, self._settings)
        self._wheels = WheelComparison(self._settings.wheels, self.ego_T_lidar)
        self._inertial = InertialPrediction(on_pose(self._settings.imu, self.lidar_T_ego))

    def new_providers(self) -> list[FactorProvider]:
        """Fresh providers of their factors."""
        return sensor_providers(self._settings, self.names, self.lidar_T_ego)

    def placed(self, odometry: Odometry, scan: Scan, time: float, measured: EgoMeasurements) -> OdometryStep:
        """Place the next scan, taken at `time`, s, by an odometry; what was measured since waits for a keyframe.

        Warns once if wheels do not fit the scans.
        """
        wheels = measured.wheels if "wheels" in self.names else None
        velocity = self._velocity(self._wheels.corrected(wheels))
        if "imu" in self.names and (inertial := self._inertial.velocity(time, measured.imu)) is not None:
            velocity = inertial if velocity is None else np.where(np.isnan(inertial), velocity, inertial)
        step = checked_step(odometry.step(scan, time, velocity))
        if "wheels" in self.names:
            used, misfit = self._wheels.compared(wheels, step)
            measured = replace(measured, wheels=used)
            if misfit:
                self.consistency.state("wheels", misfit)
        self._since.append((time, measured))
        return step

    def check(self, measured: EgoMeasurements) -> None:
        """Raise `InputError` for a measurement that nothing reads, and warn once where only other providers may."""
        for name in ("gps", "imu", "wheels"):
            if getattr(measured, name) is None or name in self.names:
                continue
            if not self._others_read:
                raise InputError(f"{name}: expected it among the sensors that were named, as in sensors=[{name!r}]")
            if name not in self._warned:
                _LOG.warning("%s: not among the sensors; only the providers that were given can read it", name)
                self._warned.add(name)

    def frame(self, time: float, detections: Detections | None = None) -> Frame | None:
        """The measurements of a keyframe at `time`, s, besides its scan, for providers; the newest fix has its age."""
        imu = [one.imu for _, one in self._since if one.imu is not None]
        wheels = [one.wheels for _, one in self._since if one.wheels is not None]
        fixes = [(then, one.gps) for then, one in self._since if one.gps is not None]
        if not imu and not wheels and not fixes and detections is None:
            return None
        columns = ("dt", "acceleration", "angular_rate")
        ego = EgoMeasurements(
            gps=replace(fixes[-1][1], age=max(time - fixes[-1][0] + fixes[-1][1].age, 0.0)) if fixes else None,
            imu=ImuSamples(*(np.concatenate([getattr(one, name) for one in imu]) for name in columns)) if imu else None,
            wheels=mean_speed(wheels, self._settings.wheels.deviation) if wheels else None,
        )
        return Frame(time, "lidar", Detections.empty() if detections is None else detections, None, "ego", ego=ego)

    def taken(self) -> None:
        """A keyframe took all measurements so far."""
        self._since = []

    def begin(self, smoother: IncrementalSmoother) -> None:
        """Predict from the newest keyframe of a graph on."""
        if "imu" in self.names:
            self._inertial.begin(smoother)

    def _velocity(self, wheels: WheelSpeed | None) -> FloatArray | None:
        """The velocity (6,) of the LiDAR by the wheels, as `LidarOdometry.step` takes it; None without them."""
        if wheels is None:
            return None
        return np.concatenate([np.full(3, np.nan), self.ego_T_lidar[:3, :3].T @ [wheels.speed, 0.0, 0.0]])


_BASELINE, _SHORTEST = 30.0, 5.0  # m of a drive that tell its heading in the world, and must
_FEWEST_FIXES, _BEST_FIX = 4, 0.02  # fixes on it; m, of any fix
_LEVEL, _TRUE = 0.02, 0.01  # rad: a vehicle's tilt at the first scan; error of a heading by odometry


def start_by_fixes(
    scans: ScanSequence, fixes: FloatArray, antenna: FloatArray, settings: OdometrySettings
) -> tuple[FloatArray, FloatArray]:
    """The first pose (4, 4) of the LiDAR in the world of fixes (n, 4): time, x, y, z, and its covariance (6, 6).

    The path of the antenna (3,), by odometry over the first metres, is laid on the fixes from above. Raises
    `InputError` where these are too few, or too close together.
    """
    odometry, places = LidarOdometry(settings), list[FloatArray]()
    lidar_T_ego = inverse_transform(scans.ego_T_lidar)
    for k, time in enumerate(scans.timestamps.tolist()):
        with scan_context(scans, k):
            pose = scans.ego_T_lidar @ odometry.step(scans[k], time).map_T_lidar @ lidar_T_ego
        places.append(pose[:3, :3] @ antenna + pose[:3, 3])
        if np.linalg.norm(places[-1] - places[0]) > _BASELINE:
            break
    times = scans.timestamps[: len(places)]
    within = fixes[(fixes[:, 0] >= times[0]) & (fixes[:, 0] <= times[-1])]
    path = np.stack([np.interp(within[:, 0], times, axis) for axis in np.array(places).T], axis=1)
    if len(within) < _FEWEST_FIXES or np.linalg.norm(np.ptp(path[:, :2], axis=0)) < _SHORTEST:
        travelled = float(np.linalg.norm(np.ptp(path[:, :2], axis=0))) if len(within) else 0.0
        raise InputError(
            f"gps: expected {_FEWEST_FIXES} fixes over {_SHORTEST:g} m of the drive, which tell its heading, "
            f"got {len(within)} over {travelled:.1f} m"
        )
    a, b = path - path.mean(axis=0), within[:, 1:] - within[:, 1:].mean(axis=0)
    yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    world_T_ego = yaw_transform(yaw=yaw)
    world_T_ego[:3, 3] = within[:, 1:].mean(axis=0) - world_T_ego[:3, :3] @ path.mean(axis=0)
    off = b - a @ world_T_ego[:3, :3].T
    variance = np.maximum((off**2).mean(axis=0), _BEST_FIX**2) * len(within) / (len(within) - 2)
    heading = float(variance[:2].mean() / (a[:, :2] ** 2).sum()) + _TRUE**2
    moved = variance / len(within) + heading * float((path.mean(axis=0)[:2] ** 2).sum())
    P = carried_covariance(lidar_T_ego, np.diag([_LEVEL**2, _LEVEL**2, heading, *moved.tolist()]))
    return world_T_ego @ scans.ego_T_lidar, (P + P.T) / 2
