"""Messages of sensors (`Frame`, `Detections`, motion of the vehicle), and types of the landmarks they observe.

A new type of landmark is one object with these members; association, filtering, smoothing, merging and output follow
from them. `docs/guides/add-a-landmark.md` adds one.

    state      `variable`: reading from `gtsam.Values`, retraction and difference
    predict    `factors`: residual and covariance of an observation against the map, which gates and filter linearise
    initialise the state of a landmark from its first observation

An observation must determine its landmark: as many residuals as the state has dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.numerics import (
    Columns,
    FloatArray,
    IntArray,
    checked,
    checked_covariances,
    checked_transform,
    from_upper_triangle,
    upper_triangle,
)
from saga_fg.types.boxes import MAX_POSITION, MAX_SPEED, Boxes
from saga_fg.types.road_map import RoadMap
from saga_fg.types.track import ShownTable

if TYPE_CHECKING:  # frames bring observations of landmarks, and are read before anything is estimated
    import gtsam

    from factors import PlanarPose, ResidualFactors, SpatialPose, Variable

LandmarkFactors: TypeAlias = "Sequence[ResidualFactors | gtsam.NonlinearFactor]"


class LandmarkType(Protocol):
    """A type of stationary object."""

    @property
    def name(self) -> str:
        """Name in messages and files."""

    @property
    def pose(self) -> PlanarPose | SpatialPose:
        """The type of pose that observes it."""

    @property
    def variable(self) -> Variable:
        """The type of its state."""

    @property
    def density(self) -> float:
        """Expected number per unit of its tangent, e.g. 1/m^2, for the odds of a new landmark in association."""

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> LandmarkFactors:
        """Return n factors, in this order: rows (n, 2) keys of pose and landmark, observed (n, m), covariances
        (n, d, d).
        """

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> Any:
        """Return the state of a landmark by an observation (m,) from a pose, given as a matrix."""

    def coordinates(self, state: Any) -> dict[str, float]:
        """Return the numbers of a state for files, by name; among them "x" and "y", m, for drawings."""


@dataclass(frozen=True, eq=False)
class Observation:
    """kind: of the landmark; value: (m,) what was measured, in the frame of the pose; covariance: (d, d) of the
    residuals; extent: (2, 3) ends of the piece of a wall or line that was seen, m, in that frame, None where unknown.
    """

    kind: LandmarkType
    value: FloatArray
    covariance: FloatArray
    extent: FloatArray | None = None

    def __post_init__(self) -> None:
        d = self.kind.variable.dim
        value = checked(f"observed {self.kind.name}", self.value, (None,))
        covariance = checked_covariances(f"covariance of a {self.kind.name}", [self.covariance], 1, d)[0]
        extent = None if self.extent is None else checked(f"extent of a {self.kind.name}", self.extent, (2, 3))
        vars(self).update(value=value, covariance=covariance, extent=extent)


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of the map: its state, the covariance (d, d) of that, and the number of its observations."""

    number: int
    kind: LandmarkType
    state: Any
    covariance: FloatArray
    observations: int
    confirmed: bool


_TANGENT = {3: 3, 4: 6}  # dimension of the motions of so large a transform


@dataclass(frozen=True, eq=False)
class OdometryIncrement:
    """Motion of the vehicle over the last `dt` s.

    before_T_now  where it is now in its frame of then, (3, 3) in the plane or (4, 4) in space
    covariance    (3, 3) of (x, y, heading), or (6, 6) of (rotation vector, translation), in the frame of now, m and
                  rad; None: by the provider's settings
    """

    before_T_now: FloatArray
    dt: float
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        from factors import FactorError, pose  # GTSAM, which frames without odometry do not need

        motion = checked("odometry", self.before_T_now, (None, None))
        if motion.shape not in ((3, 3), (4, 4)):
            raise InputError(f"odometry: expected a 3 x 3 or 4 x 4 transform, got shape {motion.shape}")
        try:
            pose("odometry", motion)
        except FactorError as error:
            raise InputError(str(error)) from error
        if not (isinstance(self.dt, int | float) and math.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"odometry: dt: expected a finite number of seconds > 0, got {self.dt!r}")
        covariance = _covariance("odometry: covariance", self.covariance, _TANGENT[len(motion)])
        vars(self).update(before_T_now=motion, covariance=covariance)


