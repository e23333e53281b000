"""The vehicle's sensors in SLAM: settings, a buffer between poses, and consistency with the graph.

Buffer of the vehicle's measurements between two poses of the graph.

Sensors measure at their own times. The buffer takes measurements as they come, each sensor's in order of time, and
gives those up to a pose's time as one `EgoMeasurements`: inertial samples, each for the time since the one before; the
way of the wheels over the time as a mean speed; the latest fix with its age.

Consistency of each sensor's measurements with the rest of the graph.

A sensor that sits elsewhere or looks elsewhere than its settings say leaves residuals larger than its noise allows, or
drives its biases away. Of the newest factors of a provider, d_i residuals each, whitened and after the solution,

    median_i  || r_i ||^2 / d_i   >  `LARGEST`

is a misfit; with half of the residuals wrong, outliers are no excuse. Biases are compared with their prior.
"""

import logging
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from saga_fg.errors import InputError
from saga_fg.graph import EGO_BIAS, Additions, FactorProvider, GraphView, SceneFactorGraph
from saga_fg.numerics import FloatArray, checked
from saga_fg.providers import Gps, Imu, StartSettings, Wheels, on_pose
from saga_fg.settings import Settings, settings_group
from saga_fg.types import EgoMeasurements, GpsFix, ImuSamples, WheelSpeed

__all__ = [
    "SensorBuffer",
    "SensorConsistency",
    "SensorName",
    "SensorSettings",
    "sensor_providers",
]

_LOG = logging.getLogger(__name__)
_LONGEST = 0.5  # s that the first measurement stands for at most; the second one says how long its interval is
_GAP = 3.0  # intervals like the one before, beyond which measurements are missing
_MIN_SPAN = 1e-9  # s


class SensorBuffer:
    """Measurements that no pose has taken yet. Every method raises `InputError` for time that runs backwards."""

    def __init__(self) -> None:
        self._kept: dict[str, list[tuple[float, float, FloatArray]]] = {"imu": [], "wheels": []}
        self._gps = list[tuple[float, GpsFix]]()
        self._newest: dict[str, float] = {}
        self._taken = -math.inf
        self._silent: set[str] = set()

    def add_imu(self, time: float, acceleration: FloatArray, angular_rate: FloatArray) -> None:
        """Specific force (3,), m/s^2, and turn rate (3,), rad/s, at `time`, s, for the time since the sample before."""
        both = [checked("imu: acceleration", acceleration, (3,)), checked("imu: angular_rate", angular_rate, (3,))]
        self._add("imu", time, np.concatenate(both))

    def add_wheels(self, time: float, speed: float) -> None:
        """Speed ahead, m/s, at `time`, s, for the time since the speed before."""
        if not math.isfinite(speed):
            raise InputError(f"wheels: speed: expected a finite number, got {speed!r}")
        self._add("wheels", time, np.array([speed]))

    def add_gps(self, time: float, position: FloatArray, covariance: FloatArray | None = None) -> None:
        """A place (2,) or (3,), world, m, at `time`, s; covariance, m^2: by the settings if None."""
        fix = GpsFix(position, covariance)
        self._in_order("gps", time)
        self._gps.append((time, fix))

    def take(self, time: float) -> EgoMeasurements:
        """The measurements after the last pose and up to this one, at `time`, s, which then count as taken."""
        if not time > self._taken:
            raise InputError(f"time: expected one after {self._taken:.6f} s, got {time:.6f} s")
        since, self._taken = self._taken, time
        fixes = [replace(fix, age=time - then) for then, fix in self._gps if since < then <= time]
        self._gps = [one for one in self._gps if one[0] > time]
        (dt, samples), (rolled, speeds) = (self._measured(name, since, time) for name in ("imu", "wheels"))
        imu = ImuSamples(dt, samples[:, :3], samples[:, 3:]) if len(dt) else None
        total = float(rolled.sum())
        wheels = WheelSpeed(float(rolled @ speeds[:, 0]) / total, total) if len(rolled) else None
        return EgoMeasurements(gps=fixes[-1] if fixes else None, imu=imu, wheels=wheels)

    def _measured(self, sensor: str, since: float, until: float) -> tuple[FloatArray, FloatArray]:
        """Times (n,) of an interval, s, that measurements stand for, and these (n, d).

        A measurement stands for the time since the one before, or for as long as that one where some are missing
        between them; the newest also for as long after it. Warns once when a sensor falls silent.
        """
        if not (kept := self._kept[sensor]):
            return np.empty(0), np.empty((0, 0))
        time, length, value = (np.array(column) for column in zip(*kept, strict=True))
        self._kept[sensor] = kept[max(int(np.searchsorted(time, until, side="right")) - 1, 0) :]
        length[np.isinf(length)] = _LONGEST
        start, end = time - length, time.copy()
        if since < time[-1] <= until:
            end[-1] += min(until - end[-1], length[-1])
        spans = np.clip(np.minimum(end, until) - np.maximum(start, since), 0.0, None)
        missing = until - since - float(spans.sum())
        silent = start[0] < since and missing > _GAP * float(np.median(length))
        if silent and sensor not in self._silent:
            _LOG.warning("%s: no measurements for %.2f s before %.2f s", sensor, missing, until)
        (self._silent.add if silent else self._silent.discard)(sensor)
        used = (spans > _MIN_SPAN) & math.isfinite(since)
        return spans[used], value[used]

    def _add(self, sensor: str, time: float, value: FloatArray) -> None:
        """Keep a measurement and the time that it stands for, s; of the first, that is infinite until the second."""
        self._in_order(sensor, time)
        kept, length = self._kept[sensor], math.inf
        if kept:
            before, usual, other = kept[-1]
            length = time - before
            if math.isinf(usual):
                length = min(length, _LONGEST)
                kept[-1] = before, length, other
            elif length > _GAP * usual:
                length = usual
        kept.append((time, length, value))

    def _in_order(self, sensor: str, time: float) -> None:
        newest = self._newest.get(sensor, -math.inf)
        if not (math.isfinite(time) and time > newest):
            raise InputError(f"{sensor}: expected a time after {newest:.6f} s, got {time:.6f} s")
        if time <= self._taken:
            raise InputError(f"{sensor}: {time:.6f} s comes too late, the pose at {self._taken:.6f} s is estimated")
        self._newest[sensor] = time


