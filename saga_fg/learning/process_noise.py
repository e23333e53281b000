"""Process noise by maximum likelihood: of constant velocity, and of curvilinear motion.

    q* = argmax_q  sum over objects and times of  log N( z - H m ; 0, H P H^T + R )

m and P are the prediction of the object's own Kalman filter with the acceleration's spectral density q (the prediction
error decomposition; Harvey 1989, section 3.4). All objects are filtered side by side.

Curvilinear motion by maximum likelihood of the next detection, and of detections after gaps of 1 to 3 s.

    theta* = argmin_theta  mean_innovations l(e, S) + sum_h mean_gaps l(e, S) + |log theta - log theta_0|^2 / 2m
    l(e, S) = log det S / 2 + (nu + 2) / 2 log(1 + e^T S^-1 e / (nu - 2)),      nu = `TAILS`

e and S are the innovations, and their covariances, of the filters of the objects, each its own; theta holds the noise
and the time constants of `Curvilinear`, and theta_0 those of the start. The prior counts as if there were m =
`INDEPENDENT` objects and no more: those of one place do alike, and differ from those of another. l is Student's t of
covariance S, so that single wrong detections count little, and with many degrees of freedom, so that covariances cover
rare turns. The gaps are what the time constants show in: the next detection hardly depends on them. The motion is that
of the tracker (`saga_fg.model.manoeuvres`, `saga_fg.tracking.track_filters`), and objects are filtered side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from saga_fg.errors import InputError
from saga_fg.model import ConstantVelocity, Curvilinear, KnownCourses, Motion, NodeType, own_motion
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.tracking import MOVING, TurnRate
from saga_fg.types import DEFAULT

FEWEST_OBJECTS = 10  # a class with fewer has the noise of all objects together
WRONG_REACH = 4.0  # m
_NOISE_BOUNDS = (1e-4, 1e2)  # m^2/s^3


@dataclass(frozen=True, eq=False)
class MeasuredTrajectory:
    """Measured positions of one object: time (T,) s, not decreasing; position (T, 2) m; R (T, 2, 2) m^2.

    yaw, yaw_noise  (T,) rad, measured headings and their standard deviations, NaN where unknown: everywhere if left out
    """

    time: FloatArray
    position: FloatArray
    R: FloatArray
    yaw: FloatArray = None  # type: ignore[assignment]  # an array from construction on
    yaw_noise: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name in ("yaw", "yaw_noise"):
            if getattr(self, name) is None:
                vars(self)[name] = np.full(len(self.time), np.nan)

    def __len__(self) -> int:
        return len(self.time)

    def pieces(self, longest: int) -> list[Self]:
        """Cut into pieces of about the same length, of at most `longest` measurements."""
        parts = np.array_split(np.arange(len(self)), math.ceil(len(self) / longest))
        columns = (self.time, self.position, self.R, self.yaw, self.yaw_noise)
        return [type(self)(*(column[rows] for column in columns)) for rows in parts]


def fit_acceleration_noise(
    objects: Sequence[MeasuredTrajectory],
    initial_speed_deviation: float = 10.0,
) -> float:
    """The most likely `ConstantVelocity.acceleration_noise`, m^2/s^3, of some objects.

    initial_speed_deviation: standard deviation of a velocity component before the second measurement, m/s.
    Raises `InputError` when no object was seen at least three times.
    """
    useful = [o for o in objects if len(o) >= 3]
    if not useful:
        raise InputError("objects: expected at least one object seen three times or more")
    found = minimize_scalar(
        lambda log_q: -log_likelihood(useful, float(np.exp(log_q)), initial_speed_deviation),
        bounds=np.log(_NOISE_BOUNDS),
        method="bounded",
    )
    return float(np.exp(found.x))


def fit_acceleration_noise_by_class(objects: Mapping[str, Sequence[MeasuredTrajectory]]) -> dict[str, float]:
    """The acceleration noise, m^2/s^3, of each class with at least ten objects, and of all together as `default`.

    Raises `InputError` when no object was seen at least three times.
    """
    noise = {DEFAULT: fit_acceleration_noise([found for same in objects.values() for found in same])}
    for label, same in sorted(objects.items()):
        if sum(len(found) >= 3 for found in same) >= FEWEST_OBJECTS:
            noise[label] = fit_acceleration_noise(same)
    return noise


def log_likelihood(
    objects: Sequence[MeasuredTrajectory], acceleration_noise: float, initial_speed_deviation: float = 10.0
) -> float:
    """Log-likelihood of all measurements but each object's first, under independent constant-velocity motion."""
    order = sorted(objects, key=len, reverse=True)
    columns = [np.concatenate([getattr(o, name) for o in order]) for name in ("time", "position", "R")]
    return innovation_likelihood(
        np.array([len(o) for o in order]),
        columns[0],
        columns[1],
        columns[2],
        acceleration_noise,
        initial_speed_deviation,
    )