@dataclass(frozen=True, eq=False)
class GpsFix:
    """A measured place, (2,) or (3,), world, m.

    covariance  (2, 2) or (3, 3), None: by the provider's settings
    age         s between the fix and the frame that brings it
    """

    position: FloatArray
    covariance: FloatArray | None = None
    age: float = 0.0

    def __post_init__(self) -> None:
        _check_number("gps: age", self.age, 0.0)
        place = checked("gps", self.position, (None,))
        if len(place) not in (2, 3):
            raise InputError(f"gps: expected a place of 2 or 3 coordinates, got {len(place)}")
        vars(self).update(position=place, covariance=_covariance("gps: covariance", self.covariance, len(place)))


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """n >= 1 samples since the frame before, in the vehicle's axes.

    dt (n,) s that each stands for; acceleration (n, 3) specific force, m/s^2: (0, 0, 9.81) at rest on level ground;
    angular_rate (n, 3), rad/s
    """

    dt: FloatArray
    acceleration: FloatArray
    angular_rate: FloatArray

    def __post_init__(self) -> None:
        dt = checked("imu: dt", self.dt, (None,))
        if len(dt) == 0:
            raise InputError("imu: expected at least one sample, got none")
        if not (dt > 0).all():
            raise InputError(f"imu: dt[{int(np.argmin(dt))}]: expected a number of seconds > 0, got {dt.min():g}")
        vars(self)["dt"] = dt
        for name in ("acceleration", "angular_rate"):
            vars(self)[name] = checked(f"imu: {name}", getattr(self, name), (len(dt), 3))


@dataclass(frozen=True, eq=False)
class WheelSpeed:
    """Mean speed ahead over the last `dt` s, m/s, negative backwards; deviation, m/s: None: by the settings."""

    speed: float
    dt: float
    deviation: float | None = None

    def __post_init__(self) -> None:
        _check_number("wheels: speed", self.speed, -math.inf)
        _check_number("wheels: dt", self.dt, 0.0)
        if self.deviation is not None:
            _check_number("wheels: deviation", self.deviation, 0.0)


@dataclass(frozen=True, eq=False)
class EgoMeasurements:
    """All of them, as far as there are any; landmarks: what is seen of each, by its id."""

    odometry: OdometryIncrement | None = None
    gps: GpsFix | None = None
    imu: ImuSamples | None = None
    landmarks: Mapping[int, Observation] = field(default_factory=dict)
    wheels: WheelSpeed | None = None

    def __post_init__(self) -> None:
        for name, kind in (
            ("odometry", OdometryIncrement),
            ("gps", GpsFix),
            ("imu", ImuSamples),
            ("wheels", WheelSpeed),
        ):
            value = getattr(self, name)
            if value is not None:
                require_type(name, value, kind)
        if not isinstance(self.landmarks, Mapping) or not all(
            isinstance(seen, Observation) for seen in self.landmarks.values()
        ):
            raise InputError("landmarks: expected Observations by the ids of their landmarks")


def _covariance(name: str, value: ArrayLike | None, dim: int) -> FloatArray | None:
    return None if value is None else checked_covariances(name, checked(name, value, (dim, dim))[None], 1, dim)[0]


def _check_number(name: str, value: float, least: float) -> None:
    if not (isinstance(value, int | float | np.floating) and math.isfinite(value) and value >= least):
        raise InputError(f"{name}: expected a finite number{' >= 0' if least == 0 else ''}, got {value!r}")


Coordinates = Literal["world", "ego", "sensor"]
NAN = float("nan")
LATEST = 1e11  # s; the year 5138 where the epoch is 1970, and more than any clock in finer units shows today


@dataclass(frozen=True)
class Detection:
    """One detected object. NaN stands for "not measured" in size, yaw, velocity and range rate.

    position: centre (x, y, z), m; size: (length, width, height), m; yaw: rad about z; velocity: (vx, vy), m/s over
    ground; score: the detector's confidence, any finite number (probability or logit: see the sensor's model);
    range_rate: m/s, position_covariance: (xx, xy, yy), m^2, identity: see `Detections`.
    """

    label: str
    position: tuple[float, float, float]
    size: tuple[float, float, float] = (NAN, NAN, NAN)
    yaw: float = NAN
    velocity: tuple[float, float] = (NAN, NAN)
    score: float = 1.0
    range_rate: float = NAN
    position_covariance: tuple[float, float, float] = (NAN, NAN, NAN)
    identity: int = -1

    def __post_init__(self) -> None:
        Detections.of([self])


