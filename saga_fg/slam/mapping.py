"""Maps of landmarks of unknown identity, estimated jointly with the poses.

In a running graph, poses and landmarks have keys, and providers add motions and associated observations. Between two
smoothings the pose and the landmarks near it are one Gaussian, kept by an error-state Kalman filter (`LocalMap`).

What is observed from near the pose says of landmarks farther off only what it says of these, so that a filter of these
alone is the filter of the whole map, marginalised. State x = (pose, l_1, ..., l_n) with covariance P of its tangents.
With factors linearised and whitened at the state, r + A_p dp + A_l dl + w, w ~ N(0, 1):

    predict   P_pp <- Ad P_pp Ad^T + Q,  P_pl <- Ad P_pl              Ad of the inverse increment
    update    S = A P A^T + 1,  K = P A^T S^-1,  x <- x + (-K r),  P <- P - K A P
    augment   dl = -A_l^-1 (A_p dp + w)                                 a landmark starts at its first observation

Source: R. Smith, M. Self, P. Cheeseman, "Estimating uncertain spatial relationships in robotics", 1990.

Association of observations with landmarks: gates, mutual exclusion, joint compatibility.

    d^2 = r^T S^-1 r,      S = A P A^T + R      (innovation of one observation against one landmark)

A pair is possible inside the gate, and where it is likelier than an observation of a landmark not yet in the map, of
which `density` are expected per unit of volume:

    d^2 + log det(2 pi S)  <  -2 log density

so that neighbours are not confused while the pose is poorly known: the observation then initiates a new landmark, which
is merged later. The likeliest assignment among the possible pairs is chosen, each landmark once. Then all pairs are
tested together, with the correlations that their common pose causes: while the joint d^2 is outside the gate of its
dimension, the pair whose removal lowers it most is removed (after J. Neira and J. D. Tardos, "Data association in
stochastic mapping using the joint compatibility test", IEEE Transactions on Robotics and Automation 17, 2001, who
search all combinations).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factors import (
    ResidualFactors,
    Robust,
    Solution,
    Variable,
    Vector,
    between_factor,
    pose,
    pose_prior_factor,
)
from factors.manifolds import central_differences
from saga_fg.errors import InputError
from saga_fg.estimators import GraphSolution
from saga_fg.graph import EGO_POSE, LANDMARK, Additions, Factor, GraphView, NewVariable, key_of
from saga_fg.numerics import FloatArray, IntArray, assign, gate
from saga_fg.types import Landmark, LandmarkType, Observation


def pose_key(epoch: int) -> int:
    """Key of the vehicle's pose at an epoch."""
    return key_of(EGO_POSE, 0, epoch)


def landmark_key(number: int) -> int:
    """Key of a landmark."""
    return key_of(LANDMARK, number, None)


