r"""Node-only filtering against filters with node and edge states: cost and accuracy over the number of objects.

The filters with edge states are those of graph tracking (Bal et al., Bayesian Tracking of Video Graphs Using Joint
Kalman Smoothing and Registration, ECCV 2022, as Sani and Anand, arXiv 2411.03702, describe it). Besides the n nodes
x_i, the relations e_ij = x_j - x_i of all ordered pairs are states with means and covariances of their own, and
interactions act through them. From the dynamics x' = F x + b + q of the scene graph, which the node-only filter uses as
they are,

    x_i' = Phi_i x_i + sum_j F_ij e_ij + b_i + q_i                    Phi_i = F_ii + sum_j F_ij
    e_ij' = x_j' - x_i'

Two readings, since neither paper's text fixes how far the n^2 edges are correlated. `JointGraphTracking` is one
Gaussian over all 4 n^2 components, starts with e = x_j - x_i, and gives the node-only filter's answer. In
`SeparateGraphTracking` each node and each edge has its own covariance, which is what n^2 edge attributes at best cost.
There an edge is measured, as z_j - z_i with the noise of both, where both its ends are seen, and correlations between
nodes and edges are left out.

Flocks of cars that share velocities are sampled from the model that all filters know; association is known. Points
drift in the plane, every node listens to the four nearest, chosen anew at every frame. `MIXING` is the share of its
velocity that a node takes over from its neighbours in a frame: 0.2 is weak, 0.5 strong coupling. Positions are
measured, one in ten is missed. Besides, every object is hidden for two seconds once, some at a time, so that
interactions matter. Errors are root mean squares of positions, of objects while they are hidden and of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
import typer
from scipy.spatial import cKDTree

from benchmarks.runner import Rows, Seed, counts, each, in_turn
from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.estimators import Estimator, JointKalmanFilter, Measurements
from saga_fg.model.discretisation import Transition, discretise
from saga_fg.numerics.arrays import FloatArray, IntArray

NODES, JOINT, SEPARATE, APART = "nodes", "nodes and edges", "nodes and edges, each apart", "independent"
HIDDEN_FOR, SHARES, MIXING = 20, 5, 0.35  # frames; parts of the objects, hidden one after the other
WARM_UP = 3  # frames that are not timed
DT = 0.1  # s between frames
POSITION_NOISE = 0.3  # standard deviation of a measured position, m
MISSED = 0.1  # share of the nodes that are not seen in a frame
NEIGHBOURS = 4
SPACING = 10.0  # m
SPEED = 2.0  # with which the flock drifts apart, m/s
CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.0))
Step = Callable[[], None]
Read = tuple[FloatArray, FloatArray]  # newest means (n, 4) and covariances (n, 4, 4)
D = 4  # size of a node's state, and of an edge's


def scaling(
    objects: Annotated[
        str, typer.Option("--objects", help="Numbers of objects, with commas between.")
    ] = "5,10,20,50,100,200",
    joint_limit: Annotated[
        int, typer.Option("--joint-limit", min=2, help="Most objects for one filter over all nodes and edges.")
    ] = 20,
    frames: Annotated[int, typer.Option("--frames", min=30, help="Length of a recording.")] = 140,
    seed: Seed = 0,
) -> Rows:
    """Cost and accuracy of filters that estimate nodes, and nodes and edges, over the number of objects.

    \b
    Examples:
      python -m benchmarks scaling
      python -m benchmarks scaling --objects 5,10,15 --frames 60 --json figures.json
    """
    for n in each(counts("--objects", objects, least=2), "objects"):  # one has no neighbours
        yield from (("nodes alone, and nodes and edges", row) for row in rows_of(n, n <= joint_limit, frames, seed))


def rows_of(n: int, joint: bool, frames: int, seed: int) -> list[dict[str, Any]]:
    """A row for every filter of a flock of n; differences are of a mean from the node-only filter's, in its sigmas."""
    drawn = flock(n, frames, seed)
    filters: dict[str, Filter] = {NODES: Ours(JointKalmanFilter(), drawn), SEPARATE: SeparateGraphTracking(drawn)}
    filters |= {JOINT: JointGraphTracking(drawn)} if joint else {}
    filters[APART] = Ours(JointKalmanFilter(), drawn)
    turn = np.arange(frames)[:, None] // HIDDEN_FOR - 1
    hidden = (turn >= 0) & (np.arange(n) % SHARES == turn)
    squares = {name: np.zeros(2) for name in filters}
    furthest = dict.fromkeys(filters, 0.0)

    def judged() -> Iterator[FlockFrame]:
        """The frames; once all filters have taken one in, their errors."""
        for frame, away in zip(drawn.frames, hidden, strict=True):
            m, seen = frame.measurements, ~away[frame.measurements.nodes]
            yield replace(frame, measurements=Measurements(m.nodes[seen], m.z[seen], m.H[seen], m.R[seen]))
            reference, P = filters[NODES].read()
            deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
            for name, one in filters.items():
                mean, _ = one.read()
                error = ((mean - frame.truth)[:, :2] ** 2).mean(axis=1)
                squares[name] += error[away].sum(), error.sum()
                furthest[name] = max(furthest[name], float((np.abs(mean - reference) / deviation).max()))

    contenders = {name: one.prepare for name, one in filters.items()}
    contenders[APART] = lambda frame: filters[APART].prepare(_without_edges(frame))
    times = {name: float(np.median(spent)) for name, spent in in_turn(contenders, judged(), WARM_UP).items()}
    rows = []
    for name, ms in times.items():
        numbers = 4 * n if name in (NODES, APART) else 4 * n**2
        away_rmse, rmse = np.sqrt(squares[name] / [hidden.sum(), hidden.size]).tolist()
        row = {"objects": n, "filter": name, "numbers": numbers, "ms a frame": ms, "/ nodes": ms / times[NODES]}
        rows.append({**row, "RMSE hidden, m": away_rmse, "RMSE, m": rmse, "off by, sigma": furthest[name]})
    return rows


