"""LiDAR odometry: the motion of the sensor scan by scan, and keyframes of a drive.

    predict    T- = T_(k-1) exp(dt xi)                        the velocity of the step before, or of other sensors
    de-skew    by xi, where the points have times; by other sensors: xi at the scan, half a step after that of the step
    register   T = point-to-plane ICP of a thinned scan against the surfels of the scans before, from T-
    adapt      e_k = || trans D || + 2 r sin(angle(D) / 2),  D = (T-)^-1 T,  r a typical range
               sigma_k = root mean square of the e so far, not below a floor
    extend     the map, by scans that moved on since the last that did (keyframes)

A scan that overlaps less with the map than scans before it, or lies off its surfels, is lost, or was moved: it is
looked for around the last scan that fitted, and enters the map only where it fits or after several such scans.

In a tunnel or an open field some motions are left open (`data_tools.lidar.registration`). Along these the pose stays as
predicted, the step names them, and its covariance is wide there, so that a graph relies on other sensors.

A point may lie as far from the mean of its surfel as a voxel is wide, and three sigma more; residuals above
max(floor, sigma) lose weight. The scheme (constant velocity, adaptive threshold, local voxel map) is that of Vizzo et
al., KISS-ICP, RA-L 2023; planes in place of points need fewer of them, and give the covariance of the pose.
"""

import logging
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar import (
    Observability,
    Registration,
    RegistrationError,
    Scan,
    Structure,
    SurfelMap,
    constant_velocity,
    deskewed,
    register,
    upright,
    voxel_downsample,
)
from data_tools.trajectories import rotation_angle
from saga_fg import InputError
from saga_fg.errors import require_type
from saga_fg.numerics import FloatArray, checked, checked_transform, inverse_transform, transform_points, yaw_transform
from saga_fg.settings import Positive, Settings, setting

_FIRST_DEVIATION = 1.0  # standard deviation of the first motion, m
_DEVIATION_FLOOR = 0.1  # least standard deviation of the prediction, m; higher: a wider search for pairs
_LOG = logging.getLogger(__name__)
_STANDING = 0.5  # m/s, speed from which on the motion says where the road goes
_SPEED_OFF = 2.0  # m/s that a speed by other sensors may differ from that of the scans, slip and lever arms included
_ACCELERATION = 10.0  # m/s^2 that a vehicle reaches
_FASTEST = 70.0  # m/s, of a vehicle whose speed nobody knows yet
_OUT_OF_RANGE = 5  # scans in a row
KEYFRAME_DISTANCE = 0.5  # distance from the last keyframe that makes a scan the next one, m
KEYFRAME_ROTATION = 0.05  # rotation from the last keyframe that makes a scan the next one, rad
LOST_TRANSLATION = 1.0  # standard deviation of a motion along what points leave open, m
LOST_ROTATION = 0.05  # standard deviation of a rotation that was only predicted, rad
_CLEARLY, _SKEWED = 0.9, 3  # of the residual; rounds that take the skew out of the first two scans
_UNKNOWN_SPEED = 10.0  # m/s, standard deviation of a speed that nothing has shown yet
_UNKNOWN_ACCELERATION = 1.0  # m/s^2/sqrt(Hz), of a vehicle along a motion that scans leave open
_LOST, _POOR, _WORSE = 0.75, 0.85, 2.0  # of the usual share of points with pairs, and of the usual residual
_ALIKE = 0.85  # of the usual residual, where a scan is found again: there it has .4 to .7, in another street 1 to 2
_USUAL = 0.1  # weight of the newest scan in what is usual
_ELSEWHERE, _BEGIN_ANEW = 3, 10  # scans in a row that do not fit: carried further; they enter the map all the same
_ANYWHERE = np.diag([0.1, 0.1, 1.0, 30.0, 30.0, 3.0]) ** 2  # rad^2, m^2, of a motion that nothing shows
_SHIFTS, _TURNS = np.arange(-12.0, 12.1, 1.5), np.linspace(-np.pi, np.pi, 36, endpoint=False)  # m, rad: where to look
_SCAN_SPACING = 1.5  # m, of the points that are registered: KISS-ICP's, 1.5 of its voxels of a metre
_STANDING_POINTS, _TRIED = 60, 10  # of a scan that are laid on the map; places that are registered