@dataclass(frozen=True, eq=False)
class Given:
    """Provider of what is known already."""

    added: Additions
    name: str

    def factors(self, view: GraphView) -> Additions:
        return self.added


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Add the next pose by its measured motion since the one before, a_T_b; the first one by a prior, world_T_pose.

    measured: (d + 1, d + 1); covariance (k, k) of its tangent; start: the pose to begin with, by default as measured
    """

    measured: FloatArray
    covariance: FloatArray
    start: FloatArray | None = None
    name: str = "odometry"

    def factors(self, view: GraphView) -> Additions:
        key, state = pose_key(view.epoch), pose("measured", self.measured)
        if view.epoch == 0:
            factor = pose_prior_factor(key, self.measured, self.covariance)
        else:
            last = pose_key(view.epoch - 1)
            factor, state = between_factor(last, key, self.measured, self.covariance), view.state(last).compose(state)
        if self.start is not None:
            state = pose("start", self.start)
        return Additions([NewVariable(EGO_POSE, 0, state, label="vehicle")], [factor])


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """Add associated observations: by epoch, each with the number of its landmark.

    A landmark is added with its first observation, at its state in `start`, or with the last of these epochs if that
    was before; all factors come with the last and under its number, so that those of a kind are linearised together.
    robust: a loss, not for GTSAM's own factors.
    """

    seen: Mapping[int, Sequence[tuple[int, Observation]]]
    start: Mapping[int, Any]
    robust: Robust | None = None
    name: str = "landmarks"

    def factors(self, view: GraphView) -> Additions:
        last = max(self.seen, default=None)
        now = [self.seen.get(view.epoch, ())] if last != view.epoch else self.seen.values()
        kinds = {number: observation.kind for one in now for number, observation in one}
        new = [
            NewVariable(LANDMARK, n, self.start[n], static=True, label=kind.name, type=kind.variable)
            for n, kind in kinds.items()
            if landmark_key(n) not in view.variables
        ]
        return Additions(new, named={last: observation_factors(self.seen, self.robust)} if last == view.epoch else {})

    def landmarks(self, solution: Solution | GraphSolution, confirm: int = 1) -> list[Landmark]:
        """The landmarks by number, where a solution has them; confirm: observations that make one certain."""
        kinds, counts = dict[int, LandmarkType](), Counter[int]()
        for number, observation in (one for now in self.seen.values() for one in now):
            kinds[number] = observation.kind
            counts[number] += 1
        found = []
        for n, kind in sorted(kinds.items()):
            state, covariance = kind.variable.read(solution.values, landmark_key(n)), solution.marginal(landmark_key(n))
            found.append(Landmark(n, kind, state, covariance, counts[n], counts[n] >= confirm))
        return found


def observation_factors(
    seen: Mapping[int, Sequence[tuple[int, Observation]]], robust: Robust | None = None
) -> list[Factor]:
    """The factors of observations as in `LandmarkObservations`, those of a kind together."""
    by_kind: dict[LandmarkType, list[tuple[list[int], Observation]]] = {}
    for epoch, now in seen.items():
        for number, observation in now:
            row = [pose_key(epoch), landmark_key(number)]
            by_kind.setdefault(observation.kind, []).append((row, observation))
    factors: list[Factor] = []
    for kind, alike in by_kind.items():
        rows = np.array([row for row, _ in alike], dtype=np.int64)
        observed, covariances = (np.stack([getattr(z, name) for _, z in alike]) for name in ("value", "covariance"))
        factors += kind.factors(rows, observed, covariances)
    if robust is None:
        return factors
    return [replace(one, robust=robust) if isinstance(one, ResidualFactors) else one for one in factors]


_OPEN = 1e-9  # smallest singular value over the largest one of what determines a landmark


def whitened_jacobians(
    kind: LandmarkType, rows: IntArray, observed: FloatArray, covariances: FloatArray, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals r (n, d), and their Jacobians (n, d, k) by the pose and (n, d, d) by the landmark, whitened.

    rows: (n, 2) keys of pose and landmark. Raises `InputError` naming the type for what its factors refuse.
    """
    parts, k = [], kind.pose.dim
    with _naming(kind, observed[0]):
        for factor in kind.factors(rows, observed, covariances):
            if isinstance(factor, ResidualFactors):
                W, (by_pose, by_landmark), r = factor.linearisation(values)
                parts.append(((W @ r[:, :, None])[:, :, 0], W @ by_pose, W @ by_landmark))
            else:
                A, b = factor.linearize(values).jacobian()
                parts.append((-b[None], A[None, :, :k], A[None, :, k:]))
        r, by_pose, by_landmark = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
        return r, by_pose, by_landmark