def _without_edges(frame: FlockFrame) -> FlockFrame:
    graph = frame.transition.graph
    return replace(frame, transition=discretise(SceneGraph.of(graph.nodes, graph.types[0]), DT))


@dataclass(frozen=True, eq=False)
class FlockFrame:
    """An interval and what is seen at its end; truth (n, 4) there."""

    transition: Transition
    measurements: Measurements
    truth: FloatArray


@dataclass(frozen=True, eq=False)
class Flock:
    """nodes (n,), prior means (n, 4) and covariances (n, 4, 4), frames."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray
    frames: tuple[FlockFrame, ...]

    def __len__(self) -> int:
        return len(self.nodes)


def flock(n: int, frames: int, seed: int, mixing: float = MIXING) -> Flock:
    """A flock of n cars over some frames.

    Who interacts follows from points that drift whatever the truth does, as edges are inputs to a filter.
    """
    rng = np.random.default_rng(seed)
    P = np.diag([0.25, 0.25, 1.0, 1.0])
    points, drift = rng.uniform(0, SPACING * np.sqrt(n), (n, 2)), SPEED * rng.normal(size=(n, 2))
    truth = np.concatenate([points, drift], axis=1)
    means = truth + rng.normal(size=(n, 4)) * np.sqrt(np.diag(P))
    record = []
    for _ in range(frames):
        points = points + drift * DT
        target, source = _nearest(points)
        rate = rng.uniform(0.5, 1.5, len(target)) * -np.log(1 - mixing) / DT / NEIGHBOURS
        A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
        edges = Edges("shared velocity", target, source, rate, -A, A, np.zeros((len(target), 4)))
        transition = discretise(SceneGraph.of(np.arange(n), CAR, [edges]), DT)
        truth = sample_step(transition, truth, rng)
        seen = np.flatnonzero(rng.random(n) >= MISSED)
        z = truth[seen, :2] + POSITION_NOISE * rng.normal(size=(len(seen), 2))
        measured = Measurements(seen, z, np.eye(2, 4), POSITION_NOISE**2 * np.eye(2))
        record.append(FlockFrame(transition, measured, truth))
    return Flock(np.arange(n), means, np.tile(P, (n, 1, 1)), tuple(record))


def sample_step(transition: Transition, states: FloatArray, rng: np.random.Generator) -> FloatArray:
    """States (n, d) at the end of an interval, with sampled process noise, in the order of the transition's nodes."""
    moved: FloatArray = (transition.F_matrix @ states.ravel() + transition.b).reshape(states.shape)
    for blocks in transition.Q:
        noise = rng.normal(size=(len(blocks.target), states.shape[1], 1))
        moved[blocks.target] += (np.linalg.cholesky(blocks.values) @ noise)[:, :, 0]
    return moved


