"""Localisation: a drive in the map of an earlier one, by its places and by registration.

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

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    PlaceImage,
    PlaceIndex,
    Registration,
    RegistrationError,
    Scan,
    ScanSequence,
    Structure,
    SurfelMap,
    register,
    scan_context,
    upright,
    voxel_downsample,
)
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory
from factors import Robust, pose_prior_factor
from pipelines.slam.drive import Drive, SlamMap, moved_pose, placed_clouds
from pipelines.slam.loop_closures import COMPARED, FEWEST, SURFEL, agreeing, fits_otherwise, registered
from pipelines.slam.odometry import LOST_TRANSLATION, LidarOdometry, OdometrySettings
from pipelines.slam.vehicle_sensors import Vehicle, VehicleSensors
from pipelines.tracking import Progress
from saga_fg import InputError
from saga_fg.errors import require_type
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import Additions, FactorProvider
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    carried_covariance,
    checked_transform,
    inverse_transform,
    transform_points,
)
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.slam.mapping import Given, MeasuredMotion, pose_key
from saga_fg.types import EgoMeasurements, GpsFix, ImuSamples, WheelSpeed

_REGISTERED = 6  # places for each search
_MAX_RESIDUAL = 0.3  # largest mean distance of the points of a scan from the map, m
_MIN_PAIRS = 0.4  # least share of the points of a scan that the map must have surfels for
_RELOADED = 15.0  # m travelled after which the surfels around are taken anew
MIN_OVERLAP = 0.5  # least share of what stands above the ground that scans and map have in common
RADIUS = 80.0  # distance of the submaps around a place, m
SCAN_SPACING = 1.5  # spacing of the points of a scan that is registered, m


class KnownMap:
    """A map in which places are recognised, and in whose surroundings of the vehicle scans are registered.

    ambiguous: whether the last cloud that was looked for has fitted several places
    """

    def __init__(self, slam_map: SlamMap) -> None:
        self.ambiguous = False
        self._map, self._index = slam_map, PlaceIndex()
        self._surfels, self._centre = SurfelMap(SURFEL, np.inf), np.full(3, np.inf)
        self._structure = Structure.of(np.zeros((1, 3)))

    def around(self, centre: FloatArray) -> FloatArray:
        """Points (N, 3) of the submaps around a centre (3,), and of the nearest one at least."""
        apart = np.linalg.norm(self._map.map_T_submap[:, :3, 3] - centre, axis=1)
        near = np.flatnonzero(apart <= max(RADIUS, float(apart.min())))
        return placed_clouds([self._map.points[k] for k in near.tolist()], self._map.map_T_submap[near])

    def recognised(self, query: FloatArray, near: FloatArray | None = None) -> Registration | None:
        """The registration at the one place that points (N, 3), z up, show, None for none and for several.

        near: a place (2,) or (3,) in the map; places farther than the radius from it are left out
        """
        frames, older = self._map.map_T_submap, None
        if len(query) < FEWEST:
            self.ambiguous = False
            return None
        if not len(self._index):
            for number, cloud in enumerate(self._map.points):
                if len(cloud) >= FEWEST:
                    self._index.add(number, PlaceImage.of(cloud.astype(np.float64)))
        if near is not None:
            older = np.flatnonzero(np.linalg.norm(frames[:, :2, 3] - near[:2], axis=1) <= RADIUS).tolist()
        mine, points = Structure.of(query), query[voxel_downsample(query, SCAN_SPACING)]
        sure, fitting = list[tuple[float, Registration]](), 0
        for match in self._index.candidates(PlaceImage.of(query), older, COMPARED)[:_REGISTERED]:
            around = self.around(frames[match.number][:3, 3])
            fine = registered(around, points, frames[match.number] @ match.place_T_query)
            if fine is not None and (overlap := Structure.of(around).shared(mine, fine.map_T_scan)) > MIN_OVERLAP:
                fitting += 1
                if not fits_otherwise(match):
                    sure.append((overlap, fine))
        sure.sort(key=lambda one: -one[0])
        places = np.array([fine.map_T_scan[:3, 3] for _, fine in sure])
        agreed = agreeing(places, np.array([overlap for overlap, _ in sure])) if sure else []
        self.ambiguous = fitting > 0 and not agreed
        return sure[0][1] if agreed else None

    def registered(self, points: FloatArray, predicted: FloatArray, rough: bool) -> Registration | None:
        """The registration of a scan (N, 3) with the map, None where it does not fit.

        predicted: map_T_scan (4, 4); rough: to metres alone
        """
        if np.linalg.norm(predicted[:3, 3] - self._centre) > _RELOADED:
            self._surfels, self._centre = SurfelMap(SURFEL, np.inf), predicted[:3, 3]
            around = self.around(self._centre)
            self._surfels.add(around, self._centre)
            self._structure = Structure.of(around)
        thin = points[voxel_downsample(points, SCAN_SPACING)] if len(points) else points
        start = predicted
        try:
            if rough:
                start = register(thin, self._surfels, start, 3 * SURFEL, 1.0, "hold").map_T_scan
            found = register(thin, self._surfels, start, 1.5 * SURFEL, 0.1, "hold")
        except RegistrationError:
            return None
        fits = found.converged and found.pairs >= _MIN_PAIRS * len(thin) and found.residual <= _MAX_RESIDUAL
        return found if fits else None

    def agreement(self, points: FloatArray, map_T_points: FloatArray) -> float | None:
        """Share of what stands above the ground in points (N, 3) that the map has, None where there is too little."""
        return self._structure.agreement(Structure.of(points), map_T_points)


_LOG = logging.getLogger(__name__)
_GUESSED = np.diag([0.02, 0.02, 0.1, 1.0, 1.0, 0.5]) ** 2  # of a pose that was given or recognised
_ACCURACY = np.diag([1e-3] * 3 + [0.03] * 3) ** 2  # of the map, rad and m
ROBUST_SCALE = 3.0  # residual from which the Cauchy loss discounts a measured pose, deviations
_COMPARED, _WINDOW = 5.0, 10.0  # m travelled between comparisons of the structure, and of the scans compared
_FIX_AGE = 60.0  # s, from which a fix says nothing of where the vehicle is; it is nearer than the way since, too


@dataclass(frozen=True)
class LocaliserSettings(Settings):
    """Settings of localisation in a map."""

    odometry: OdometrySettings = settings_group(OdometrySettings, "LiDAR odometry")
    search_distance: Positive = setting(
        15.0, "distance travelled whose points are looked for in the map, m; higher: surer, and later; usual 10 to 30"
    )
    lag: NonNegative = setting(2.0, "time over which keyframes are smoothed, s; 0: a filter")
    lost_after: Positive = setting(
        50.0, "distance travelled without a scan that fits after which the place is looked for again, m"
    )


@dataclass(frozen=True, eq=False)
class LocalisedStep:
    """One scan.

    map_T_lidar  (4, 4), covariance (6, 6) of its tangent, rad^2, m^2; None as long as the place is not known
    registered   whether it was registered with the map
    """

    map_T_lidar: FloatArray | None
    covariance: FloatArray | None
    registered: bool


@dataclass(frozen=True, eq=False)
class LocalisedDrive:
    """Poses (K) of the vehicle in the map, and whether each scan (K,) was registered with it.

    covariances (K, 6, 6) of the sensor's poses, (rotation, translation) in its frame, rad^2, m^2
    misfits   what does not fit of the vehicle's sensors, in words, by their names
    unjudged  sensors that have measured too little to tell, likewise
    """

    trajectory: Trajectory
    covariances: FloatArray
    registered: BoolArray
    misfits: Mapping[str, str]
    unjudged: Mapping[str, str]


class Localiser:
    """Takes the scans of a drive in order of time, and says where they are in a map.

    guess       map_T_lidar (4, 4) of the first scan, good to a metre or two and a tenth of a radian; None: it is
                looked for
    vehicle     where the LiDAR is on it, and the sensors whose measurements `step` gets, fixes in the map's frame
    """

    def __init__(
        self,
        slam_map: SlamMap,
        guess: FloatArray | None = None,
        settings: LocaliserSettings | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        require_type("slam_map", slam_map, SlamMap)
        self.settings = settings or LocaliserSettings()
        self._odometry = LidarOdometry(self.settings.odometry)
        self._guess = None if guess is None else checked_transform("guess", guess)
        self._sensors = VehicleSensors(vehicle or Vehicle())
        self._of_sensors, self._consistency = self._sensors.new_providers(), self._sensors.consistency
        self._fix: tuple[float, float, FloatArray] | None = None  # the newest: its time, s, the way then, m, its place
        self._map = KnownMap(slam_map)
        self._path = Drive()
        # of keyframes as estimated when they came: map_T_lidar, and the covariance of its tangent
        self._found: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._fits = set[int]()  # keyframes registered with the map
        self._unproved = list[int]()  # keyframes since the structure was compared
        self._clouds: list[tuple[int, FloatArray]] = []  # of the last keyframes, thinned, with their rows
        self._searched, self._proved = 0.0, 0.0  # m, distance travelled at the last search, and at the last comparison
        self._smoother: IncrementalSmoother | None = None
        self._last, self._fitted = 0, 0.0  # keyframe in the graph; distance at the last fit, m
        self._pose, self._covariance = np.eye(4), _GUESSED  # of that keyframe

    def step(
        self,
        scan: Scan,
        time: float,
        imu: ImuSamples | None = None,
        gps: GpsFix | None = None,
        wheels: WheelSpeed | None = None,
    ) -> LocalisedStep:
        """Place the next scan; measurements of the vehicle's sensors as of `LidarSlam.step`.

        Raises `InputError` as that, too.
        """
        self._path.check(scan, time)
        measured = EgoMeasurements(gps=gps, imu=imu, wheels=wheels)
        self._sensors.check(measured)
        placed = self._sensors.placed(self._odometry, scan, time, measured)
        self._path.add(time, placed.map_T_lidar, placed)
        row = len(self._path) - 1
        if gps is not None:
            self._fix = time - gps.age, self.travelled, gps.position
        points = placed.scan.points
        if placed.keyframe:
            self._clouds.append((row, points[voxel_downsample(points, 0.5)] if len(points) else points))
            if self._smoother is None:
                self._look_for(row, points)
            if self._smoother is not None and self._last != row:
                self._add(row, points)
            self._sensors.taken()
        if self._smoother is None:
            return LocalisedStep(None, None, False)
        now = moved_pose(self._pose, self._covariance, self._path.moved(self._last))
        return LocalisedStep(*now, row in self._fits)

    def path(self) -> FloatArray | None:
        """map_T_lidar (K, 4, 4) of all scans so far; None if no place has been found.

        Scans before the first keyframe that was placed lie where odometry says, seen from it.
        """
        if not self._found:
            return None
        rows = sorted(self._found)
        return self._path.carried(np.array([self._found[row][0] for row in rows]), rows)

    @property
    def travelled(self) -> float:
        """Distance by odometry, m."""
        return self._path.travelled[-1] if len(self._path) else 0.0

    @property
    def ambiguous(self) -> bool:
        """True if the last cloud searched for fits several places of the map."""
        return self._map.ambiguous

    def finish(self) -> LocalisedDrive | None:
        """After the last scan: look for the place with the points there are, or compare the last ones with the map.

        None if no place has been found.
        """
        self._path.close()
        if self._smoother is not None:
            self._consistency.observe(self._smoother.graph())
            self._compare()
        if self._smoother is None and self._clouds and self.travelled > self._searched:
            self._search(*self._clouds[-1])
        if (path := self.path()) is None:
            return None
        self._consistency.warn()
        trajectory = Trajectory(np.array(self._path.times), path @ self._sensors.lidar_T_ego)
        registered = np.isin(np.arange(len(path)), sorted(self._fits))
        fit = self._consistency
        return LocalisedDrive(trajectory, self._covariances(), registered, fit.misfits, fit.unjudged)

    def _covariances(self) -> FloatArray:
        """Covariances (K, 6, 6) of the tangents of the poses of `path`, rad^2, m^2."""
        known, found = np.array(sorted(self._found)), list[FloatArray]()
        of = known[np.maximum(np.searchsorted(known, np.arange(len(self._path)), side="right") - 1, 0)].tolist()
        for row, keyframe in enumerate(of):
            pose, covariance = self._found[keyframe]
            if row >= keyframe:
                found.append(moved_pose(pose, covariance, self._path.moved(keyframe, row))[1])
            else:
                ahead, noise = self._path.moved(row, keyframe)
                found.append(carried_covariance(ahead, covariance + noise))
        return np.array(found)

    def _look_for(self, row: int, points: FloatArray) -> None:
        """Begin the graph where the guess says, or at a place that the points since the last search resemble."""
        if self._guess is not None:
            guess, self._guess = self._guess, None
            self._begin(guess @ inverse_transform(self._path.poses[0]) @ self._path.poses[row])
            if self._add(row, points):
                self._compare()
            else:
                self._give_up("the first scan does not fit the map at the guess")
        elif self.travelled - self._searched >= self.settings.search_distance:
            self._search(row, points)

    def _search(self, row: int, points: FloatArray) -> None:
        """Look for the points of the last keyframes in the map, and begin there."""
        query, frame = self._seen()
        thin = query[voxel_downsample(query, 0.5)]
        fix = self._fix_nearby()
        found = None if fix is None else self._map.recognised(thin, fix)
        if found is None:
            found = self._map.recognised(thin)
        self._searched = self.travelled
        if found is None:
            self._clouds = self._clouds[len(self._clouds) // 2 :]
        else:
            self._begin(found.map_T_scan @ inverse_transform(frame) @ self._path.poses[row])
            self._add(row, points)

    def _fix_nearby(self) -> FloatArray | None:
        """The newest fix (2,) or (3,) by GPS, None once the vehicle may have left its surroundings."""
        if self._fix is None:
            return None
        time, travelled, place = self._fix
        age = self._path.times[self._clouds[-1][0]] - time
        return place if age <= _FIX_AGE and self.travelled - travelled <= RADIUS / 2 else None

    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the last keyframes, level, and their frame (4, 4) by odometry."""
        middle = self._path.poses[self._clouds[len(self._clouds) // 2][0]]
        frame = middle @ upright(middle)  # level as far as the first scan was
        clouds = [transform_points(inverse_transform(frame) @ self._path.poses[k], one) for k, one in self._clouds]
        return np.concatenate(clouds), frame

    def _begin(self, map_T_lidar: FloatArray) -> None:
        _LOG.info("place found at %s m", map_T_lidar[:3, 3].round(1).tolist())
        self._smoother, self._fitted = IncrementalSmoother(lag=self.settings.lag), self.travelled
        self._of_sensors = self._sensors.new_providers()
        self._pose, self._covariance = map_T_lidar, _GUESSED
        self._proved = self.travelled

    def _compare(self) -> None:
        """Give the place up if what stands above the ground around the last keyframes is not what the map has."""
        query, frame = self._seen()
        if not len(query):
            return
        share = self._map.agreement(query, self._pose @ inverse_transform(self._path.poses[self._last]) @ frame)
        self._proved = self.travelled
        if share is not None and share < MIN_OVERLAP:
            self._give_up(f"{100 * share:.0f} % of what stands above the ground is as in the map")
        elif share is not None:
            self._unproved = []

    def _give_up(self, why: str) -> None:
        _LOG.warning("at %.1f m: %s; the place is looked for", self.travelled, why)
        if self._unproved:
            self._consistency.forget(self._path.times[self._unproved[0]])
        for row in self._unproved:
            self._found.pop(row, None)
            self._fits.discard(row)
        self._unproved, self._smoother = [], None
        self._searched = self._path.travelled[self._clouds[0][0]]

    def _add(self, row: int, points: FloatArray) -> bool:
        """Add a keyframe to the graph, registered with the map where it fits; returns whether it does."""
        assert self._smoother is not None
        s, epoch = self.settings, self._smoother.graph().epoch + 1
        since = self._path.moved(self._last, row) if epoch else (self._pose, _GUESSED)
        predicted, key = self._pose @ since[0] if epoch else self._pose, pose_key(epoch)
        found = self._map.registered(points, predicted, not epoch)
        given: list[FactorProvider] = [MeasuredMotion(*since)]
        if found is not None:
            covariance = found.covariance + _ACCURACY + found.observed.open(LOST_TRANSLATION**2)
            seen = pose_prior_factor(key, found.map_T_scan, covariance, Robust("cauchy", ROBUST_SCALE))
            given.append(Given(Additions(factors=[seen]), "map"))
            self._fitted = self.travelled
            self._fits.add(row)
        time = self._path.times[row]
        self._smoother.step(time, [*given, *self._of_sensors], self._sensors.frame(time))
        self._sensors.begin(self._smoother)
        self._consistency.observe(self._smoother.graph(), s.lag / 2)
        self._pose, self._covariance = self._smoother.graph().state(key).matrix(), self._smoother.covariance(key)
        self._last = row
        self._found[row] = self._pose, self._covariance
        self._unproved.append(row)
        if self.travelled - self._fitted > s.lost_after:
            self._give_up(f"no scan has fitted the map for {s.lost_after:.0f} m")
        elif self.travelled - self._proved >= _COMPARED:
            self._clouds = [one for one in self._clouds if self.travelled - self._path.travelled[one[0]] <= _WINDOW]
            self._compare()
        return found is not None


def localise(
    scans: ScanSequence,
    slam_map: SlamMap,
    guess: FloatArray | None = None,
    settings: LocaliserSettings | None = None,
    progress: Progress | None = None,
    log: SensorLog | None = None,
) -> LocalisedDrive:
    """Localise a recording in a map.

    guess: map_T_ego (4, 4) of the vehicle at the first scan, good to a metre or two and 0.1 rad. None: it is looked
    for, as it is where the scans do not fit the map at the guess. log: of the vehicle's sensors, fixes in the map's
    frame. Of the recording's poses none is used.
    Raises `InputError` where no place of the map was found, or several, and where no scan fits the map.
    """
    log = log or SensorLog({})
    start = None if guess is None else guess @ scans.ego_T_lidar
    localiser = Localiser(slam_map, start, settings, Vehicle(scans.ego_T_lidar, tuple(log.tables), log.settings))
    for k, (time, ego) in enumerate(log.until(scans.timestamps)):
        with scan_context(scans, k):
            localiser.step(scans[k], time, ego.imu, ego.gps, ego.wheels)
        if progress is not None:
            progress("localising", k + 1, len(scans))
    found = localiser.finish()
    if found is None or not found.registered.any():
        if localiser.ambiguous:
            raise InputError(
                "map: expected one that shows the place of this drive once, it is ambiguous: several places of the map "
                "look like it; a longer drive or a guess may help"
            )
        where = (
            "none was found" if guess is None else "the scans do not fit it at the guess, and elsewhere none was found"
        )
        raise InputError(
            f"map: expected one that shows a place of this drive, {where} in {localiser.travelled:.0f} m; a longer "
            "drive, or a guess good to a metre or two and 0.1 rad, may help"
        )
    return found