SensorName = Literal["gps", "imu", "wheels"]


@dataclass(frozen=True)
class SensorSettings(Settings):
    """Noise and places of the sensors; which of them there are is said where their measurements come from.

    GPS has no gate here: odometry and fixes come in one step, before the covariance of the pose is known.
    """

    gps: Gps = settings_group(
        lambda: Gps(gate=1.0, outlier_scale=3.0), "satellite receiver; the robust loss takes the place of the gate"
    )
    imu: Imu = settings_group(lambda: Imu(StartSettings(planar=False)), "accelerometers and gyroscopes")
    wheels: Wheels = settings_group(Wheels, "speed of the wheels")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gps.gate < 1:
            raise InputError(
                f"gps.gate: expected 1, as outlier_scale bounds the weight of false fixes, got {self.gps.gate:g}"
            )


@dataclass(frozen=True)
class Inertial:
    """Inertial samples between poses that odometry adds: velocity and biases come after the pose, not before."""

    imu: Imu

    @property
    def name(self) -> str:
        return self.imu.name

    def factors(self, view: GraphView) -> Additions:
        return self.imu.predict(view)


def sensor_providers(
    settings: SensorSettings, sensors: Collection[str], pose_T_vehicle: FloatArray
) -> list[FactorProvider]:
    """The providers of the sensors named, for a graph of poses in space that others add before them.

    pose_T_vehicle: (4, 4) the vehicle, on which the settings place the sensors, in the frame of the graph's pose, such
    as lidar_T_ego. Raises `InputError` for an unknown sensor.
    """
    known = get_args(SensorName)
    unknown = [name for name in sensors if name not in known]
    if unknown:
        raise InputError(f"sensors: expected some of {', '.join(known)}, got {unknown[0]!r}")
    made: dict[str, FactorProvider] = {
        "imu": Inertial(on_pose(settings.imu, pose_T_vehicle)),
        "wheels": on_pose(settings.wheels, pose_T_vehicle),
        "gps": on_pose(settings.gps, pose_T_vehicle),
    }
    return [provider for name, provider in made.items() if name in sensors]


WINDOW = 60  # factors of a sensor that are looked at
LEAST = 15  # that are needed
LARGEST = 2.0  # median of the squared residuals by dimension: below 1 where all is well; robust losses bound it
_BOUND = 0.9  # of the squared scale of a Cauchy loss: a residual three times that scale
_BIAS = 4.0  # standard deviations of the prior


