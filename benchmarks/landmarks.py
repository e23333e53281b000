"""SLAM on drives past landmarks: trees of unknown identity (Victoria Park), and ranges to beacons (Plaza).

Pose and trees are one Gaussian (`LocalMap`), whose correlations the gates of association need. After every
`SMOOTH_EVERY` observations all measurements are solved together, so that linearisation errors do not add up, and trees
that were begun twice, while the pose was poorly known, are merged:

    delta_ij = l_j - l_i,        S_ij = P_ii + P_jj - P_ij - P_ji

Two may be one where d^2 = delta^T S^-1 delta is inside the gate, unless they were seen together from one pose. A single
pair says little where S is large. But differences are correlated: if one pair is one tree, the others are known much
better. For a set of pairs the odds of being one against being two multiply, each pair given those before it,

    log odds(set) = sum_k log odds( delta_k | delta_1 = 0, ..., delta_{k-1} = 0 )

so that a constellation is recognised where no single tree is. From each pair as a seed the set grows by the likeliest
pair as long as that raises the odds; the likeliest set of all is merged, if its odds are better than even. To judge
pairs jointly is the idea of J. Neira and J. D. Tardos (IEEE Transactions on Robotics and Automation 17, 2001).

The covariances of a recording's odometry assume independent errors. True errors persist (a wheel slips through the
whole bend), and add up to more. So a scale of the covariances is chosen first, the likeliest of a few on the beginning;
the identities in the file are not used. The evidence is Laplace's approximation at the solution x* with information H:

    log p(z) = -E(x*) - 1/2 log det H + D/2 log 2 pi - 1/2 sum_i log det 2 pi R_i + sum_landmarks log density

Trees are compared with the identities in the file by all pairs of observations (Manning, Raghavan and Schuetze,
Introduction to Information Retrieval, 2008, section 16.3).

Range-only SLAM: a drive and its beacons from odometry and ranges of an uncalibrated radio.

A range does not say where its beacon is, so nothing can be begun from one. The beginning of the drive, by dead
reckoning, gives each beacon a first place by linear trilateration,

    z^2 = || l - t ||^2    =>    2 (t_k - t_mean)^T l = z_mean^2 - z_k^2 + |t_k|^2 - |t|^2_mean

From there everything is solved at once, for ever longer parts of the drive, each starting where the last ended and
going on by dead reckoning: poses, beacons, and the radio's scale and offset, with a robust loss over ranges, since
echoes are long.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import accumulate, combinations
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from numpy.typing import ArrayLike

from benchmarks.recordings.landmarks import LandmarkLog, read_landmark_log
from benchmarks.runner import Rows, each
from data_tools.trajectories import Trajectory, absolute_errors, matched, rigid_alignment
from factors import PlanarPose, ResidualFactors, Robust, Solution, SolverSettings, prior_factor
from saga_fg.errors import InputError
from saga_fg.estimators import BatchSolver
from saga_fg.graph import EGO_ERROR, LANDMARK, Additions, GraphView, NewVariable, SceneFactorGraph, ask_all, key_of
from saga_fg.model.landmarks import PointLandmark
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import gate
from saga_fg.numerics.geometry import in_space, transform_points
from saga_fg.slam.mapping import (
    LandmarkObservations,
    LocalMap,
    MeasuredMotion,
    associate,
    landmark_key,
    log_odds,
    pose_key,
)
from saga_fg.types.frame import Observation

_PATH_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=50)
_FIRST_POSE = 1e-8  # variance of the first pose, m^2 and rad^2
_RANGES = 10  # at least, to place a beacon by
_LOSS = Robust("cauchy", 2.0)  # of ranges, standard deviations
_RADIO = np.diag([0.1, 1.0]) ** 2  # covariance of scale and offset (m) of the radio at the start
_BEGINNING = 100.0  # m driven before the beacons are placed
_GROWTH = 1.3  # ratio of the lengths of two successive parts of the drive
_CALIBRATION = key_of(EGO_ERROR, 0, None)


@dataclass(frozen=True, eq=False)
class BeaconMap:
    """world_T_pose (N, 3, 3), the first at the origin; beacons (2,) by number, and their covariances (2, 2), m and m^2;
    scale and offset (m) of the ranges; dead_reckoning (N, 3, 3).
    """

    world_T_pose: FloatArray
    beacons: dict[int, FloatArray]
    covariances: dict[int, FloatArray]
    scale: float
    offset: float
    dead_reckoning: FloatArray


def map_beacons(drive: LandmarkLog) -> BeaconMap:
    """Estimate all of a drive. Raises `InputError` for a beacon without ranges enough to place it."""
    reckoned = np.stack(list(accumulate(drive.a_T_b, np.matmul, initial=np.eye(3))))
    end = int(np.searchsorted(np.cumsum(np.hypot(*drive.a_T_b[:, :2, 2].T)), _BEGINNING)) + 2
    graph, numbers = SceneFactorGraph(), np.unique(drive.landmark).tolist()
    while graph.epoch + 1 < len(reckoned):
        for row in range(graph.epoch + 1, min(end, len(reckoned))):
            first = np.eye(3), _FIRST_POSE * np.eye(3)
            step = (drive.a_T_b[row - 1], drive.odometry_covariance[row - 1]) if row else first
            graph.advance(max(drive.time[row], np.nextafter(graph.time, np.inf)))  # rows may have one time
            ask_all([MeasuredMotion(*step)], graph)
        poses = np.stack([graph.state(pose_key(row)).matrix() for row in range(graph.epoch + 1)])
        places: dict[int, FloatArray] = {}
        for number in numbers:
            seen = (drive.landmark == number) & (drive.pose <= graph.epoch)
            if landmark_key(number) not in graph.variables and np.count_nonzero(seen) >= _RANGES:
                places[number] = trilateration(poses[drive.pose[seen], :2, 2], drive.value[seen, 0])
        ask_all([_Ranges(drive, places)], graph)
        solver = BatchSolver(graph=graph, settings=_PATH_SOLVER)
        solver.solve()
        graph = solver.snapshot()
        end = max(end + 1, int(_GROWTH * end))
    beacons = {n: graph.state(landmark_key(n)) for n in numbers if landmark_key(n) in graph.variables}
    missing = set(numbers) - set(beacons)
    if missing:
        raise InputError(f"beacon {min(missing)}: expected at least {_RANGES} ranges to place it")
    poses = np.stack([graph.state(pose_key(row)).matrix() for row in range(len(reckoned))])
    covariances = {number: solver.covariance(landmark_key(number)) for number in beacons}
    scale, offset = graph.state(_CALIBRATION).tolist()
    return BeaconMap(poses, beacons, covariances, scale, offset, reckoned)


@dataclass(frozen=True, eq=False)
class _Ranges:
    """All ranges of beacons in the graph from poses in it, those at new places (2,) among them, and the calibration."""

    drive: LandmarkLog
    places: Mapping[int, FloatArray]
    name: str = "ranges"

    def factors(self, view: GraphView) -> Additions:
        drive = self.drive
        new = [NewVariable(LANDMARK, n, place, static=True, label="beacon") for n, place in self.places.items()]
        factors = []
        if _CALIBRATION not in view.variables:
            new.append(NewVariable(EGO_ERROR, 0, np.zeros(2), static=True, label="calibration"))
            factors.append(prior_factor(_CALIBRATION, np.zeros(2), _RADIO))
        used = (drive.pose <= view.epoch) & np.isin(drive.landmark, [*view.static(LANDMARK), *self.places])
        pairs = zip(drive.pose[used].tolist(), drive.landmark[used].tolist(), strict=True)
        rows = [[pose_key(row), landmark_key(number), _CALIBRATION] for row, number in pairs]
        ranges = _range_factors(rows, drive.value[used, 0], float(drive.covariance[0, 0, 0]))
        return Additions(new, factors, {"ranges": [ranges]})


def _range_factors(rows: list[list[int]], z: FloatArray, variance: float) -> ResidualFactors:
    """r = (1 + s) || l - t || + o - z of poses (R, t), beacons l and the radio's calibration (s, o); z (n,) m.

    With u the unit vector towards the beacon, and the pose moved to t + R v, dr/dv = -(1 + s) u^T R,
    dr/dl = (1 + s) u^T, dr/ds = || l - t ||, dr/do = 1.
    """

    def residual(pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> FloatArray:
        distance = np.linalg.norm(beacon - pose[:, :2, 2], axis=1)
        expected: FloatArray = (1 + calibration[:, 0]) * distance + calibration[:, 1]
        return (expected - z)[:, None]

    def jacobians(pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> list[FloatArray]:
        towards = beacon - pose[:, :2, 2]
        distance = np.linalg.norm(towards, axis=1)
        if (distance == 0).any():
            raise InputError("range: the pose is at its beacon, where the direction is undefined")
        scaled = ((1 + calibration[:, :1]) * towards / distance[:, None])[:, None, :]
        by_pose = np.concatenate([-scaled @ pose[:, :2, :2], np.zeros((len(z), 1, 1))], axis=2)
        return [by_pose, scaled, np.stack([distance, np.ones_like(distance)], axis=1)[:, None, :]]

    keys = np.array(rows, dtype=np.uint64).reshape(-1, 3)
    return ResidualFactors(keys, (PlanarPose(), 2, 2), residual, variance * np.eye(1), jacobians, _LOSS, name="ranges")


def compared(drive: LandmarkLog, found: BeaconMap) -> dict[str, float]:
    """Figures against the truth where there is one.

    The estimate is moved as a whole to lie nearest to the true path; beacons are compared after the same motion. The
    true heading has no part in it: its zero is not that of the direction of travel in every recording.
    """
    figures = {"scale": found.scale, "offset, m": found.offset}
    if drive.truth is None:
        return figures
    tolerance = float(np.diff(drive.time).max(initial=0.01))
    estimate, truth = matched(Trajectory(drive.time, in_space(found.world_T_pose)), drive.truth, tolerance)
    reckoned, _ = matched(Trajectory(drive.time, in_space(found.dead_reckoning)), drive.truth, tolerance)
    figures["ATE, m"] = _root_mean_square(absolute_errors(estimate, truth))
    figures["ATE of dead reckoning, m"] = _root_mean_square(absolute_errors(reckoned, truth))
    known = [number for number in found.beacons if number in drive.places]
    if known:
        truth_T_world = rigid_alignment(estimate.positions, truth.positions)
        places = np.array([[*found.beacons[number], 0.0] for number in known])
        off = transform_points(truth_T_world, places)[:, :2] - np.array([drive.places[number] for number in known])
        figures["beacons, m"] = _root_mean_square(np.linalg.norm(off, axis=1))
    return figures


def _root_mean_square(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def trilateration(places: FloatArray, ranges: FloatArray) -> FloatArray:
    """Return the point (2,) at these ranges (K,) from these places (K, 2), m, in the sense of linear least squares."""
    b = (ranges**2).mean() - ranges**2 + (places**2).sum(axis=1) - (places**2).sum(axis=1).mean()
    return np.asarray(np.linalg.lstsq(2 * (places - places.mean(axis=0)), b, rcond=None)[0])


SCALES = (1.0, 4.0, 16.0, 64.0, 256.0)  # of the covariance, to choose of
BEGINNING = 2000  # poses on which that is chosen
TREE = PointLandmark(name="tree", density=0.01)  # one on 10 m by 10 m
SMOOTH_EVERY = 300  # observations
START = 1e-6 * np.eye(3)  # covariance of the first pose, m^2 and rad^2
_GATE = 1 - 1e-6  # probability, of merging; near 1, since an outlier begins a tree anew
_SAME = 1e-6  # variance of the difference of a tree from itself, for the numerics
_SEEDS = 40  # pairs that sets are grown from, the likeliest
_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=20)


def landmarks(
    file: Annotated[Path, typer.Argument(help="victoria_park.txt, or NAME_DR.txt of Plaza with the others beside it.")],
    odometry_scale: Annotated[
        float | None,
        typer.Option("--odometry-scale", help="Of the covariance of Victoria Park; chosen from data if left out."),
    ] = None,
) -> Rows:
    """Map a drive past landmarks: trees without the identities in the file, beacons by ranges of a radio alone.

    Trees are compared with these identities, beacons and the drive with the truth where there is one.

    \b
    Examples:
      python -m benchmarks landmarks data/slam/victoria_park.txt
      python -m benchmarks landmarks data/slam/Plaza2_DR.txt
    """
    if odometry_scale is not None and not 0 < odometry_scale < np.inf:
        raise InputError(f"--odometry-scale {odometry_scale:g}: expected a number > 0")
    drive = read_landmark_log(file)
    title = f"{file.name}: {len(drive.time)} poses, {len(drive.value)} observations"
    if drive.value.shape[1] == 1:
        if odometry_scale is not None:
            raise InputError(f"--odometry-scale: expected a drive past trees, {file} has ranges")
        yield title, compared(drive, map_beacons(drive))
        return
    scale = odometry_scale
    if scale is None:
        evidence = {one: driven(drive, one, BEGINNING).log_evidence() for one in SCALES}
        yield "log evidence by odometry scale", {f"{k:g}": v for k, v in evidence.items()}
        scale = max(evidence, key=lambda one: evidence[one])
    park = driven(drive, scale)
    park.smooth()
    agreement = pairwise_agreement(park.numbers(), drive.landmark)
    counts = {"trees": len(park.local.kinds), "named in the file": len(np.unique(drive.landmark))}
    yield title, {**counts, "odometry scale": scale, **{f"pairwise {k}": v for k, v in agreement._asdict().items()}}


def driven(drive: LandmarkLog, scale: float, most: int | None = None) -> TreeMapper:
    """The mapper after the first poses, or all of them."""
    mapper = TreeMapper()
    begin = np.searchsorted(drive.pose, np.arange(len(drive.time) + 1)).tolist()
    for pose in each(range(len(drive.time))[:most], f"odometry covariance x {scale:g}"):
        if pose:
            mapper.move(drive.a_T_b[pose - 1], scale * drive.odometry_covariance[pose - 1])
        rows = range(begin[pose], begin[pose + 1])
        mapper.observe([Observation(TREE, drive.value[row], drive.covariance[row]) for row in rows])
    return mapper


class TreeMapper:
    """Builds a map of points in the plane from odometry and observations, one pose after the other."""

    def __init__(self) -> None:
        self.local = LocalMap(np.eye(3), START)
        self._motions = [(np.eye(3), START)]
        self._seen: dict[int, list[tuple[int, Observation]]] = {}  # by pose, each with the number of its tree
        self._poses = np.empty((0, 3, 3))  # at the last solution
        self.begun = 0  # trees, those merged later among them
        self._since = 0

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose by odometry: a_T_b (3, 3), covariance (3, 3) of its tangent."""
        self.local.predict(a_T_b, covariance)
        self._motions.append((a_T_b, covariance))

    def observe(self, observations: Sequence[Observation]) -> None:
        """Add observations from the present pose; one without a clear match begins a new tree."""
        pairs = associate(self.local, observations) if observations else {}
        if pairs:
            self.local.update(list(pairs.values()))
        now = self._seen.setdefault(len(self._motions) - 1, []) if observations else []
        for row, observation in enumerate(observations):
            if row not in pairs:
                self.begun += 1
                self.local.augment(self.begun, observation)
            now.append((pairs[row].landmark if row in pairs else self.begun, observation))
        self._since += len(observations)
        if self._since >= SMOOTH_EVERY:
            self.smooth()

    def smooth(self) -> Solution:
        """Solve all measurements together, and merge trees that are one, until none are left."""
        self._since = 0
        while True:
            solution = self._solved()
            merged = duplicates(self.local, self._seen_together())
            if not merged:
                return solution
            self._seen = {pose: [(merged.get(n, n), z) for n, z in now] for pose, now in self._seen.items()}

    def log_evidence(self) -> float:
        """log p(z) of all measurements so far."""
        solution = self.smooth()
        noise = [Q for _, Q in self._motions] + [z.covariance for now in self._seen.values() for _, z in now]
        half_log_det = float(solution.linear.eliminateMultifrontal().logDeterminant())
        volume = 0.5 * sum(solution.values.dims().values()) * float(np.log(2 * np.pi))
        normaliser = 0.5 * sum(float(np.linalg.slogdet(2 * np.pi * R)[1]) for R in noise)
        begun = len(self.local.kinds) * float(np.log(TREE.density))
        return -solution.error - half_log_det + volume - normaliser + begun

    def numbers(self) -> list[int]:
        """The tree of each observation, in the order in which they came."""
        return [number for now in self._seen.values() for number, _ in now]

    def _solved(self) -> Solution:
        """Solve everything from the present estimate, and read pose and trees anew."""
        numbers = sorted(set(self.numbers()))
        graph = SceneFactorGraph()
        observations = LandmarkObservations(self._seen, {n: self.local.state(n) for n in numbers})
        for k, motion in enumerate(self._motions):
            graph.advance(float(k))
            ask_all([MeasuredMotion(*motion, self._poses[k] if k < len(self._poses) else None), observations], graph)
        solution = graph.solve(_SOLVER)
        self._poses = np.stack([solution.values.atPose2(pose_key(k)).matrix() for k in range(len(self._motions))])
        P = solution.covariance([pose_key(len(self._motions) - 1), *map(landmark_key, numbers)])
        states = {n: (TREE, solution.values.atVector(landmark_key(n))) for n in numbers}
        self.local = LocalMap(self._poses[-1], P, states)
        return solution

    def _seen_together(self) -> set[tuple[int, int]]:
        """Pairs of trees that were seen from one pose."""
        return {pair for now in self._seen.values() for pair in combinations(sorted({n for n, _ in now}), 2)}