def innovation_likelihood(
    lengths: IntArray,
    time: FloatArray,
    position: FloatArray,
    R: FloatArray,
    acceleration_noise: float,
    initial_speed_deviation: float,
    wrong: float = 0.0,
) -> float:
    """Log-likelihood of all measurements but each object's first, of objects of these lengths (n,), the longest first.

    time (N,), position (N, 2) and R (N, 2, 2) hold one object after another. wrong: share of measurements that are of
    something else, anywhere within `WRONG_REACH`; a measurement that is more likely one of those does not update.
    """
    start = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    diffusion = ConstantVelocity(acceleration_noise).diffusion[2:, 2:]
    mean = np.zeros((len(lengths), 4))
    mean[:, :2] = position[start]
    P = np.zeros((len(lengths), 4, 4))
    P[:, :2, :2] = R[start]
    P[:, 2:, 2:] = initial_speed_deviation**2 * np.eye(2)
    anything = wrong / (math.pi * WRONG_REACH**2)
    total = 0.0
    for k in range(1, int(lengths[0])):
        n = int((lengths > k).sum())  # objects seen again: the longest come first
        at = start[:n] + k
        dt = (time[at] - time[at - 1])[:, None, None]
        F = np.tile(np.eye(4), (n, 1, 1))
        F[:, :2, 2:] = dt * np.eye(2)
        Q = np.zeros((n, 4, 4))
        Q[:, :2, :2], Q[:, 2:, 2:] = dt**3 / 3 * diffusion, dt * diffusion
        Q[:, :2, 2:] = Q[:, 2:, :2] = dt**2 / 2 * diffusion
        m, P_n = (F @ mean[:n, :, None])[..., 0], F @ P[:n] @ np.swapaxes(F, 1, 2) + Q
        S = P_n[:, :2, :2] + R[at]
        innovation = position[at] - m[:, :2]
        gain = np.swapaxes(np.linalg.solve(S, P_n[:, :2, :]), 1, 2)
        whitened = np.linalg.solve(S, innovation[:, :, None])[..., 0]
        log_density = -0.5 * ((innovation * whitened).sum(axis=1) + np.log(np.linalg.det(S)) + 2 * np.log(2 * np.pi))
        if wrong:
            right = math.log(1 - wrong) + log_density
            gain[right < math.log(anything)] = 0.0
            log_density = np.logaddexp(right, math.log(anything))
        total += float(log_density.sum())
        mean[:n] = m + (gain @ innovation[:, :, None])[..., 0]
        P[:n] = P_n - gain @ P_n[:, :2, :]
    return total


LEARNED = {
    "acceleration_noise": (1e-3, 30.0),
    "lateral_acceleration_noise": (1e-3, 30.0),
    "jerk_noise": (1e-4, 30.0),
    "fading_time": (0.3, 30.0),
    "turn_time": (0.3, 30.0),
}
"""Parameters, and between which bounds they are sought."""
HORIZONS = (1.0, 2.0, 3.0)  # s: gaps
FOLLOWED, SPACING = 1.5, 1.0  # s in view before a gap, and between gaps
STEP = 0.5  # s, of predictions through a gap
TAILS = 30.0  # degrees of freedom
FEWEST = 20  # objects that a fit needs
MOST = 300  # pieces of objects used of a class, evenly spread
LONGEST = 100  # detections of a piece: many short pieces are filtered faster than a few long ones
INDEPENDENT = 10  # objects
MAJORITY = 0.8  # share of all objects; the motion of all together is that of such a class
EVALUATIONS = 80
INITIAL_SPEED_DEVIATION = 8.0  # m/s
_NEAR = 0.06  # s between a detection and the end of a gap


