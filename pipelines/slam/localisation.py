"""Localisation: a drive in the map of an earlier one.

    odometry      LiDAR odometry, scan by scan, as in SLAM
    where first   a guess, or place recognition: the points of the first metres, as a submap, are looked for among the
                  submaps of the map; the one that passes registration and shares enough structure is the place, if no
                  other does nearly as well
                  A fix by GPS, in a map whose place on Earth is known, says around where
    thereafter    each keyframe is registered with the submaps around it. In a graph of keyframes, which marginalises
                  what is older than `lag`, the result is a measured pose under a robust loss, beside odometry and
                  what the vehicle's sensors say

Where a scan leaves motions open in the map, the measured pose is wide there. Ground and parallel walls fit elsewhere as
well: so at the guess, and every few metres from then on, what stands above the ground is compared with the map. Where
too little of it is the same, and after `lost_after` m without a keyframe that fits, the place is looked for again, and
poses since the last comparison are given up. Poses without a known place follow by odometry from the nearest before
them, those at the start backwards from the first.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    Registration,
    RegistrationError,
    Scan,
    SurfelMap,
    register,
    upright,
    voxel_downsample,
)
from data_tools.lidar.overlap import Structure
from factors import Robust, pose_prior_factor
from pipelines.slam.between_keyframes import BetweenKeyframes, velocity_ahead
from pipelines.slam.drive import Drive, motion, moved_pose, shared
from pipelines.slam.map_places import MapPlaces
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.slam.place_proof import SURFEL
from pipelines.slam.slam_map import SlamMap
from saga_fg.errors import InputError
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import EGO_POSE, Additions, FactorProvider, GraphView
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import checked_transform, inverse_transform, transform_points, yaw_transform
from saga_fg.settings import Fraction, NonNegative, Positive, Settings, setting, settings_group
from saga_fg.slam.mapping import MeasuredMotion
from saga_fg.slam.sensors import SensorName, SensorSettings, sensor_providers
from saga_fg.types.ego_measurements import EgoMeasurements, GpsFix, ImuSamples, WheelSpeed

_MAX_RESIDUAL = 0.3  # largest mean distance of the points of a scan from the map, m
_MIN_PAIRS = 0.4  # least share of the points of a scan that the map must have surfels for
_LOG = logging.getLogger(__name__)
_GUESSED = np.diag([0.02, 0.02, 0.1, 1.0, 1.0, 0.5]) ** 2  # of a pose that was given or recognised
_ACCURACY = np.diag([1e-3] * 3 + [0.03] * 3) ** 2  # of the map, rad and m
_RELOADED = 15.0  # m of way after which the surfels around are taken anew
_COMPARED, _WINDOW = 5.0, 10.0  # m of way between comparisons of the structure, and of the scans compared


@dataclass(frozen=True)
class LocaliserSettings(Settings):
    """Settings of localisation in a map."""

    odometry: OdometrySettings = settings_group(OdometrySettings, "LiDAR odometry")
    search_way: Positive = setting(
        15.0, "way whose points are looked for in the map, m; higher: surer, and later; usual 10 to 30"
    )
    min_overlap: Fraction = setting(
        0.5, "share of what stands above the ground that scans and map have in common, else lost; higher: surer"
    )
    radius: Positive = setting(80.0, "distance of the submaps that scans are registered with, m; higher: slower")
    scan_spacing: Positive = setting(1.5, "spacing of the points of a scan that is registered, m; higher: faster")
    lag: NonNegative = setting(2.0, "time over which keyframes are smoothed, s; 0: a filter")
    lost_after: Positive = setting(50.0, "way without a scan that fits after which the place is looked for again, m")
    robust_scale: Positive = setting(3.0, "residual from which the Cauchy loss discounts a measured pose, deviations")
    sensors: SensorSettings = settings_group(SensorSettings, "GPS, IMU and wheels of the vehicle")


@dataclass(frozen=True, eq=False)
class LocalisedStep:
    """One scan.

    map_T_lidar  (4, 4), covariance (6, 6) of its tangent, rad^2, m^2; None as long as the place is not known
    registered   whether it was registered with the map
    """

    map_T_lidar: FloatArray | None
    covariance: FloatArray | None
    registered: bool


class Localiser:
    """Takes the scans of a drive in order of time, and says where they are in a map.

    guess       map_T_lidar (4, 4) of the first scan, good to a metre or two and a tenth of a radian; None: it is
                looked for
    sensors     of the vehicle whose measurements `step` gets, fixes in the map's frame
    ego_T_lidar (4, 4) pose of the scanner on the vehicle
    """

    def __init__(
        self,
        slam_map: SlamMap,
        guess: FloatArray | None = None,
        settings: LocaliserSettings | None = None,
        sensors: Collection[SensorName] = (),
        ego_T_lidar: FloatArray | None = None,
    ) -> None:
        self.settings = settings or LocaliserSettings()
        self._odometry = LidarOdometry(self.settings.odometry)
        self._guess = None if guess is None else checked_transform("guess", guess)
        s = self.settings
        self._sensors = tuple(sensors)
        self._ego_T_lidar = np.eye(4) if ego_T_lidar is None else checked_transform("ego_T_lidar", ego_T_lidar)
        self._of_sensors = self._new_providers()
        self._measured = BetweenKeyframes(self._sensors, False, s.sensors.wheels.deviation)
        self._fix: FloatArray | None = None  # the newest
        self._places = MapPlaces(slam_map, s.radius, s.min_overlap, s.scan_spacing, s.odometry.registration)
        self._poses, self._covariances = list[FloatArray](), list[FloatArray]()  # by odometry
        self._found: dict[int, FloatArray] = {}  # map_T_lidar of keyframes, as estimated when they came
        self._fits = set[int]()  # keyframes registered with the map
        self._unproved = list[int]()  # keyframes since the structure was compared
        self._clouds: list[tuple[int, FloatArray]] = []  # of the last keyframes, thinned, with their rows
        self._ways, self._time = list[float](), 0.0  # of each scan, m; of the last keyframe
        self._searched, self._proved = 0.0, 0.0  # m, way of the last search, and of the last comparison
        self._ambiguous = False
        self._smoother: IncrementalSmoother | None = None
        self._last, self._way, self._fitted = 0, 0.0, 0.0  # keyframe in the graph; m
        self._pose, self._covariance = np.eye(4), _GUESSED  # of that keyframe
        self._surfels, self._centre = SurfelMap(SURFEL, np.inf), np.full(3, np.inf)
        self._structure, self._structure_frame = Structure.of(np.zeros((1, 3))), np.eye(4)

    def step(
        self,
        scan: Scan,
        time: float,
        imu: ImuSamples | None = None,
        gps: GpsFix | None = None,
        wheels: WheelSpeed | None = None,
    ) -> LocalisedStep:
        """Place the next scan; measurements of the vehicle's sensors as of `LidarSlam.step`.

        Raises `InputError` for a scan that is not later than the one before, and for a sensor that was not named.
        """
        measured = EgoMeasurements(gps=gps, imu=imu, wheels=wheels)
        self._measured.check(measured)
        ahead = None if wheels is None else velocity_ahead(wheels, self._ego_T_lidar)
        placed = self._odometry.step(scan, time, ahead)
        self._measured.add(time, measured)
        self._fix = self._fix if gps is None else gps.position
        self._poses.append(placed.map_T_lidar)
        covariances = shared(self._poses, placed)
        self._covariances[len(self._poses) - len(covariances) :] = covariances
        row = len(self._poses) - 1
        if row:
            self._way += float(np.linalg.norm((inverse_transform(self._poses[-2]) @ self._poses[-1])[:3, 3]))
        self._ways.append(self._way)
        points = placed.scan.points
        if placed.keyframe:
            self._time = time
            self._clouds.append((row, points[voxel_downsample(points, 0.5)] if len(points) else points))
            if self._smoother is None:
                self._look_for(row, points, time)
            if self._smoother is not None and self._last != row:
                self._add(row, points, time)
            self._measured.clear()
        if self._smoother is None:
            return LocalisedStep(None, None, False)
        since = motion(self._poses[self._last :], self._covariances[self._last + 1 :])
        return LocalisedStep(*moved_pose(self._pose, self._covariance, since), row in self._fits)

    def path(self) -> FloatArray | None:
        """map_T_lidar (K, 4, 4) of all scans so far; None if no place has been found.

        Scans before the first keyframe that was placed lie where odometry says, seen from it.
        """
        if not self._found:
            return None
        rows = sorted(self._found)
        drive = Drive(np.array(self._poses), np.array(self._covariances), rows)
        return drive.carried(np.array([self._found[row] for row in rows]))

    @property
    def registered(self) -> BoolArray:
        """Mask (K,) of the scans so far that were registered with the map, without those withdrawn since."""
        return np.isin(np.arange(len(self._poses)), sorted(self._fits))

    @property
    def way(self) -> float:
        """Way so far by odometry, m."""
        return self._way

    @property
    def ambiguous(self) -> bool:
        """True if the last cloud searched for fits several places of the map."""
        return self._ambiguous

    def finish(self) -> None:
        """After the last scan: look for the place with the points there are, or compare the last ones with the map."""
        if self._smoother is not None:
            self._compare()
        if self._smoother is None and self._clouds and self._way > self._searched:
            self._search(*self._clouds[-1], self._time)

    def _look_for(self, row: int, points: FloatArray, time: float) -> None:
        """Begin the graph where the guess says, or at a place that the points since the last search resemble."""
        if self._guess is not None:
            guess, self._guess = self._guess, None
            self._begin(guess @ inverse_transform(self._poses[0]) @ self._poses[row])
            if self._add(row, points, time):
                self._compare()
            else:
                self._give_up("the first scan does not fit the map at the guess")
        elif self._way - self._searched >= self.settings.search_way:
            self._search(row, points, time)

    def _search(self, row: int, points: FloatArray, time: float) -> None:
        """Look for the points of the last keyframes in the map, and begin there."""
        query, frame = self._seen()
        thin = query[voxel_downsample(query, 0.5)]
        map_T_frame = None if self._fix is None else self._places.recognised(thin, self._fix)
        if map_T_frame is None:
            map_T_frame = self._places.recognised(thin)
        self._ambiguous, self._searched = self._places.ambiguous, self._way
        if map_T_frame is None:
            self._clouds = self._clouds[len(self._clouds) // 2 :]
        else:
            self._begin(map_T_frame @ inverse_transform(frame) @ self._poses[row])
            self._add(row, points, time)

    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the last keyframes, level, and their frame (4, 4) by odometry."""
        middle = self._poses[self._clouds[len(self._clouds) // 2][0]]
        frame = middle @ upright(middle)  # level as far as the first scan was
        inverse = inverse_transform(frame)
        return np.concatenate([transform_points(inverse @ self._poses[k], cloud) for k, cloud in self._clouds]), frame

    def _begin(self, map_T_lidar: FloatArray) -> None:
        _LOG.info("place found at %s m", map_T_lidar[:3, 3].round(1).tolist())
        self._smoother, self._fitted = IncrementalSmoother(lag=self.settings.lag), self._way
        self._of_sensors = self._new_providers()
        self._pose, self._covariance = map_T_lidar, _GUESSED
        self._proved, self._ambiguous = self._way, False

    def _new_providers(self) -> list[FactorProvider]:
        return sensor_providers(self.settings.sensors, self._sensors, inverse_transform(self._ego_T_lidar))

    def _compare(self) -> None:
        """Give the place up if what stands above the ground around the last keyframes is not what the map has."""
        query, frame = self._seen()
        if not len(query):
            return
        map_T_frame = self._pose @ inverse_transform(self._poses[self._last]) @ frame
        near_T_frame = inverse_transform(self._structure_frame) @ map_T_frame
        share = self._structure.agreement(Structure.of(query), near_T_frame)
        self._proved = self._way
        if share is not None and share < self.settings.min_overlap:
            self._give_up(f"{100 * share:.0f} % of what stands above the ground is as in the map")
        elif share is not None:
            self._unproved = []

    def _give_up(self, why: str) -> None:
        _LOG.warning("at %.1f m: %s; the place is looked for", self._way, why)
        for row in self._unproved:
            self._found.pop(row, None)
            self._fits.discard(row)
        self._unproved, self._smoother = [], None
        self._searched = self._ways[self._clouds[0][0]]

    def _add(self, row: int, points: FloatArray, time: float) -> bool:
        """Add a keyframe to the graph, registered with the map where it fits; returns whether it does."""
        assert self._smoother is not None
        s, first = self.settings, self._smoother.graph().epoch < 0
        if first:
            measured = MeasuredMotion(self._pose, _GUESSED)
            predicted = self._pose
        else:
            since = motion(self._poses[self._last : row + 1], self._covariances[self._last + 1 : row + 1])
            predicted = self._pose @ since[0]
            measured = MeasuredMotion(*since)
        found = self._registered(points, predicted, first)
        given: list[FactorProvider] = [measured]
        if found is not None:
            lost = found.observed.lost / found.observed.scale
            covariance = found.covariance + _ACCURACY + s.odometry.lost_translation**2 * lost.T @ lost
            given.append(_MeasuredPose(found.map_T_scan, covariance, Robust("cauchy", s.robust_scale)))
            self._fitted = self._way
            self._fits.add(row)
        self._smoother.step(time, [*given, *self._of_sensors], self._measured.frame(time, None))
        (pose,) = self._smoother.graph().of(EGO_POSE, self._smoother.graph().epoch).values()
        self._pose, self._covariance = (
            self._smoother.graph().state(pose.key).matrix(),
            self._smoother.covariance(pose.key),
        )
        self._last = row
        self._found[row] = self._pose
        self._unproved.append(row)
        if self._way - self._fitted > s.lost_after:
            self._give_up(f"no scan has fitted the map for {s.lost_after:.0f} m")
        elif self._way - self._proved >= _COMPARED:
            self._clouds = [one for one in self._clouds if self._way - self._ways[one[0]] <= _WINDOW]
            self._compare()
        return found is not None

    def _registered(self, points: FloatArray, predicted: FloatArray, rough: bool) -> Registration | None:
        """The registration of a keyframe with the map, None where it does not fit; rough: predicted to metres alone."""
        s = self.settings
        if np.linalg.norm(predicted[:3, 3] - self._centre) > _RELOADED:
            self._load(predicted[:3, 3])
        thin = points[voxel_downsample(points, s.scan_spacing)] if len(points) else points
        criteria, start = s.odometry.registration, predicted
        try:
            if rough:
                start = register(thin, self._surfels, start, 3 * SURFEL, 1.0, criteria, "hold").map_T_scan
            found = register(thin, self._surfels, start, 1.5 * SURFEL, 0.1, criteria, "hold")
        except RegistrationError:
            return None
        fits = found.converged and found.pairs >= _MIN_PAIRS * len(thin) and found.residual <= _MAX_RESIDUAL
        return found if fits else None

    def _load(self, centre: FloatArray) -> None:
        """Take the surfels and the structure around a place."""
        points, frame = self._places.around(self._places.nearest(centre), centre)
        self._surfels, self._centre = SurfelMap(SURFEL, np.inf), centre
        self._surfels.add(transform_points(frame, points), centre)
        self._structure, self._structure_frame = Structure.of(points), frame


@dataclass(frozen=True, eq=False)
class _MeasuredPose:
    """The pose of this epoch as measured in the map."""

    map_T_lidar: FloatArray
    covariance: FloatArray
    robust: Robust
    name: str = "map"

    def factors(self, view: GraphView) -> Additions:
        key = view.key(EGO_POSE, 0)
        return Additions(factors=[pose_prior_factor(key, self.map_T_lidar, self.covariance, self.robust)])


def guess_of(numbers: str) -> FloatArray:
    """A pose (4, 4) of x, y, z, yaw as a text "1.5,-3,1.8,0.2", m and rad. Raises `InputError` for another."""
    try:
        values = [float(word) for word in numbers.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not np.isfinite(values).all():
        raise InputError(f"guess: expected x,y,z,yaw, m and rad, got {numbers[:60]!r}")
    return yaw_transform(*values)