@contextmanager
def _naming(kind: LandmarkType, observed: FloatArray) -> Iterator[None]:
    """Name the type and the observation in an error of the type's own."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        text = " ".join((str(error) if isinstance(error, ValueError) else repr(error)).split())
        raise InputError(f"{kind.name} observed as {observed.tolist()}, which its type cannot read: {text}") from error


def first_seen(observation: Observation, world_T_pose: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """The state of a landmark by its first observation, A_l^-1 (d, d) and A_p (d, k) there.

    Raises `InputError` naming the components of the state that the observation leaves open.
    """
    kind, values = observation.kind, gtsam.Values()
    with _naming(kind, observation.value):
        state = kind.initialise(world_T_pose, observation.value)
    values.insert(0, pose("world_T_pose", world_T_pose))
    values.insert(1, state)
    one = (np.array([[0, 1]]), observation.value[None], observation.covariance[None])
    _, (by_pose,), (by_landmark,) = whitened_jacobians(kind, *one, values)
    _, sizes, directions = np.linalg.svd(by_landmark)
    known = np.sum(sizes > _OPEN * sizes[0])
    if known < kind.variable.dim:
        left = np.flatnonzero(np.abs(directions[known:]).max(axis=0) > 0.1).tolist()
        raise InputError(
            f"{kind.name} observed as {observation.value.tolist()}: components {left} of its state are not determined; "
            f"expected an observation of all {kind.variable.dim}, or another landmark type that has only those observed"
        )
    return state, np.linalg.inv(by_landmark), by_pose


POSE = 0  # key of the pose; landmarks have positive ones


@dataclass(frozen=True, eq=False)
class Innovation:
    """One observation against one landmark, whitened: r (d,), A_p (d, k), A_l (d, d)."""

    landmark: int
    r: FloatArray
    by_pose: FloatArray
    by_landmark: FloatArray


@dataclass(frozen=True, eq=False)
class Innovations(Sequence[Innovation]):
    """Innovations of one kind: landmarks n, r (n, d), A_p (n, d, k), A_l (n, d, d)."""

    landmarks: Sequence[int]
    r: FloatArray
    by_pose: FloatArray
    by_landmark: FloatArray

    def __len__(self) -> int:
        return len(self.landmarks)

    def __getitem__(self, row: Any) -> Any:
        return Innovation(self.landmarks[row], self.r[row], self.by_pose[row], self.by_landmark[row])


class LocalMap:
    """Pose and landmarks near it; a landmark's key is its number."""

    def __init__(
        self,
        world_T_pose: FloatArray,
        covariance: FloatArray,
        landmarks: Mapping[int, tuple[LandmarkType, Any]] | None = None,
    ) -> None:
        """covariance: of the pose and of landmarks, type and state by number, in this order."""
        self.values = gtsam.Values()
        self.values.insert(POSE, pose("world_T_pose", world_T_pose))
        self.planar = world_T_pose.shape == (3, 3)
        self.kinds: dict[int, LandmarkType] = {}
        self.P = np.array(covariance, dtype=np.float64)
        self._columns = {POSE: slice(0, 3 if self.planar else 6)}
        for number, (kind, state) in (landmarks or {}).items():
            self._insert(number, kind, state)

    def copy(self) -> LocalMap:
        """A copy that can go on without this one."""
        twin = copy(self)
        twin.values, twin.P = gtsam.Values(self.values), self.P.copy()
        twin.kinds, twin._columns = dict(self.kinds), dict(self._columns)
        return twin

    @property
    def pose(self) -> Any:
        """The pose as GTSAM's."""
        return self.values.atPose2(POSE) if self.planar else self.values.atPose3(POSE)

    def state(self, landmark: int) -> Any:
        """The state of a landmark."""
        return self.kinds[landmark].variable.read(self.values, landmark)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """The joint covariance of some variables."""
        columns = self._columns_of(keys)
        return np.asarray(self.P[np.ix_(columns, columns)])

    def predict(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Predict the pose after a measured increment; covariance (k, k) of its tangent."""
        increment = pose("a_T_b", a_T_b)
        k = increment.dim()
        self.values.update(POSE, self.pose.compose(increment))
        Ad = increment.inverse().AdjointMap()
        self.P[:k] = Ad @ self.P[:k]
        self.P[:, :k] = self.P[:, :k] @ Ad.T
        self.P[:k, :k] += covariance

    def innovations(self, observations: Sequence[Observation], landmarks: Sequence[int]) -> Innovations:
        """Each of n observations against each of m landmarks, all of one kind: n m innovations, row by row."""
        n, m = len(observations), len(landmarks)
        rows = np.stack([np.full(n * m, POSE), np.tile(landmarks, n)], axis=1)
        observed, R = (np.stack([getattr(z, name) for z in observations]) for name in ("value", "covariance"))
        repeated = (np.repeat(observed, m, axis=0), np.repeat(R, m, axis=0))
        return Innovations(rows[:, 1].tolist(), *whitened_jacobians(observations[0].kind, rows, *repeated, self.values))

    def innovation_covariance(self, innovations: Sequence[Innovation]) -> FloatArray:
        """S (D, D) of innovations together, whitened: the identity is the noise alone."""
        A, columns = self._stacked(innovations)
        return np.asarray(A @ self.P[np.ix_(columns, columns)] @ A.T + np.eye(len(A)))

    def squared_distances(self, innovations: Innovations) -> tuple[FloatArray, FloatArray]:
        """d^2 (n,) and log det S (n,) of each innovation alone."""
        k = self._columns[POSE].stop
        A_p, A_l, r = innovations.by_pose, innovations.by_landmark, innovations.r
        columns = np.array([self._columns[landmark].start for landmark in innovations.landmarks])[:, None]
        columns = columns + np.arange(r.shape[1])
        P_ll = self.P[columns[:, :, None], columns[:, None, :]]
        P_pl = self.P[:k][:, columns].swapaxes(0, 1)
        cross = A_p @ P_pl @ A_l.swapaxes(1, 2)
        S = A_p @ self.P[:k, :k] @ A_p.swapaxes(1, 2) + cross + cross.swapaxes(1, 2)
        S += A_l @ P_ll @ A_l.swapaxes(1, 2) + np.eye(r.shape[1])
        squared = (r * np.linalg.solve(S, r[:, :, None])[:, :, 0]).sum(axis=1)
        return squared, np.linalg.slogdet(S)[1]

    def update(self, innovations: Sequence[Innovation]) -> None:
        """Update with observations of different landmarks made from the present pose."""
        A, columns = self._stacked(innovations)
        r = np.concatenate([i.r for i in innovations])
        PA = self.P[:, columns] @ A.T
        S = A @ PA[columns] + np.eye(len(A))
        K = np.linalg.solve(S, PA.T).T
        self.P -= K @ PA.T
        self.P = (self.P + self.P.T) / 2
        self._retract(-K @ r)

    def augment(self, landmark: int, observation: Observation) -> None:
        """Add a landmark at its first observation, from the present pose.

        Raises `InputError`, and adds nothing, where that does not determine it.
        """
        kind = observation.kind
        state, noise, by_pose = first_seen(observation, self.pose.matrix())
        self._insert(landmark, kind, state)
        n, d, k = len(self.P), kind.variable.dim, self._columns[POSE].stop
        G = -noise @ by_pose
        P = np.zeros((n + d, n + d))
        P[:n, :n] = self.P
        P[n:, :n] = G @ self.P[:k]
        P[:n, n:] = P[n:, :n].T
        P[n:, n:] = G @ self.P[:k, :k] @ G.T + noise @ noise.T
        self.P = P

    def _insert(self, landmark: int, kind: LandmarkType, state: Any) -> None:
        """Its columns of P are the next ones."""
        end = max(columns.stop for columns in self._columns.values())
        self.kinds[landmark] = kind
        self.values.insert(landmark, state)
        self._columns[landmark] = slice(end, end + kind.variable.dim)

    def _columns_of(self, keys: Sequence[int]) -> IntArray:
        """The columns of P of some variables, one after the other."""
        return np.concatenate([np.arange(len(self.P))[self._columns[key]] for key in keys])

    def _stacked(self, innovations: Sequence[Innovation]) -> tuple[FloatArray, IntArray]:
        """The Jacobian (D, C) of innovations by the columns (C,) of P that it touches."""
        k = self._columns[POSE].stop
        rows = sum(len(i.r) for i in innovations)
        A = np.zeros((rows, k + sum(i.by_landmark.shape[1] for i in innovations)))
        row, column = 0, k
        for i in innovations:
            m, d = i.by_landmark.shape
            A[row : row + m, :k] = i.by_pose
            A[row : row + m, column : column + d] = i.by_landmark
            row, column = row + m, column + d
        return A, self._columns_of([POSE, *(i.landmark for i in innovations)])

    def _retract(self, delta: FloatArray) -> None:
        self.values.update(POSE, self.pose.retract(delta[self._columns[POSE]]))
        for key, kind in self.kinds.items():
            columns = self._columns[key]
            state = self.state(key)
            moved = kind.variable.retract(state, delta[columns])
            self.values.update(key, moved)
            if not isinstance(kind.variable, Vector):
                self._transport(columns, _turned(kind.variable, state, delta[columns], moved))

    def _transport(self, columns: slice, turned: FloatArray) -> None:
        """Express the covariance of a state in the tangent of where it moved to, whose axes may be others."""
        self.P[columns] = turned @ self.P[columns]
        self.P[:, columns] = self.P[:, columns] @ turned.T


def _turned(variable: Variable, state: Any, delta: FloatArray, moved: Any) -> FloatArray:
    """d local(moved, retract(state, delta + e)) / de (d, d)."""

    def seen(step: FloatArray) -> FloatArray:
        return variable.local(moved, variable.retract(state, delta + step))

    return central_differences(seen, [np.zeros(variable.dim)], [Vector(variable.dim)])[0]


_GATE = 0.999  # gate probability of association; higher: fewer duplicates, more wrong matches


def associate(
    local: LocalMap,
    observations: Sequence[Observation],
    near: Callable[[int, int], bool] = lambda row, landmark: True,
) -> dict[int, Innovation]:
    """Assign the observations made from the present pose to the landmarks.

    near: whether the observation of a row may be of a landmark besides.
    Returns the innovation of each matched observation, by its row.
    """
    landmarks = sorted(local.kinds)
    column = {landmark: j for j, landmark in enumerate(landmarks)}
    gain = np.zeros((len(observations), len(landmarks)))
    candidates: dict[tuple[int, int], Innovation] = {}
    for kind in dict.fromkeys(observation.kind for observation in observations):
        alike = [number for number in landmarks if local.kinds[number] == kind]
        own = [row for row, observation in enumerate(observations) if observation.kind == kind]
        if not alike:
            continue
        innovations = local.innovations([observations[row] for row in own], alike)
        squared, spread = local.squared_distances(innovations)
        dim = kind.variable.dim
        noise = np.linalg.slogdet(np.stack([observations[row].covariance for row in own]))[1]
        won = log_odds(squared, spread + np.repeat(noise, len(alike)), dim, kind.density)
        for k in np.flatnonzero((squared < gate(_GATE, dim)) & (won > 0)).tolist():
            row, landmark = own[k // len(alike)], innovations.landmarks[k]
            if near(row, landmark):
                candidates[row, column[landmark]] = innovations[k]
                gain[row, column[landmark]] = won[k]
    rows, columns = assign(-gain, gain > 0, 0.0)
    pairs = {int(i): candidates[int(i), int(j)] for i, j in zip(rows, columns, strict=True)}
    return _compatible(local, pairs)


def log_odds(squared: FloatArray, log_det: FloatArray, dim: int, density: float) -> FloatArray:
    """Twice the log odds of one landmark against two different ones; squared: d^2, log_det: of S (dim, dim)."""
    return np.asarray(-2 * np.log(density) - squared - log_det - dim * np.log(2 * np.pi))


def _compatible(local: LocalMap, pairs: dict[int, Innovation]) -> dict[int, Innovation]:
    """The pairs without those that contradict the others."""
    while len(pairs) > 1:
        rows = list(pairs)
        innovations = list(pairs.values())
        S = local.innovation_covariance(innovations)
        r = np.concatenate([i.r for i in innovations])
        if _squared(r, S) < gate(_GATE, len(r)):
            break
        owner = np.repeat(np.arange(len(rows)), [len(i.r) for i in innovations])
        left = [_without(r, S, owner, row) for row in range(len(rows))]
        pairs = {row: pairs[row] for row in rows if row != rows[int(np.argmin(left))]}
    return pairs


def _without(r: FloatArray, S: FloatArray, owner: IntArray, row: int) -> float:
    keep = owner != row
    return _squared(r[keep], S[np.ix_(keep, keep)])


def _squared(r: FloatArray, S: FloatArray) -> float:
    return float(r @ np.linalg.solve(S, r))