@dataclass(frozen=True, eq=False)
class CurvilinearLikelihood:
    """Objects side by side, the longest first: time (K, N), position (K, N, 2), R (K, N, 2, 2), yaw, yaw_noise (K, N).

    count       (N,) detections of each
    gap_object  (W,) of which object a gap is; gap_start (W,) its last detection; gap_end (W, H) that at each horizon,
                -1 where there is none
    """

    time: FloatArray
    position: FloatArray
    R: FloatArray
    yaw: FloatArray
    yaw_noise: FloatArray
    count: IntArray
    gap_object: IntArray
    gap_start: IntArray
    gap_end: IntArray

    @classmethod
    def from_trajectories(cls, objects: Sequence[MeasuredTrajectory]) -> CurvilinearLikelihood:
        """Some objects, of which there is one at least."""
        order = sorted(objects, key=len, reverse=True)
        K, N = len(order[0]), len(order)
        time, yaw, yaw_noise = (np.full((K, N), np.nan) for _ in range(3))
        position, R = np.full((K, N, 2), np.nan), np.full((K, N, 2, 2), np.nan)
        gaps: list[tuple[int, int, list[int]]] = []
        for n, one in enumerate(order):
            k = len(one)
            time[:k, n], position[:k, n], R[:k, n] = one.time, one.position - one.position[0], one.R
            yaw[:k, n], yaw_noise[:k, n] = one.yaw, one.yaw_noise
            since = one.time - one.time[0]
            for start in np.flatnonzero(np.diff(np.floor(since / SPACING), prepend=0.0) > 0).tolist():
                if since[start] >= FOLLOWED:
                    apart = np.abs(since - since[start] - np.array(HORIZONS)[:, None])
                    gaps.append((n, start, np.where(apart.min(axis=1) < _NEAR, apart.argmin(axis=1), -1).tolist()))
        gap_object, gap_start = (np.array([gap[k] for gap in gaps], dtype=np.int64) for k in range(2))
        gap_end = np.array([gap[2] for gap in gaps], dtype=np.int64).reshape(-1, len(HORIZONS))
        count = np.array([len(one) for one in order])
        return cls(
            time=time,
            position=position,
            R=R,
            yaw=yaw,
            yaw_noise=yaw_noise,
            count=count,
            gap_object=gap_object,
            gap_start=gap_start,
            gap_end=gap_end,
        )

    def loss(self, motion: Curvilinear) -> float:
        """Mean of l over innovations, plus its means over the gaps of each horizon."""
        node_type = NodeType("object", motion)
        turn = TurnRate.initiated(self.yaw[0].copy(), np.nan_to_num(self.yaw_noise[0], nan=np.pi))
        mean, P = (
            np.zeros((len(self.count), 6)),
            np.tile(np.diag(node_type.initial_deviation**2), (len(self.count), 1, 1)),
        )
        mean[:, :2], P[:, :2, :2] = self.position[0], self.R[0]
        P[:, 2:4, 2:4] = INITIAL_SPEED_DEVIATION**2 * np.eye(2)
        innovations, started = [], []
        for k in range(1, len(self.time)):
            n = int((self.count > k).sum())
            dt = np.round(self.time[k, :n] - self.time[k - 1, :n], 3)
            for interval in np.unique(dt).tolist():
                rows = np.flatnonzero(dt == interval)
                mean[rows], P[rows], later = _predicted(node_type, mean[rows], P[rows], turn.select(rows), interval)
                turn.heading[rows], turn.rate[rows], turn.P[rows] = later.heading, later.rate, later.P
            S = P[:n, :2, :2] + self.R[k, :n]
            e = self.position[k, :n] - mean[:n, :2]
            innovations.append(_losses(e, S))
            gain = np.swapaxes(np.linalg.solve(S, P[:n, :2]), 1, 2)
            mean[:n] += (gain @ e[:, :, None])[..., 0]
            P[:n] -= gain @ P[:n, :2]
            turn.update(np.arange(n), self.yaw[k, :n], np.nan_to_num(self.yaw_noise[k, :n], nan=np.pi))
            mine = np.flatnonzero(self.gap_start == k)
            if len(mine):
                at = self.gap_object[mine]
                started.append((mine, mean[at].copy(), P[at].copy(), turn.select(at)))
        total = float(np.concatenate(innovations).mean()) if innovations else 0.0
        return total + (self._gaps(node_type, started) if started else 0.0)

    def _gaps(self, node_type: NodeType, started: list[tuple[IntArray, FloatArray, FloatArray, TurnRate]]) -> float:
        rows, mean, P = (np.concatenate([part[k] for part in started]) for k in range(3))
        turn = TurnRate.concatenate([part[3] for part in started])
        total = 0.0
        for k in range(1, round(HORIZONS[-1] / STEP) + 1):
            mean, P, turn = _predicted(node_type, mean, P, turn, STEP)
            if k * STEP in HORIZONS:
                end = self.gap_end[rows, HORIZONS.index(k * STEP)]
                known = np.flatnonzero(end >= 0)
                if len(known):
                    at, of = end[known], self.gap_object[rows[known]]
                    S = P[known, :2, :2] + self.R[at, of]
                    total += float(_losses(self.position[at, of] - mean[known, :2], S).mean())
        return total