@dataclass(frozen=True)
class OdometrySettings(Settings):
    """Sizes for a vehicle among houses; halve `surfel_size` indoors."""

    min_range: Positive = setting(3.0, "ignore nearer points, which are on the vehicle, m")
    max_range: Positive = setting(100.0, "ignore points and surfels further away, m")
    surfel_size: Positive = setting(1.0, "voxel size of the surfels, m; usual 0.5 to 1")
    map_spacing: Positive = setting(0.25, "spacing of the points that enter the map, m")


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """One scan placed.

    timestamp    s
    map_T_lidar  (4, 4); the map's frame is the sensor's of the first scan
    covariance   (6, 6) of the motion since the scan before, (rotation, translation) in the scan's frame, rad^2 and m^2;
                 after `lost` scans: of the motion since the one before them
    scan         without skew, points too near and too far left out
    keyframe     whether it went into the map
    registration None for the first scan, and for one that could not be registered and lies where it was predicted
    degenerate   motions that the scan leaves open, in words such as "along the road"
    lost         scans right before it that were only predicted, none of them a keyframe
    """

    timestamp: float
    map_T_lidar: FloatArray
    covariance: FloatArray
    scan: Scan
    keyframe: bool
    registration: Registration | None
    degenerate: tuple[str, ...] = ()
    lost: int = 0