def duplicates(local: LocalMap, seen_together: Set[tuple[int, int]]) -> dict[int, int]:
    """Find trees to merge: number -> the lower number of the same tree; each occurs once.

    seen_together: pairs (lower, higher) of different trees
    """
    numbers = sorted(local.kinds)
    pairs = [(a, b) for a, b in combinations(range(len(numbers)), 2) if (numbers[a], numbers[b]) not in seen_together]
    if not pairs:
        return {}
    i, j = np.array(pairs).T
    states = np.stack([local.state(number) for number in numbers])
    P = local.covariance(numbers).reshape(len(numbers), 2, len(numbers), 2)
    delta = states[j] - states[i]
    S = P[i, :, i] + P[j, :, j] - P[i, :, j] - P[j, :, i] + _SAME * np.eye(2)
    possible = np.isfinite(_odds(delta, S))
    i, j, delta = i[possible], j[possible], delta[possible]
    half = P[j] - P[i]  # (K, 2, n, 2): covariances of the differences with all trees
    C = half[:, :, j] - half[:, :, i] + _SAME * np.eye(len(i))[:, None, :, None] * np.eye(2)[:, None]
    return {numbers[j[k]]: numbers[i[k]] for k in _likeliest_set(np.stack([i, j], axis=1), delta, C)}