def _nearest(points: FloatArray) -> tuple[IntArray, IntArray]:
    """Targets and sources: from the nearest others to each."""
    count = min(NEIGHBOURS, len(points) - 1)
    _, nearest = cKDTree(points).query(points, count + 1)
    return np.repeat(np.arange(len(points)), count), np.asarray(nearest)[:, 1:].ravel()


class Filter(Protocol):
    """A contender. What `prepare` does itself is not timed, the step that it returns is."""

    def prepare(self, frame: FlockFrame) -> Step:
        """The step that takes a frame in and reads out what is asked of all contenders."""
        ...

    def read(self) -> Read:
        """What was read in the latest step."""
        ...


class Ours:
    """An estimator of this package; all newest means and covariances are read."""

    def __init__(self, estimator: Estimator, flock: Flock) -> None:
        self.estimator, self._nodes = estimator, flock.nodes
        estimator.add(flock.nodes, flock.means, flock.covariances)

    def prepare(self, frame: FlockFrame) -> Step:
        return partial(self.step, frame)

    def step(self, frame: FlockFrame) -> None:
        self.estimator.predict(frame.transition)
        self.estimator.update(frame.measurements)
        self._read = self.estimator.mean(self._nodes), self.estimator.covariance(self._nodes)

    def read(self) -> Read:
        return self._read


class JointGraphTracking:
    """One Kalman filter over nodes and edges."""

    def __init__(self, flock: Flock) -> None:
        n = self._n = len(flock)
        self._first, self._second = np.nonzero(~np.eye(n, dtype=bool))
        # (x, e) = lift x
        ends = scipy.sparse.csr_array(np.eye(n)[self._second] - np.eye(n)[self._first])
        relations = scipy.sparse.kron(ends, scipy.sparse.eye_array(D))
        self._lift = scipy.sparse.csr_array(scipy.sparse.vstack([scipy.sparse.eye_array(D * n), relations]))
        self._mean = self._lift @ flock.means.ravel()
        self._P = self._lift @ (self._lift @ scipy.linalg.block_diag(*flock.covariances)).T

    def prepare(self, frame: FlockFrame) -> Step:
        F, b, Q, z, H, R = dense(frame)
        lifted_Q = scipy.sparse.csr_array(self._lift @ scipy.sparse.csr_array(Q) @ self._lift.T)
        wide_H = scipy.sparse.csr_array(np.pad(H, ((0, 0), (0, len(self._mean) - H.shape[1]))))
        whole_F = scipy.sparse.csr_array(self._lift @ self._of_nodes(F))
        return partial(self._step, whole_F, self._lift @ b, lifted_Q, z, wide_H, R)

    def _step(self, F: Any, b: FloatArray, Q: Any, z: FloatArray, H: Any, R: FloatArray) -> None:
        mean = F @ self._mean + b
        P = F @ (F @ self._P).T
        P += Q
        HP = H @ P
        L = np.linalg.cholesky(H @ HP.T + R)
        W = scipy.linalg.solve_triangular(L, HP, lower=True)
        self._mean = mean + W.T @ scipy.linalg.solve_triangular(L, z - H @ mean, lower=True)
        self._P = P - W.T @ W

    def read(self) -> Read:
        return blocks(self._mean, self._P, self._n)

    def _of_nodes(self, F: FloatArray) -> scipy.sparse.csr_array:
        """(4 n, 4 n^2): the nodes' next states, where what neighbours contribute acts through edges."""
        parts = F.reshape(self._n, D, self._n, D)
        own = scipy.linalg.block_diag(*parts.sum(axis=2))
        edges = np.zeros((self._n, D, len(self._first), D))
        edges[self._first, :, np.arange(len(self._first))] = parts[self._first, :, self._second]
        return scipy.sparse.csr_array(np.concatenate([own, edges.reshape(D * self._n, -1)], axis=1))