class LidarOdometry:
    """Takes scans in order of time and returns the pose of each."""

    def __init__(self, settings: OdometrySettings | None = None) -> None:
        self.settings = settings or OdometrySettings()
        self._map = SurfelMap(self.settings.surfel_size, self.settings.max_range)
        self._last: OdometryStep | None = None
        self._keyframe = np.eye(4)
        self._velocity = np.zeros(6)  # rad/s, m/s, in the sensor's frame
        self._squares, self._count = _FIRST_DEVIATION**2, 1
        self._first: Scan | None = None  # with its skew, until the second one comes
        self._usual: FloatArray | None = None  # (2,) share of points with pairs, and residual, m, of scans that fit
        self._degenerate: tuple[str, ...] = ()
        self._velocity_known = False  # by a scan that showed the whole motion, or by other sensors
        self._confirmed: float | None = None  # s, when a scan showed the whole motion, or a speed was taken after one
        self._misfits = 0  # scans in a row that did not fit
        self._elsewhere = False  # the sensor is lost, which was reported
        self._places: list[FloatArray] = []  # (3,) of scans in the map, m
        self._open: tuple[float, float] | None = None  # since when motions are open, s, and deviation of the speed
        self._registered: OdometryStep | None = None  # the last one that was registered, or the first
        self._lost = 0  # scans since then
        self._refused = False  # whether the last velocity by other sensors was
        self._out_of_range = 0  # scans in a row without a point within range

    @property
    def deviation(self) -> float:
        """Sigma: typical distance of a point from its prediction by constant velocity, m."""
        return max(_DEVIATION_FLOOR, float(np.sqrt(self._squares / self._count)))

    def step(self, scan: Scan, timestamp: float, velocity: FloatArray | None = None) -> OdometryStep:
        """Place the next scan. Raises `InputError` for one that is not later than the one before, and for a first one
        or several in a row whose points are all out of range.

        velocity: (6,) since then by other sensors, turn rate, rad/s, and velocity, m/s, in the sensor's frame; NaN
        where they say nothing. It predicts the motion in place of that of the scan before, unless no vehicle can have
        changed its velocity so much since then, or the first two scans fit each other clearly better without it.
        """
        s, last = self.settings, self._last
        if not np.isfinite(timestamp):
            raise InputError(f"timestamp: expected a finite number of seconds, got {timestamp!r}")
        if last is not None and not timestamp > last.timestamp:
            raise InputError(f"timestamp: expected one after {last.timestamp:.6f} s, got {timestamp:.6f} s")
        if velocity is not None:
            velocity = checked("velocity", velocity, (6,), "finite-or-nan")
        scan, change = self._within_range(scan, timestamp), np.zeros(6)
        if velocity is not None and self._believable(velocity, scan, timestamp):
            before, self._velocity = self._velocity, np.where(np.isnan(velocity), self._velocity, velocity)
            change = self._velocity - before if self._confirmed is not None else change
            if np.isfinite(velocity[3:]).any():
                self._velocity_known = True
                self._confirmed = None if self._confirmed is None else timestamp
        self._first = scan if last is None else None
        scan = _deskewed(scan, self._velocity + change / 2)
        if last is None:
            placed = OdometryStep(timestamp, np.eye(4), np.zeros((6, 6)), scan, True, None)
        else:
            placed = self._place(last, scan, timestamp)
        self._last = placed
        if last is None or placed.registration is not None:
            self._registered, self._lost = placed, 0
        else:
            self._lost += 1
        if placed.keyframe:
            self._keyframe = placed.map_T_lidar
            points = scan.points[voxel_downsample(scan.points, s.map_spacing)]
            self._map.add(transform_points(placed.map_T_lidar, points), placed.map_T_lidar[:3, 3])
            self._places.append(placed.map_T_lidar[:3, 3])
        return placed

    def _within_range(self, scan: Scan, timestamp: float) -> Scan:
        s = self.settings
        if self._last is None and not len(scan):
            raise InputError(f"scan at {timestamp:.3f} s: expected points to begin with, got none")
        near = scan.within(s.min_range, s.max_range)
        out_of_range = self._out_of_range + 1 if len(scan) and not len(near) else 0
        if out_of_range and (self._last is None or out_of_range >= _OUT_OF_RANGE):
            raise InputError(
                f"scan at {timestamp:.3f} s: expected points in metres, at distances from min_range "
                f"{s.min_range:g} m to max_range {s.max_range:g} m, got none of {len(scan)}; their median distance is "
                f"{float(np.median(np.linalg.norm(scan.points, axis=1))):g}"
            )
        self._out_of_range = out_of_range
        return near

    def _believable(self, velocity: FloatArray, scan: Scan, timestamp: float) -> bool:
        """Whether a vehicle can have this velocity, by what it last had for certain; warns where it begins to fail.

        At the second scan: whether the two fit as well with it as without.
        """
        said = ~np.isnan(velocity[3:])
        if self._confirmed is None:
            off, most = float(np.linalg.norm(velocity[3:][said])), _FASTEST
            tried = np.where(np.isnan(velocity), self._velocity, velocity)
            if self._first is not None and off <= most and self._contradicted(tried, self._first, scan, timestamp):
                most = 0.0
        else:
            off = float(np.linalg.norm((velocity - self._velocity)[3:][said]))
            most = _SPEED_OFF + _ACCELERATION * (timestamp - self._confirmed)
        if off > most and not self._refused:
            _LOG.warning(
                "scan at %.3f s: a velocity by other sensors is refused, %s m/s ahead, left, up; by the scans %s m/s",
                timestamp,
                _components(velocity[3:]),
                _components(self._velocity[3:]),
            )
        self._refused = off > most
        return not self._refused

    def _contradicted(self, velocity: FloatArray, first: Scan, scan: Scan, timestamp: float) -> bool:
        """Whether the first two scans fit each other clearly better by a velocity that they show themselves; if so, it
        is taken, and the map begins anew with it."""
        assert self._last is not None
        dt, xi, before = timestamp - self._last.timestamp, np.zeros(6), self._map
        try:
            said = self._fit(scan, velocity, dt, True)
        except RegistrationError:
            said = None
        try:
            for _ in range(_SKEWED):
                self._map = self._new_map(_deskewed(first, xi))
                shown = self._fit(scan, xi, dt)
                xi = constant_velocity(shown.map_T_scan, dt)
        except RegistrationError:
            self._map = before
            return False
        if said is not None and shown.residual / shown.pairs >= _CLEARLY * said.residual / said.pairs:
            self._map = before
            return False
        self._velocity, self._velocity_known = xi, False
        return True

    def _fit(self, scan: Scan, velocity: FloatArray, dt: float, known: bool = False) -> Registration:
        """A scan registered with the first one, by a velocity."""
        thin = self._thinned(_deskewed(scan, velocity))
        return self._registered_scan(thin, gtsam.Pose3.Expmap(velocity * dt).matrix(), known)

    def _new_map(self, scan: Scan) -> SurfelMap:
        """A map of the first scan."""
        s = self.settings
        made = SurfelMap(s.surfel_size, s.max_range)
        made.add(scan.points[voxel_downsample(scan.points, s.map_spacing)], np.zeros(3))
        return made

    def _thinned(self, scan: Scan) -> FloatArray:
        return scan.points[voxel_downsample(scan.points, _SCAN_SPACING)]

    def _registered_scan(self, points: FloatArray, predicted: FloatArray, known: bool = False) -> Registration:
        """Points (N, 3) registered with the map; known: the velocity, so that it holds where surfaces leave it open."""
        s = self.settings
        farthest = s.surfel_size + 3 * self.deviation
        return register(points, self._map, predicted, farthest, 0.1, "hold" if known else "follow")

    def _place(self, last: OdometryStep, scan: Scan, timestamp: float) -> OdometryStep:
        predicted = last.map_T_lidar @ gtsam.Pose3.Expmap(self._velocity * (timestamp - last.timestamp)).matrix()
        points, found, why = self._thinned(scan), None, ""
        try:
            found = self._registered_scan(points, predicted, self._velocity_known)
        except RegistrationError as error:
            why = str(error)
        fits = found is not None and self._fits(found, len(points))
        again = None if fits else self._found_again(scan.points, points)
        self._misfits = 0 if fits or again is not None else self._misfits + 1
        lost = np.diag([LOST_ROTATION] * 3 + [LOST_TRANSLATION] * 3) ** 2
        if again is not None:
            off = float(np.linalg.norm((inverse_transform(predicted) @ again.map_T_scan)[:3, 3]))
            _LOG.warning("scan at %.3f s: it fits the map %.1f m from where it was expected: moved", timestamp, off)
            self._velocity, self._velocity_known, self._confirmed = np.zeros(6), False, None
            return OdometryStep(timestamp, again.map_T_scan, again.covariance, scan, True, again, (), self._lost)
        if found is None:
            _LOG.warning("scan at %.3f s: %s; the motion of the one before goes on", timestamp, why)
            return OdometryStep(timestamp, predicted, lost, scan, False, None)
        self._adapt(inverse_transform(predicted) @ found.map_T_scan, points)
        before = last if self._misfits > 1 else self._registered or last
        since_then = inverse_transform(before.map_T_lidar) @ found.map_T_scan
        self._velocity = constant_velocity(since_then, timestamp - before.timestamp)
        lost_before, self._elsewhere = self._elsewhere, self._misfits >= _ELSEWHERE
        if self._elsewhere and not lost_before:
            _LOG.warning(
                "scan at %.3f s: it fits the map nowhere, as the scans before it: lost, its place is unknown", timestamp
            )
            lost = _ANYWHERE
        if 0 < self._misfits < _BEGIN_ANEW:
            return OdometryStep(timestamp, found.map_T_scan, lost, scan, False, None)
        keyframe = moved_on(inverse_transform(self._keyframe) @ found.map_T_scan)
        names = found.observed.names(self._velocity[3:] if np.linalg.norm(self._velocity[3:]) > _STANDING else None)
        covariance = found.covariance + self._of_open_motions(found.observed, last.timestamp, timestamp)
        if self._misfits >= _BEGIN_ANEW:
            covariance = covariance + _ANYWHERE
        self._velocity_known |= not names
        if not names:
            self._confirmed = timestamp
        if names != self._degenerate:
            _LOG.warning("scan at %.3f s: %s", timestamp, _said(names))
            self._degenerate = names
        return OdometryStep(timestamp, found.map_T_scan, covariance, scan, keyframe, found, names, self._lost)

    def _of_open_motions(self, observed: Observability, before: float, now: float) -> FloatArray:
        """Covariance (6, 6) of a step along motions that the scan leaves open.

        An unknown speed is one error of all steps, not a new one in each: variances of the steps add up to that of the
        whole way, v^2 t^2 + a^2 t^3 / 3, t since the motion was last seen.
        """
        if not len(observed.lost):
            self._open = None
            return np.zeros((6, 6))
        since, speed = self._open = self._open or (before, 0.0 if self._velocity_known else _UNKNOWN_SPEED)
        ended, begun = ((speed * t) ** 2 + _UNKNOWN_ACCELERATION**2 * t**3 / 3 for t in (now - since, before - since))
        return observed.open(max(LOST_TRANSLATION**2, ended - begun))

    def _fits(self, found: Registration, count: int) -> bool:
        """Whether a scan of so many points overlaps with the map, and lies on its surfels, as scans before it did."""
        fit = np.array([found.pairs / count, found.residual])
        usual = fit if self._usual is None else self._usual
        good = bool(fit[0] >= (_LOST if fit[1] <= _WORSE * usual[1] else _POOR) * usual[0])
        if good:
            self._usual = usual + _USUAL * (fit - usual)
        return good

    def _found_again(self, points: FloatArray, thin: FloatArray) -> Registration | None:
        """The registration of a scan that does not fit where it was expected; None: none.

        It is looked for near the last one that did, and after several all along the path that is in the map.

        What stands above the ground is laid on the map in all directions. The places with most of it on the map are
        registered, and the first where the scan fits as scans before it is taken.
        """
        centre = self._registered
        if self._usual is None or centre is None or not len(points):
            return None
        standing = Structure.of(points).points[:, :2]
        if len(standing) < _STANDING_POINTS:
            return None
        level = centre.map_T_lidar @ upright(centre.map_T_lidar)
        x, y, yaw = (a.ravel() for a in np.meshgrid(_SHIFTS, _SHIFTS, _TURNS, indexing="ij"))
        if self._misfits >= _ELSEWHERE - 1:
            at = self._apart(transform_points(inverse_transform(level), np.array(self._places)))
            x, y, yaw = np.add.outer(at[:, 0], x).ravel(), np.add.outer(at[:, 1], y).ravel(), np.tile(yaw, len(at))
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        few = standing[:: len(standing) // _STANDING_POINTS]
        turned = np.stack(
            [c * few[:, 0] - s * few[:, 1] + x[:, None], s * few[:, 0] + c * few[:, 1] + y[:, None]], axis=2
        )
        around = Structure.of(transform_points(inverse_transform(level), self._map.surfels.mean)).points
        distance, _ = cKDTree(around[:, :2]).query(turned, distance_upper_bound=self.settings.surfel_size)
        for row in np.argsort(-np.isfinite(distance).mean(axis=1), kind="stable")[:_TRIED].tolist():
            start = level @ yaw_transform(float(x[row]), float(y[row]), 0.0, float(yaw[row]))
            try:
                rough = register(thin, self._map, start, 3 * self.settings.surfel_size, 1.0)
                found = register(thin, self._map, rough.map_T_scan, self.settings.surfel_size, 0.1)
            except RegistrationError:
                continue
            alike = found.residual <= _ALIKE * self._usual[1]
            if found.converged and alike and self._fits(found, len(thin)):
                return found
        return None

    def _apart(self, places: FloatArray) -> FloatArray:
        """Centres (k, 3) of searches, m: the origin, then those of `places` (n, 3) in range, newest first, a search
        window apart."""
        found = [np.zeros(3)]
        for place in places[::-1][np.linalg.norm(places[::-1], axis=1) < self.settings.max_range]:
            if np.linalg.norm(np.array(found) - place, axis=1).min() >= 2 * _SHIFTS[-1]:
                found.append(place)
        return np.array(found)

    def _adapt(self, deviation: FloatArray, points: FloatArray) -> None:
        span = float(np.median(np.linalg.norm(points, axis=1)))
        angle = float(rotation_angle(deviation[:3, :3]))
        self._squares += (float(np.linalg.norm(deviation[:3, 3])) + 2 * span * np.sin(angle / 2)) ** 2
        self._count += 1


def _deskewed(scan: Scan, velocity: FloatArray) -> Scan:
    return scan if scan.time is None else deskewed(scan, velocity)


def moved_on(keyframe_T_scan: FloatArray) -> bool:
    """True if a scan is far enough from the last keyframe, or turned enough, to be the next one."""
    return bool(
        np.linalg.norm(keyframe_T_scan[:3, 3]) >= KEYFRAME_DISTANCE
        or rotation_angle(keyframe_T_scan[:3, :3]) >= KEYFRAME_ROTATION
    )


def _said(names: tuple[str, ...]) -> str:
    if not names:
        return "the surfaces in view determine the whole motion again"
    return f"the surfaces in view do not determine the motion {', '.join(names)}; it is only predicted there"


def _components(velocity: FloatArray) -> str:
    """Those that are known, m/s."""
    return ", ".join("?" if np.isnan(x) else f"{x:.1f}" for x in velocity)


def checked_step(step: object) -> OdometryStep:
    """The step of an odometry, as it is; raises `InputError` for what is no pose, covariance or scan."""
    require_type("odometry", step, OdometryStep)
    assert isinstance(step, OdometryStep)
    require_type("odometry: scan", step.scan, Scan)
    if not (isinstance(step.lost, int) and step.lost >= 0):
        raise InputError(f"odometry: lost: expected a number of scans, got {step.lost!r}")
    checked_transform("odometry: map_T_lidar", step.map_T_lidar)
    P = checked("odometry: covariance", step.covariance, (6, 6))
    size = float(np.abs(P).max())
    if np.abs(P - P.T).max() > 1e-9 * size or np.linalg.eigvalsh((P + P.T) / 2)[0] < -1e-9 * size:
        raise InputError("odometry: covariance: expected a symmetric matrix without negative eigenvalues")
    return step


class Odometry(Protocol):
    """Places scans one by one, in the frame of the first; `LidarOdometry` is one."""

    def step(self, scan: Scan, timestamp: float, velocity: FloatArray | None = None) -> OdometryStep:
        """Place the next scan; velocity: by other sensors, as of `LidarOdometry.step`."""