class SensorConsistency:
    """Whether sensors fit the graph that they are part of; sensors: their names, settings: theirs.

    `observe` takes a graph, of providers by `sensor_providers`, as it is solved. Where a graph forgets, it is called
    again before: each factor counts with its last residual.
    """

    def __init__(self, sensors: Collection[str], settings: SensorSettings) -> None:
        self._sensors, self._settings = tuple(sensors), settings
        self._scores: dict[str, dict[tuple[float, str, int], float]] = {sensor: {} for sensor in sensors}
        self._bias: FloatArray | None = None  # (6,), the newest
        self._observed = -math.inf  # s
        self._stated: dict[str, str] = {}  # what is known of sensors without the graph

    def state(self, sensor: str, misfit: str) -> None:
        """Take an explanation why a sensor does not fit from elsewhere, and warn at once."""
        self._stated[sensor] = misfit
        _LOG.warning(misfit)

    def observe(self, graph: SceneFactorGraph, every: float = 0.0) -> None:
        """Take the residuals of a graph at its solution, and its newest biases; at most once in `every` s."""
        if graph.time < self._observed + every:
            return
        self._observed = graph.time
        for sensor, scores in self._scores.items():
            name = getattr(self._settings, sensor).name
            found = _residual_scores(graph, name, None if sensor == "gps" else WINDOW)
            scores |= dict(sorted(found.items()))
        if "imu" in self._sensors and (known := graph.of(EGO_BIAS, graph.epoch)):
            self._bias = np.asarray(graph.state(known[0].key).vector())

    def forget(self, since: float) -> None:
        """Drop the residuals from a time on, s, as the poses there turned out wrong."""
        for name, scores in self._scores.items():
            self._scores[name] = {key: score for key, score in scores.items() if key[0] < since}

    @property
    def misfits(self) -> dict[str, str]:
        """Inconsistent sensors, the least consistent one first, each with an explanation, by name."""
        found: dict[str, tuple[float, str]] = {}
        for sensor in self._sensors:
            name, scores = getattr(self._settings, sensor).name, self._newest(sensor)
            if len(scores) >= LEAST and np.median(scores) > LARGEST:
                found[sensor] = (
                    float(np.median(scores)),
                    (
                        f"{name}: the residuals of its last {len(scores)} measurements are larger than its noise "
                        "allows; check where its settings place it on the vehicle, its units, and its noise"
                    ),
                )
        if self._bias is not None:
            imu = self._settings.imu
            deviations = np.repeat([imu.accelerometer_bias, imu.gyroscope_bias], 3)
            share = float(np.abs(self._bias / deviations).max())
            if share > _BIAS and share**2 > found.get("imu", (0.0, ""))[0]:
                force, rate = np.abs(self._bias[:3]).max(), np.abs(self._bias[3:]).max()
                found["imu"] = (
                    share**2,
                    (
                        f"{imu.name}: its biases are {share:.1f} times as large as its settings expect "
                        f"({force:.2f} m/s^2, {rate:.3f} rad/s); "
                        "check how its settings turn it on the vehicle, its units, and gravity"
                    ),
                )
        ranked = {sensor: text for sensor, (_, text) in sorted(found.items(), key=lambda one: -one[1][0])}
        return {**ranked, **self._stated}

    @property
    def unjudged(self) -> dict[str, str]:
        """Sensors with too few factors in the graph to judge them, likewise."""
        counts = {sensor: len(self._newest(sensor)) for sensor in self._sensors}
        return {
            sensor: f"{getattr(self._settings, sensor).name}: "
            + (
                f"factors in the graph: {count}, too few to judge whether it fits; {LEAST} are needed"
                if count
                else "not used so far, the graph has no factors of it"
            )
            for sensor, count in counts.items()
            if count < LEAST
        }

    @property
    def false_fixes(self) -> str:
        """How many fixes by GPS lie so far off that the robust loss hardly counts them, in words; empty for none."""
        gps, scores = self._settings.gps, np.array(list(self._scores.get("gps", {}).values()))
        loss = gps.outlier_scale
        off = int((3 * scores > _BOUND * loss**2).sum())  # residuals weighted by the loss stay below its scale
        if not np.isfinite(loss) or not off:
            return ""
        return f"{gps.name}: {off} of {len(scores)} fixes lie more than {3 * loss:.0f} deviations off, and hardly count"

    def warn(self) -> None:
        """Log all of these, but for those that were stated before."""
        for text in filter(None, (*self.misfits.values(), *self.unjudged.values(), self.false_fixes)):
            if text not in self._stated.values():
                _LOG.warning(text)

    def _newest(self, sensor: str) -> list[float]:
        return list(self._scores[sensor].values())[-WINDOW:]


def _residual_scores(graph: SceneFactorGraph, provider: str, most: int | None) -> dict[tuple[float, str, int], float]:
    """Squared whitened residuals by dimension of the newest factors of a provider, those of priors left out.

    By the time, name and row of each; most: of them, None for all
    """
    scores: dict[tuple[float, str, int], float] = {}
    point = graph.point()
    for held in reversed(list(graph.groups.values())):
        if held.provider != provider:
            continue
        times = {
            row: max(moments)
            for row in held.rows.tolist()
            if (moments := [t for key in held.factors.rows[row] if (t := graph.variables[key].time) is not None])
        }
        linear = graph.linearised(held, np.array(list(times), dtype=np.int64), point) if times else ()
        for (row, time), factor in zip(times.items(), linear, strict=True):
            step = np.concatenate([point.increment(key) for key in factor.keys()])  # noqa: SIM118 -- a factor of GTSAM
            r = factor.augmentedJacobian()[:, -1] - factor.augmentedJacobian()[:, :-1] @ step
            scores[time, held.factors.name, row] = float(r @ r) / len(r)
        if most is not None and len(scores) >= most:
            break
    return scores