class SeparateGraphTracking:
    """A Kalman filter for every node and every edge."""

    def __init__(self, flock: Flock) -> None:
        self._x, self._P = flock.means, flock.covariances
        self._e = self._x[None] - self._x[:, None]
        self._E = self._P[None] + self._P[:, None]

    def prepare(self, frame: FlockFrame) -> Step:
        n = len(self._x)
        F = frame.transition.F_matrix.toarray().reshape(n, D, n, D)
        Phi, F = F.sum(axis=2), F.transpose(0, 2, 1, 3).copy()
        F[np.arange(n), np.arange(n)] = 0.0
        target, source = np.nonzero(F.any(axis=(2, 3)))
        return partial(self._step, frame, Phi, F[target, source], target, source, *_noise(frame, n))

    def _step(
        self,
        frame: FlockFrame,
        Phi: FloatArray,
        F: FloatArray,
        target: IntArray,
        source: IntArray,
        Q: FloatArray,
        b: FloatArray,
    ) -> None:
        """Predict nodes, and edges as the differences of what their ends are predicted to do; then correct both."""
        n = len(self._x)
        drift = _summed(target, (F @ self._e[target, source][..., None])[..., 0], n) + b
        spread = _summed(target, F @ self._E[target, source] @ np.swapaxes(F, 1, 2), n) + Q
        self._x = (Phi @ self._x[..., None])[..., 0] + drift
        self._P = Phi @ self._P @ np.swapaxes(Phi, 1, 2) + spread
        wide = Phi[:, None]
        self._e = (wide @ self._e[..., None])[..., 0] + drift[None] - drift[:, None]
        self._E = wide @ self._E @ np.swapaxes(wide, -1, -2) + spread[None] + spread[:, None]
        seen = frame.measurements
        if len(seen):
            rows, H = seen.nodes, seen.H[0]
            self._x[rows], self._P[rows] = _updated(self._x[rows], self._P[rows], seen.z, H, seen.R)
            pairs = rows[:, None], rows[None]
            z, R = seen.z[None] - seen.z[:, None], seen.R[None] + seen.R[:, None]
            self._e[pairs], self._E[pairs] = _updated(self._e[pairs], self._E[pairs], z, H, R)

    def read(self) -> Read:
        return self._x, self._P


def _summed(target: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Values (E, ...) added up by target: (n, ...)."""
    total = np.zeros((n, *values.shape[1:]))
    np.add.at(total, target, values)
    return total


def _updated(x: FloatArray, P: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray) -> Read:
    """Kalman's update of many states at once."""
    HP = H @ P
    K = np.swapaxes(np.linalg.solve(HP @ H.T + R, HP), -1, -2)
    return x + (K @ (z - x @ H.T)[..., None])[..., 0], P - K @ HP


def blocks(mean: FloatArray, covariance: FloatArray, n: int) -> Read:
    """Means and covariances of the first n nodes, one by one, of a dense Gaussian."""
    at = np.arange(D * n).reshape(-1, D)
    return mean[at], covariance[at[:, :, None], at[:, None, :]]


def dense(frame: FlockFrame) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """F, b, Q, z, H, R of a frame as the textbook wants them."""
    transition, seen = frame.transition, frame.measurements
    H = np.zeros((2 * len(seen), len(transition.b)))
    row = np.arange(2 * len(seen)).reshape(-1, 2)
    H[row[:, :, None], (D * seen.nodes[:, None] + np.arange(D))[:, None, :]] = seen.H
    R = scipy.linalg.block_diag(*seen.R) if len(seen) else np.empty((0, 0))
    return transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray(), seen.z.ravel(), H, R


def _noise(frame: FlockFrame, n: int) -> tuple[FloatArray, FloatArray]:
    """Q (n, 4, 4) and b (n, 4) of the nodes."""
    Q = np.zeros((n, D, D))
    for part in frame.transition.Q:
        Q[part.target] = part.values
    return Q, frame.transition.b.reshape(n, D)
