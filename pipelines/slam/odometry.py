"""LiDAR odometry: the motion of the sensor, scan by scan.

    predict    T- = T_(k-1) exp(dt xi)                        the velocity of the step before, or of other sensors
    de-skew    by xi, where the points have times
    register   T = point-to-plane ICP of a thinned scan against the local map of surfels, started at T-
    adapt      e_k = || trans D || + 2 r sin(angle(D) / 2),  D = (T-)^-1 T,  r a typical range
               sigma_k = root mean square of the e so far, not below a floor
    extend     the map, by scans that moved on since the last that did (keyframes)

In a tunnel or an open field some motions are left open (`data_tools.lidar.degeneracy`). Along these the pose stays as
predicted, the step names them, and its covariance is wide there, so that a graph relies on other sensors.

A point may lie as far from the mean of its surfel as a voxel is wide, and three sigma more; residuals above
max(floor, sigma) lose weight. The scheme (constant velocity, adaptive threshold, local voxel map) is that of Vizzo et
al., KISS-ICP, RA-L 2023; planes in place of points need fewer of them, and give the covariance of the pose.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import gtsam
import numpy as np

from data_tools.lidar import (
    Registration,
    RegistrationError,
    RegistrationSettings,
    Scan,
    SurfelMap,
    constant_velocity,
    deskewed,
    register,
    voxel_downsample,
)
from data_tools.trajectories import rotation_angle
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.settings import Positive, Settings, setting, settings_group

_LOG = logging.getLogger(__name__)
_STANDING = 0.5  # m/s, speed from which on the motion says where the road goes


@dataclass(frozen=True)
class OdometrySettings(Settings):
    """Sizes for a vehicle among houses; halve `surfel_size` indoors."""

    min_range: Positive = setting(3.0, "ignore nearer points, which are on the vehicle, m")
    max_range: Positive = setting(100.0, "ignore points and surfels further away, m")
    surfel_size: Positive = setting(1.0, "voxel size of the local map, m; usual 0.5 to 1")
    map_spacing: Positive = setting(0.25, "spacing of the points that enter the map, m")
    scan_spacing: Positive = setting(1.5, "spacing of the points of a scan that is registered, m; higher: faster")
    first_deviation: Positive = setting(1.0, "standard deviation of the first motion, m")
    deviation_floor: Positive = setting(
        0.1, "least standard deviation of the prediction, m; higher: a wider search for pairs"
    )
    keyframe_distance: Positive = setting(
        0.5, "distance from the last keyframe that makes a scan the next one, m; lower: a denser graph"
    )
    keyframe_rotation: Positive = setting(0.05, "rotation from the last keyframe that makes a scan the next one, rad")
    lost_deviation: Positive = setting(
        1.0,
        "standard deviation of a motion that was only predicted, m and rad, for want of points, or along a direction "
        "that they leave open; higher: the graph relies more on other sensors there",
    )
    registration: RegistrationSettings = settings_group(RegistrationSettings, "registration of a scan in the map")


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """One scan placed.

    timestamp    s
    map_T_lidar  (4, 4); the map's frame is the sensor's of the first scan
    covariance   (6, 6) of the motion since the scan before, (rotation, translation) in the scan's frame, rad^2 and m^2
    scan         without skew, points too near and too far left out
    keyframe     whether it went into the map
    registration None for the first scan, and for one that could not be registered and lies where it was predicted
    degenerate   motions that the scan leaves open, in words such as "along the road"
    """

    timestamp: float
    map_T_lidar: FloatArray
    covariance: FloatArray
    scan: Scan
    keyframe: bool
    registration: Registration | None
    degenerate: tuple[str, ...] = ()


class LidarOdometry:
    """Takes scans in order of time and returns the pose of each."""

    def __init__(self, settings: OdometrySettings | None = None) -> None:
        self.settings = settings or OdometrySettings()
        self._map = SurfelMap(self.settings.surfel_size, self.settings.max_range)
        self._last: OdometryStep | None = None
        self._keyframe = np.eye(4)
        self._velocity = np.zeros(6)  # rad/s, m/s, in the sensor's frame
        self._squares, self._count = self.settings.first_deviation**2, 1
        self._degenerate: tuple[str, ...] = ()
        self._velocity_known = False  # by a scan that showed the whole motion, or by other sensors

    @property
    def deviation(self) -> float:
        """Sigma: typical distance of a point from its prediction by constant velocity, m."""
        return max(self.settings.deviation_floor, float(np.sqrt(self._squares / self._count)))

    def step(self, scan: Scan, timestamp: float, velocity: FloatArray | None = None) -> OdometryStep:
        """Place the next scan. Raises `InputError` for one that is not later than the one before.

        velocity: (6,) since then by other sensors, turn rate, rad/s, and velocity, m/s, in the sensor's frame; NaN
        where they say nothing. It predicts the motion in place of that of the scan before.
        """
        s, last = self.settings, self._last
        if velocity is not None:
            velocity = checked("velocity", velocity, (6,), "finite-or-nan")
            self._velocity = np.where(np.isnan(velocity), self._velocity, velocity)
            self._velocity_known = True
        scan = scan.within(s.min_range, s.max_range)
        if scan.time is not None:
            scan = deskewed(scan, self._velocity)
        if last is None:
            placed = OdometryStep(timestamp, np.eye(4), np.zeros((6, 6)), scan, True, None)
        else:
            if not timestamp > last.timestamp:
                raise InputError(f"timestamp: expected one after {last.timestamp:.6f} s, got {timestamp:.6f} s")
            placed = self._place(last, scan, timestamp)
        self._last = placed
        if placed.keyframe:
            self._keyframe = placed.map_T_lidar
            points = scan.points[voxel_downsample(scan.points, s.map_spacing)]
            self._map.add(transform_points(placed.map_T_lidar, points), placed.map_T_lidar[:3, 3])
        return placed

    def _place(self, last: OdometryStep, scan: Scan, timestamp: float) -> OdometryStep:
        s, dt = self.settings, timestamp - last.timestamp
        motion = gtsam.Pose3.Expmap(self._velocity * dt).matrix()
        predicted = last.map_T_lidar @ motion
        points = scan.points[voxel_downsample(scan.points, s.scan_spacing)]
        sigma = self.deviation
        try:
            found = register(
                points,
                self._map,
                predicted,
                s.surfel_size + 3 * sigma,
                0.1,
                s.registration,
                "hold" if self._velocity_known else "follow",
            )
        except RegistrationError as error:
            _LOG.warning("scan at %.3f s: %s; the motion of the one before goes on", timestamp, error)
            return OdometryStep(timestamp, predicted, np.eye(6) * s.lost_deviation**2, scan, False, None)
        self._adapt(inverse_transform(predicted) @ found.map_T_scan, points)
        self._velocity = constant_velocity(inverse_transform(last.map_T_lidar) @ found.map_T_scan, dt)
        moved = inverse_transform(self._keyframe) @ found.map_T_scan
        keyframe = bool(
            np.linalg.norm(moved[:3, 3]) >= s.keyframe_distance or rotation_angle(moved[:3, :3]) >= s.keyframe_rotation
        )
        names = found.observed.names(self._velocity[3:] if np.linalg.norm(self._velocity[3:]) > _STANDING else None)
        covariance = found.covariance
        self._velocity_known |= not names
        if names:
            open_motions = found.observed.lost / found.observed.scale
            covariance = covariance + s.lost_deviation**2 * open_motions.T @ open_motions
        if names != self._degenerate:
            _LOG.warning("scan at %.3f s: %s", timestamp, _said(names))
            self._degenerate = names
        return OdometryStep(timestamp, found.map_T_scan, covariance, scan, keyframe, found, names)

    def _adapt(self, deviation: FloatArray, points: FloatArray) -> None:
        span = float(np.median(np.linalg.norm(points, axis=1)))
        angle = float(rotation_angle(deviation[:3, :3]))
        self._squares += (float(np.linalg.norm(deviation[:3, 3])) + 2 * span * np.sin(angle / 2)) ** 2
        self._count += 1


def _said(names: tuple[str, ...]) -> str:
    if not names:
        return "the surfaces in view determine the whole motion again"
    return f"the surfaces in view do not determine the motion {', '.join(names)}; it is only predicted there"