def fit_curvilinear(objects: Sequence[MeasuredTrajectory], start: Curvilinear) -> Curvilinear:
    """The most likely motion of some objects; the share of those that turn stays that of `start`.

    Learned on half of the objects it must be more likely than `start` on the other half, both ways round: else, and
    where objects are fewer than `FEWEST`, `start` is returned.
    """
    useful = [one for one in objects if len(one) >= 3]
    if len(useful) < FEWEST:
        return start
    pieces = [piece for one in useful for piece in one.pieces(LONGEST) if len(piece) >= 3]
    used = [pieces[k] for k in np.unique(np.linspace(0, len(pieces) - 1, MOST).astype(np.int64)).tolist()]
    halves = [CurvilinearLikelihood.from_trajectories(used[k::2]) for k in range(2)]
    for learned, held_out in (halves, halves[::-1]):
        if held_out.loss(_most_likely(learned, start)) >= held_out.loss(start):
            return start
    return _most_likely(CurvilinearLikelihood.from_trajectories(used), start)


def fit_curvilinear_by_class(
    objects: Mapping[str, Sequence[MeasuredTrajectory]], configured: Callable[[str], Motion]
) -> dict[str, Curvilinear]:
    """The motions that were learned: of a class of its own, and of all classes together as `default`.

    configured: the motion of a class, from which learning starts; classes that move otherwise are left alone. A class
    has a motion of its own if that is more likely than that of all together, on objects not learned from; one of most
    objects has that of all.
    """
    mine = {label: same for label, same in sorted(objects.items()) if isinstance(configured(label), Curvilinear)}
    start, learned = configured(DEFAULT), {}
    if isinstance(start, Curvilinear):
        together = fit_curvilinear([one for same in mine.values() for one in same], start)
        if together != start:
            learned[DEFAULT] = together
    number = sum(map(len, mine.values()))
    for label, same in mine.items():
        own = configured(label)
        assert isinstance(own, Curvilinear)
        first = learned.get(DEFAULT, own) if own == start else own
        if own == start and len(same) >= MAJORITY * number:
            continue
        found = fit_curvilinear(same, first) if len(mine) > 1 or own != start else first
        if found != first:
            learned[label] = found
    return learned


def _most_likely(likelihood: CurvilinearLikelihood, start: Curvilinear) -> Curvilinear:
    low, high = np.log(np.array(list(LEARNED.values()))).T
    first = np.clip(np.log([max(getattr(start, name), 1e-9) for name in LEARNED]), low, high)

    def motion(theta: FloatArray) -> Curvilinear:
        values = np.exp(np.clip(theta, low, high)).tolist()
        return replace(start, **dict(zip(LEARNED, values, strict=True)))

    def cost(theta: FloatArray) -> float:
        prior = 0.5 * ((theta - first) ** 2).sum() / INDEPENDENT
        return float(likelihood.loss(motion(theta)) + prior)

    simplex = np.vstack([first, first + 0.5 * np.eye(len(first)) * np.where(first + 0.5 < high, 1, -1)])
    options = {"maxfev": EVALUATIONS, "initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4}
    found = minimize(cost, first, method="Nelder-Mead", options=options)
    return motion(found.x)


def _predicted(
    node_type: NodeType, mean: FloatArray, P: FloatArray, turn: TurnRate, dt: float
) -> tuple[FloatArray, FloatArray, TurnRate]:
    """States, covariances and turn rates of objects (n,) dt seconds later."""
    motion, n = node_type.motion, len(mean)
    assert isinstance(motion, Curvilinear)
    rows = np.arange(n)
    rate, variance = turn.known(rows, motion.turning_share)
    turns = np.hypot(*mean[:, 2:4].T) > MOVING
    rate, variance, known = np.where(turns, rate, 0.0), np.where(turns, variance, 0.0), np.isfinite(turn.heading)
    heading = np.where(known, turn.heading, 0.0)
    course = KnownCourses.from_turn_rates(node_type, rows, heading, rate, variance, mean, dt)
    F, b, Q = course.predicted(dt, np.ones(n))[1]
    F_own, Q_own = own_motion(node_type, dt)
    F, Q, b = (np.where(known.reshape(-1, *(1,) * (x.ndim - 1)), x, y) for x, y in ((F, F_own), (Q, Q_own), (b, 0.0)))
    later = turn.select(rows)
    later.predict(dt, np.full(n, motion.turn_time))
    return (F @ mean[:, :, None])[..., 0] + b, F @ P @ np.swapaxes(F, 1, 2) + Q, later


def _losses(e: FloatArray, S: FloatArray) -> FloatArray:
    square = (e * np.linalg.solve(S, e[:, :, None])[..., 0]).sum(axis=1)
    return np.asarray(0.5 * np.log(np.linalg.det(S)) + (TAILS + 2) / 2 * np.log1p(square / (TAILS - 2)))