def _likeliest_set(pairs: IntArray, delta: FloatArray, covariance: FloatArray) -> list[int]:
    """Rows of the pairs (K, 2) of the likeliest set; delta (K, 2) and their joint covariance (K, 2, K, 2)."""
    best, chosen, every = 0.0, list[int](), np.arange(len(pairs))
    single = _odds(delta, covariance[every, :, every])
    for seed in np.argsort(-single)[:_SEEDS].tolist():
        total, rows, free, row, won = 0.0, list[int](), every, seed, float(single[seed])
        mean, C = delta, covariance
        while won > 0 or not rows:
            total += won
            rows.append(row)
            apart = ~np.isin(pairs[free], pairs[row]).any(axis=1)
            keep = free[apart]
            if not len(keep):
                break
            at = int(np.flatnonzero(free == row)[0])
            gain = np.linalg.solve(C[at, :, at], C[at].reshape(2, -1)).T.reshape(len(free), 2, 2)[apart]
            mean = mean[apart] - gain @ mean[at]
            C = C[apart][:, :, apart] - np.einsum("kij,jlm->kilm", gain, C[at][:, apart])
            free, along = keep, np.arange(len(keep))
            odds = _odds(mean, C[along, :, along])
            row, won = int(free[np.argmax(odds)]), float(odds.max())
        if total > best:
            best, chosen = total, rows
    return chosen