@dataclass(frozen=True, eq=False)
class Detections(Columns, ShownTable):
    """N detections: `boxes`, `score` (N,), `range_rate` (N,), `position_covariance` (N, 2, 2), `identity` (N,).

    Iterating gives `Detection`s.

    A range rate (m/s; NaN, as by default: not measured) is measured by radars: the component of the velocity
    *over ground* along the horizontal line of sight from the sensor, positive when the object moves away. Where the
    radar gives it relative to itself, add the component of the sensor's own velocity along that line first.

    A covariance of the horizontal position, m^2, in the coordinates of the boxes, is reported by some detectors; it
    takes the place of the noise of the sensor's model. NaN, as by default: not reported.

    A sensor that follows objects by itself, or another tracker, gives each an identity: a number from 0 on, once in a
    frame; -1, as by default, for none. It is evidence for the association.
    """

    boxes: Boxes
    score: FloatArray
    range_rate: FloatArray = field(default_factory=lambda: np.array(NAN))  # a single number serves all
    position_covariance: FloatArray = field(default_factory=lambda: np.array(NAN))
    identity: IntArray = field(default_factory=lambda: np.array(-1))

    def __post_init__(self) -> None:
        n = len(self.boxes)
        rate = np.full(n, self.range_rate) if np.ndim(self.range_rate) == 0 else self.range_rate
        rate = checked("range_rate", rate, (n,), "finite-or-nan")
        if (np.abs(rate) > MAX_SPEED).any():
            row = int(np.argmax(np.abs(rate) > MAX_SPEED))
            raise InputError(f"range_rate[{row}]: expected numbers within {MAX_SPEED:g}, got {rate[row]:g}")
        vars(self).update(score=checked("score", self.score, (n,)), range_rate=rate)
        vars(self)["position_covariance"] = _position_covariances(self.position_covariance, n)
        vars(self)["identity"] = _identities(self.identity, n)

    @classmethod
    def of(cls, detections: Sequence[Detection]) -> Self:
        """The table of some `Detection`s. Raises `InputError` for anything else."""
        rows = detections = list(detections) if isinstance(detections, Iterable) else [detections]
        odd = next((type(d).__name__ for d in rows if not isinstance(d, Detection)), None)
        if odd is not None:
            raise InputError(f"detections: expected a list of Detection, got {odd}; for arrays there is Boxes.of")
        boxes = Boxes.of(
            [d.label for d in detections],
            [d.position for d in detections],
            [d.size for d in detections],
            [d.yaw for d in detections],
            [d.velocity for d in detections],
        )
        n = len(detections)
        rate = checked("range_rate", [d.range_rate for d in detections], (n,), "finite-or-nan")
        entries = [d.position_covariance for d in detections]
        covariance = from_upper_triangle(checked("position_covariance", entries, (n, 3), "finite-or-nan"))
        score = checked("score", [d.score for d in detections], (n,))
        identity = np.array([d.identity for d in detections], dtype=np.int64)
        return cls(boxes, score, rate, covariance, identity)

    @classmethod
    def empty(cls) -> Self:
        return cls(Boxes.empty(), np.empty(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, one after the other."""
        return super().concatenate(parts) if parts else cls.empty()

    def __getitem__(self, row: int) -> Detection:
        b = self.boxes
        return Detection(
            label=str(b.label[row]),
            position=tuple(b.position[row].tolist()),
            size=tuple(b.size[row].tolist()),
            yaw=float(b.yaw[row]),
            velocity=tuple(b.velocity[row].tolist()),
            score=float(self.score[row]),
            range_rate=float(self.range_rate[row]),
            position_covariance=tuple(upper_triangle(self.position_covariance[[row]])[0].tolist()),
            identity=int(self.identity[row]),
        )

    def __iter__(self) -> Iterator[Detection]:
        return (self[row] for row in range(len(self)))

    def _shown(self) -> tuple[str, Mapping[str, Any]]:
        boxes = self.boxes
        place = {"x, m": boxes.position[:, 0], "y, m": boxes.position[:, 1]}
        size = {"length, m": boxes.size[:, 0], "width, m": boxes.size[:, 1]}
        columns = {"class": boxes.label, **place, **size, "yaw, rad": boxes.yaw, "score": self.score}
        return f"{len(self)} detections", columns

    def transformed(self, target_T_source: FloatArray) -> Self:
        """The detections in target coordinates."""
        R = target_T_source[:2, :2]
        covariance = R @ self.position_covariance @ R.T
        return type(self)(
            self.boxes.transformed(target_T_source), self.score, self.range_rate, covariance, self.identity
        )


def _identities(value: IntArray, n: int) -> IntArray:
    """Numbers (n,), -1 for none. Raises `InputError` for one below, and for one that occurs twice."""
    if np.ndim(value) == 0:
        return np.full(n, value, dtype=np.int64)
    numbers = np.asarray(value)
    if numbers.shape != (n,) or (n and numbers.dtype.kind not in "iu"):
        raise InputError(f"identity: expected {n} whole numbers, got {numbers.dtype} of shape {numbers.shape}")
    given = np.sort(numbers[numbers != -1])
    twice = given[1:][given[1:] == given[:-1]]
    if len(given) and given[0] < 0:
        raise InputError(f"identity: expected numbers from 0 on, or -1 for none, got {given[0]}")
    if len(twice):
        raise InputError(f"identity: expected each number once in a frame, {twice[0]} occurs twice")
    return numbers.astype(np.int64)


def _position_covariances(value: FloatArray, n: int) -> FloatArray:
    """Covariances (n, 2, 2), NaN where unknown. Raises `InputError` for others than positive definite ones."""
    if np.ndim(value) == 0:
        return np.full((n, 2, 2), value)
    covariance = checked("position_covariance", value, (n, 2, 2), "finite-or-nan")
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    whole = covariance.copy()
    whole[known] = checked_covariances("position_covariance", covariance[known], len(known), 2)
    whole.flags.writeable = False
    return whole


@dataclass(frozen=True, eq=False)
class Frame:
    """One message of one sensor: everything it detected at `timestamp`. An empty frame means that it detected nothing.

    timestamp    s, any epoch, the same for all sensors of a scene
    sensor       the sensor's name, e.g. "lidar"
    detections   boxes in `coordinates`: "world", "ego" (vehicle) or "sensor"
    world_T_ego  (4, 4) pose of the vehicle at `timestamp`; required unless `coordinates` is "world" and no range rate
                 was measured, or `ego` is there to estimate it from
    token        the dataset's own name of the record, "" if none
    road_map     the road from now on, in addition to maps of earlier frames; None: nothing new
    ego          what the vehicle measured of itself, for factor providers (`saga_fg.providers`)

    Raises `InputError` for a timestamp that is not finite or cannot be seconds, an unknown kind of coordinates, a pose
    that is not rigid or beyond all places.
    """

    timestamp: float
    sensor: str
    detections: Detections
    world_T_ego: FloatArray | None = None
    coordinates: Coordinates = "world"
    token: str = ""
    road_map: RoadMap | None = None
    ego: EgoMeasurements | None = None

    def __post_init__(self) -> None:
        timestamp = finite_seconds(self.timestamp)
        if abs(timestamp) > LATEST:
            raise InputError(f"timestamp: expected seconds, got {timestamp:g}: milli-, micro- or nanoseconds?")
        vars(self)["timestamp"] = timestamp
        if not isinstance(self.sensor, str) or not self.sensor:
            raise InputError(f"sensor: expected a name, got {self.sensor!r}")
        require_type("detections", self.detections, Detections)
        if self.coordinates not in get_args(Coordinates):
            raise InputError(
                f"coordinates: expected one of {', '.join(get_args(Coordinates))}, got {self.coordinates!r}"
            )
        if self.ego is not None:
            require_type("ego", self.ego, EgoMeasurements)
        if self.world_T_ego is not None:
            pose = checked_transform("world_T_ego", self.world_T_ego)
            if (np.abs(pose[:3, 3]) > MAX_POSITION).any():
                place = pose[:3, 3].tolist()
                raise InputError(f"world_T_ego: expected a place within {MAX_POSITION:g} m, got {place}")
            vars(self)["world_T_ego"] = pose
        elif self.ego is not None:
            return
        elif self.coordinates != "world":
            raise InputError(
                f"world_T_ego: expected a pose, since the detections are in {self.coordinates} coordinates"
            )
        elif np.isfinite(self.detections.range_rate).any():
            raise InputError(
                "world_T_ego: expected a pose, since range_rate is along the line of sight from the sensor"
            )

    def __len__(self) -> int:
        return len(self.detections)


def finite_seconds(timestamp: Any) -> float:
    """A timestamp as a finite number of seconds, or `InputError`."""
    try:
        seconds = NAN if isinstance(timestamp, str | bytes) else float(timestamp)
    except (TypeError, ValueError, OverflowError):
        seconds = NAN
    if not math.isfinite(seconds):
        got = "a larger one" if isinstance(timestamp, int) else repr(timestamp)[:40]
        raise InputError(f"timestamp: expected a finite number of seconds, got {got}")
    return seconds
