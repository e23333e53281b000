"""Localisation: a drive in the map of an earlier one.

    odometry      LiDAR odometry, scan by scan, as in SLAM
    where first   a guess, or place recognition: the points of the first metres, as a submap, are looked for among the
                  submaps of the map; the best that passes registration and shares enough structure is the place
    thereafter    each keyframe is registered with the submaps around it. In a graph of keyframes, which marginalises
                  what is older than `lag`, the result is a measured pose under a robust loss, beside odometry

Where a scan leaves motions open in the map, the measured pose is wide there. After `lost_after` m without a keyframe
that fits, the place is looked for again. Poses before the first place is known follow from it backwards by odometry.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import gtsam
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
from data_tools.lidar.places import PlaceImage, PlaceIndex
from factors import Robust, pose_prior_factor
from pipelines.slam.drive import motion, shared
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.slam.slam_map import SlamMap
from saga_fg.errors import InputError
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import EGO_POSE, Additions, FactorProvider, GraphView
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import checked_transform, inverse_transform, transform_points, yaw_transform
from saga_fg.settings import Fraction, NonNegative, Positive, Settings, setting, settings_group
from saga_fg.slam.mapping import MeasuredMotion

_LOG = logging.getLogger(__name__)
_FEWEST = 200  # points of a submap that shows a place
_COMPARED, _REGISTERED = 12, 6  # places for each search
_SURFEL = 1.0  # m, of the map
_GUESSED = np.diag([0.02, 0.02, 0.1, 1.0, 1.0, 0.5]) ** 2  # of a pose that was given or recognised
_ACCURACY = np.diag([1e-3] * 3 + [0.03] * 3) ** 2  # of the map, rad and m
_RELOADED = 15.0  # m of way after which the surfels around are taken anew


@dataclass(frozen=True)
class LocaliserSettings(Settings):
    """Settings of localisation in a map."""

    odometry: OdometrySettings = settings_group(OdometrySettings, "LiDAR odometry")
    search_way: Positive = setting(
        15.0, "way whose points are looked for in the map, m; higher: surer, and later; usual 10 to 30"
    )
    min_overlap: Fraction = setting(
        0.5, "share of what stands above the ground that they and the map have in common; higher: surer"
    )
    radius: Positive = setting(80.0, "distance of the submaps that scans are registered with, m; higher: slower")
    scan_spacing: Positive = setting(1.5, "spacing of the points of a scan that is registered, m; higher: faster")
    max_residual: Positive = setting(0.3, "largest mean distance of the points of a scan from the map, m")
    min_pairs: Fraction = setting(0.4, "least share of the points of a scan that the map must have surfels for")
    lag: NonNegative = setting(2.0, "time over which keyframes are smoothed, s; 0: a filter")
    lost_after: Positive = setting(50.0, "way without a scan that fits after which the place is looked for again, m")
    robust_scale: Positive = setting(3.0, "residual from which the Cauchy loss discounts a measured pose, deviations")


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

    guess: map_T_lidar (4, 4) of the first scan, good to a metre or two and a tenth of a radian; None: it is looked for
    """

    def __init__(
        self, slam_map: SlamMap, guess: FloatArray | None = None, settings: LocaliserSettings | None = None
    ) -> None:
        self.settings = settings or LocaliserSettings()
        self._map = slam_map
        self._odometry = LidarOdometry(self.settings.odometry)
        self._guess = None if guess is None else checked_transform("guess", guess)
        self._index: PlaceIndex | None = None
        self._poses, self._covariances = list[FloatArray](), list[FloatArray]()  # by odometry
        self._found: dict[int, FloatArray] = {}  # map_T_lidar of keyframes, as estimated when they came
        self._clouds: list[tuple[int, FloatArray]] = []  # that are looked for, with their rows
        self._searched = 0.0  # m, way of the last search
        self._smoother: IncrementalSmoother | None = None
        self._last, self._way, self._fitted = 0, 0.0, 0.0  # keyframe in the graph; m
        self._pose, self._covariance = np.eye(4), _GUESSED  # of that keyframe
        self._surfels, self._centre = SurfelMap(_SURFEL, np.inf), np.full(3, np.inf)

    def step(self, scan: Scan, time: float) -> LocalisedStep:
        """Place the next scan. Raises `InputError` for one that is not later than the one before."""
        placed = self._odometry.step(scan, time)
        self._poses.append(placed.map_T_lidar)
        covariances = shared(self._poses, placed)
        self._covariances[len(self._poses) - len(covariances) :] = covariances
        row = len(self._poses) - 1
        if row:
            self._way += float(np.linalg.norm((inverse_transform(self._poses[-2]) @ self._poses[-1])[:3, 3]))
        points, registered = placed.scan.points, False
        if placed.keyframe:
            if self._smoother is None:
                self._look_for(row, points)
            if self._smoother is not None:
                registered = self._add(row, points, time)
        if self._smoother is None:
            return LocalisedStep(None, None, False)
        since, covariance = motion(self._poses[self._last :], self._covariances[self._last + 1 :])
        Ad = gtsam.Pose3(inverse_transform(since)).AdjointMap()
        return LocalisedStep(self._pose @ since, Ad @ self._covariance @ Ad.T + covariance, registered)

    def path(self) -> FloatArray | None:
        """map_T_lidar (K, 4, 4) of all scans so far; None if no place has been found.

        Scans before the first keyframe that was placed lie where odometry says, seen from it.
        """
        if not self._found:
            return None
        rows, odometry = np.array(sorted(self._found)), np.array(self._poses)
        of = np.maximum(np.searchsorted(rows, np.arange(len(odometry)), side="right") - 1, 0)
        found = np.array([self._found[row] for row in rows.tolist()])
        return np.asarray(found[of] @ inverse_transform(odometry[rows[of]]) @ odometry)

    def _look_for(self, row: int, points: FloatArray) -> None:
        """Begin the graph where the guess says, or at a place that the points since the last search resemble."""
        s = self.settings
        if self._guess is not None:
            self._begin(self._guess @ inverse_transform(self._poses[0]) @ self._poses[row])
            self._guess = None
            return
        self._clouds.append((row, points[voxel_downsample(points, 0.5)]))
        if self._way - self._searched < s.search_way:
            return
        middle = self._poses[self._clouds[len(self._clouds) // 2][0]]
        frame = middle @ upright(middle)  # level as far as the first scan was
        inverse = inverse_transform(frame)
        query = np.concatenate([transform_points(inverse @ self._poses[k], cloud) for k, cloud in self._clouds])
        map_T_frame = self._recognised(query[voxel_downsample(query, 0.5)])
        self._searched, self._clouds = self._way, self._clouds[len(self._clouds) // 2 :]
        if map_T_frame is not None:
            self._begin(map_T_frame @ inverse @ self._poses[row])
            self._clouds = []

    def _begin(self, map_T_lidar: FloatArray) -> None:
        _LOG.info("place found at %s m", map_T_lidar[:3, 3].round(1).tolist())
        self._smoother, self._fitted = IncrementalSmoother(lag=self.settings.lag), self._way
        self._pose, self._covariance = map_T_lidar, _GUESSED

    def _recognised(self, query: FloatArray) -> FloatArray | None:
        """map_T_query (4, 4) of the place that points (N, 3), z up, show, None for none."""
        if len(query) < _FEWEST:
            return None
        if self._index is None:
            self._index = PlaceIndex()
            for number, cloud in enumerate(self._map.points):
                if len(cloud) >= _FEWEST:
                    self._index.add(number, PlaceImage.of(cloud.astype(np.float64)))
        best, shared = None, self.settings.min_overlap
        mine, criteria = Structure.of(query), self.settings.odometry.registration
        points = query[voxel_downsample(query, self.settings.scan_spacing)]
        for match in self._index.candidates(PlaceImage.of(query), None, _COMPARED)[:_REGISTERED]:
            around, frame = self._points_around(self._map.map_T_submap[match.number][:3, 3], match.number)
            surfels = SurfelMap(_SURFEL, np.inf)
            surfels.add(around, np.zeros(3))
            try:
                rough = register(points, surfels, match.place_T_query, 3 * _SURFEL, 1.0, criteria)
                fine = register(points, surfels, rough.map_T_scan, _SURFEL, 0.1, criteria)
            except RegistrationError:
                continue
            overlap = Structure.of(around).shared(mine, fine.map_T_scan)
            if fine.converged and overlap > shared:
                best, shared = frame @ fine.map_T_scan, overlap
        return best

    def _points_around(self, centre: FloatArray, number: int) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the submaps around a place, in the frame of one of them, and that frame (4, 4)."""
        frame = self._map.map_T_submap[number]
        near = np.linalg.norm(self._map.map_T_submap[:, :3, 3] - centre, axis=1) <= self.settings.radius
        near[number] = True
        inverse = inverse_transform(frame)
        moved = [
            transform_points(inverse @ self._map.map_T_submap[k], self._map.points[k].astype(np.float64))
            for k in np.flatnonzero(near).tolist()
        ]
        return np.concatenate(moved), frame

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
        self._smoother.step(time, given)
        (pose,) = self._smoother.graph().of(EGO_POSE, self._smoother.graph().epoch).values()
        self._pose, self._covariance = (
            self._smoother.graph().state(pose.key).matrix(),
            self._smoother.covariance(pose.key),
        )
        self._last = row
        if found is not None or self._way - self._fitted <= s.lost_after:
            self._found[row] = self._pose
        else:
            _LOG.warning(
                "scan at %.2f s: no scan has fitted the map for %.0f m; the place is looked for", time, s.lost_after
            )
            self._smoother, self._searched = None, self._way
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
                start = register(thin, self._surfels, start, 3 * _SURFEL, 1.0, criteria, "hold").map_T_scan
            found = register(thin, self._surfels, start, 1.5 * _SURFEL, 0.1, criteria, "hold")
        except RegistrationError:
            return None
        fits = found.converged and found.pairs >= s.min_pairs * len(thin) and found.residual <= s.max_residual
        return found if fits else None

    def _load(self, centre: FloatArray) -> None:
        """Take the surfels around a place."""
        nearest = int(np.argmin(np.linalg.norm(self._map.map_T_submap[:, :3, 3] - centre, axis=1)))
        points, frame = self._points_around(centre, nearest)
        self._surfels, self._centre = SurfelMap(_SURFEL, np.inf), centre
        self._surfels.add(transform_points(frame, points), centre)


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