def _odds(delta: FloatArray, S: FloatArray) -> FloatArray:
    """Log odds (K,) that differences (K, 2) of covariance (K, 2, 2) are none; minus infinity outside the gate."""
    squared = (delta * np.linalg.solve(S, delta[:, :, None])[:, :, 0]).sum(axis=1)
    odds = log_odds(squared, np.linalg.slogdet(S)[1], 2, TREE.density)
    return np.where(squared < gate(_GATE, 2), odds, -np.inf)


class Agreement(NamedTuple):
    """Precision and recall are 1 without pairs in their denominator; F1 = 2 precision recall / (precision + recall)."""

    precision: float
    recall: float
    F1: float


def pairwise_agreement(estimated: ArrayLike, true: ArrayLike) -> Agreement:
    """Agreement of two groupings (n,), the group of each observation, over all pairs of observations."""
    both = np.stack([np.asarray(estimated), np.asarray(true)])
    common, claimed, actual = (_pairs(table) for table in (both, both[:1], both[1:]))
    precision, recall = common / claimed if claimed else 1.0, common / actual if actual else 1.0
    return Agreement(precision, recall, 2 * precision * recall / max(precision + recall, 1e-300))


def _pairs(groups: FloatArray) -> float:
    """Number of pairs of equal columns (k, n)."""
    counts = np.unique(groups, axis=1, return_counts=True)[1]
    return float((counts * (counts - 1) // 2).sum())
