"""Programs for estimators, and random scene graphs, on which any estimator must agree with the textbook."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, Edges, NodeType, RandomWalk, SceneGraph
from saga_fg.estimators import Gaussian, Measurements, kalman_predict, kalman_update
from saga_fg.model import CarFollowing, Interaction, NodeTable, SharedVelocity, Transition, applies, discretise
from saga_fg.numerics import FloatArray, IntArray

CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.5))
BUS = NodeType("bus", ConstantAcceleration(jerk_noise=0.4))
VAN = NodeType("van", Curvilinear(turn_time=1.5, fading_time=2.0, jerk_noise=0.7))
TRAM = NodeType("tram", ConstantAcceleration(jerk_noise=0.7, fading_time=2.0))
CONE = NodeType("cone", RandomWalk(drift=0.02))
POLE = NodeType("pole", RandomWalk())  # stands still for ever
MOVING = (CAR, BUS, TRAM)


def node_table(rng: Random, types: Sequence[NodeType], ids: ArrayLike | None = None) -> NodeTable:
    """Estimates of nodes that head roughly the same way."""
    n = len(types)
    heading = rng.normal(0.5, 0.3, n)
    speed = rng.uniform(5, 15, n)
    return NodeTable(
        id=np.arange(n) if ids is None else np.asarray(ids),
        label=np.array([t.name for t in types], dtype=np.str_),
        types=tuple(types),
        position=rng.uniform(-30, 30, (n, 2)),
        velocity=np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1),
        heading=heading,
        length=rng.uniform(3, 12, n),
        velocity_variance=rng.uniform(0.1, 2, n),
    )


def random_pairs(rng: Random, targets: Sequence[int], sources: Sequence[int], density: float) -> IntArray:
    """Distinct pairs of different rows."""
    pairs = [(i, j) for i in targets for j in sources if i != j and rng.random() < density]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2).T


def interaction_edges(
    rng: Random, nodes: NodeTable, interaction: Interaction, density: float, max_rate: float
) -> list[Edges]:
    """Edges of one interaction between random pairs of nodes it applies to, by the types of their ends."""
    groups = []
    for target_type in dict.fromkeys(nodes.types):
        for source_type in dict.fromkeys(nodes.types):
            if not applies(interaction.needs, target_type, source_type):
                continue
            rows = [[k for k, t in enumerate(nodes.types) if t is kind] for kind in (target_type, source_type)]
            target, source = random_pairs(rng, rows[0], rows[1], density)
            if len(target):
                rate = rng.uniform(0, max_rate, len(target))
                name = type(interaction).__name__
                groups.append(Edges(name, target, source, rate, *interaction.triples(nodes, target, source)))
    return groups


def arbitrary_edges(rng: Random, types: Sequence[NodeType], density: float, max_rate: float) -> list[Edges]:
    """Edges with made-up triples, between nodes of any two types: A_self damps, A_other and b are anything."""
    groups = []
    for d_i in sorted({t.dim for t in types}):
        for d_j in sorted({t.dim for t in types}):
            rows = [[k for k, t in enumerate(types) if t.dim == d] for d in (d_i, d_j)]
            target, source = random_pairs(rng, rows[0], rows[1], density)
            m = len(target)
            if m:
                A_self = 0.3 * rng.normal(size=(m, d_i, d_i)) - np.eye(d_i)
                A_other = 0.5 * rng.normal(size=(m, d_i, d_j))
                rate = rng.uniform(0, max_rate, m)
                groups.append(Edges("arbitrary", target, source, rate, A_self, A_other, rng.normal(size=(m, d_i))))
    return groups


def random_types(rng: Random, n: int, kinds: Sequence[NodeType] = (CAR, BUS, TRAM, CONE, POLE)) -> tuple[NodeType, ...]:
    return tuple(kinds[k] for k in rng.integers(0, len(kinds), n))


def random_graph(
    rng: Random,
    types: Sequence[NodeType],
    ids: ArrayLike | None = None,
    density: float = 0.4,
    max_rate: float = 1.0,
    arbitrary: bool = True,
) -> SceneGraph:
    """Shared velocity, car-following and (if wanted) arbitrary edges over nodes of the given types, pairs repeating."""
    nodes = node_table(rng, types, ids)
    groups = [
        *interaction_edges(rng, nodes, SharedVelocity(), density, max_rate),
        *interaction_edges(rng, nodes, SharedVelocity(along_heading=True), density / 2, max_rate),
        *interaction_edges(rng, nodes, CarFollowing(headway=0.5), density / 2, max_rate),
        *(arbitrary_edges(rng, types, density / 2, max_rate) if arbitrary else ()),
    ]
    return SceneGraph(nodes.id, nodes.types, tuple(groups))


E = TypeVar("E")
Random = np.random.Generator


class Operation(Protocol):
    """One call of an estimator; `run` returns the log-likelihood of an update, else None."""

    def run(self, estimator: Any) -> float | None: ...


class Add(NamedTuple):
    nodes: IntArray
    means: FloatArray
    covariances: FloatArray

    def run(self, estimator: Any) -> None:
        estimator.add(self.nodes, self.means, self.covariances)


class Predict(NamedTuple):
    transition: Transition

    def run(self, estimator: Any) -> None:
        estimator.predict(self.transition)


class Update(NamedTuple):
    measurements: Measurements

    def run(self, estimator: Any) -> float:
        return float(estimator.update(self.measurements))


class Marginalise(NamedTuple):
    nodes: IntArray

    def run(self, estimator: Any) -> None:
        estimator.marginalise(self.nodes)


def run(program: Iterable[Operation], estimator: E) -> tuple[E, list[float]]:
    """The estimator after the program, and the log-likelihoods of its updates."""
    return estimator, [result for result in (operation.run(estimator) for operation in program) if result is not None]


class TextbookEstimator:
    """The filter of `saga_fg.estimators.reference` behind the methods of an estimator: dense and plain."""

    def __init__(self) -> None:
        self.x = Gaussian(np.empty(0), np.empty((0, 0)))
        self.nodes: IntArray = np.empty(0, dtype=np.int64)
        self.dims: IntArray = np.empty(0, dtype=np.int64)

    def places(self, nodes: ArrayLike) -> IntArray:
        """Places of the states of some nodes in the joint state, stacked."""
        offsets = np.concatenate([[0], np.cumsum(self.dims)]).astype(int)
        rows = [self.nodes.tolist().index(node) for node in np.asarray(nodes).tolist()]
        return np.concatenate([np.empty(0, dtype=int), *(np.arange(offsets[r], offsets[r + 1]) for r in rows)])

    def add(self, nodes: Sequence[int] | IntArray, means: FloatArray, covariances: FloatArray) -> None:
        P = scipy.linalg.block_diag(self.x.covariance, *covariances)
        self.x = Gaussian(np.concatenate([self.x.mean, np.ravel(means)]), P[P.shape[0] - len(P) :, : len(P)])
        self.nodes = np.concatenate([self.nodes, np.asarray(nodes, dtype=np.int64)])
        self.dims = np.concatenate([self.dims, np.full(len(nodes), means.shape[1])])

    def predict(self, transition: Transition) -> None:
        F = np.zeros((len(transition.b), len(self.x.mean)))
        F[:, self.places(transition.nodes)] = transition.F_matrix.toarray()
        self.x = kalman_predict(self.x, F, transition.b, transition.Q_matrix.toarray())
        self.nodes, self.dims = transition.nodes, transition.graph.dims

    def update(self, measurements: Measurements) -> float:
        m, k, _ = measurements.H.shape
        H = np.zeros((m * k, len(self.x.mean)))
        for row, node in enumerate(measurements.nodes.tolist()):
            H[row * k : (row + 1) * k, self.places([node])] = measurements.H[row]
        R = scipy.linalg.block_diag(*measurements.R) if m else np.empty((0, 0))
        self.x, log_likelihood = kalman_update(self.x, measurements.z.ravel(), H, R)
        return log_likelihood

    def marginalise(self, nodes: Sequence[int] | IntArray) -> None:
        kept = ~np.isin(self.nodes, nodes)
        at = self.places(self.nodes[kept])
        self.x = Gaussian(self.x.mean[at], self.x.covariance[np.ix_(at, at)])
        self.nodes, self.dims = self.nodes[kept], self.dims[kept]

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        return self.x.mean[self.places(nodes)]

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        places = self.places(nodes)
        return self.x.covariance[np.ix_(places, places)]

    def mean(self, nodes: Sequence[int] | IntArray) -> FloatArray:
        return np.stack([self.joint_mean([node]) for node in nodes])

    def covariance(self, nodes: Sequence[int] | IntArray) -> FloatArray:
        return np.stack([self.joint_covariance([node]) for node in nodes])


def random_covariance(rng: Random, dim: int, deviation: float) -> FloatArray:
    """Correlated, every variance about deviation squared."""
    A = rng.normal(size=(dim, dim))
    P = A @ A.T + 0.5 * dim * np.eye(dim)
    scale = deviation * rng.uniform(0.7, 1.4, dim) / np.sqrt(np.diag(P))
    return P * scale[:, None] * scale


def new_nodes(rng: Random, ids: Sequence[int], node_type: NodeType) -> Add:
    """Priors of new nodes, a few metres and metres per second uncertain."""
    d = node_type.dim
    covariances = np.stack([random_covariance(rng, d, 2.0) for _ in ids])
    return Add(np.array(ids), rng.normal(size=(len(ids), d)) * 10, covariances)


def random_updates(rng: Random, estimator: TextbookEstimator, roster: dict[int, NodeType]) -> list[Update]:
    """Measurements of some nodes by one sensor: positions, velocities too, or odd combinations of components."""
    updates = []
    kind = int(rng.integers(0, 3))
    for d in sorted({t.dim for t in roster.values()}):
        seen = [node for node, t in roster.items() if t.dim == d and rng.random() < 0.6]  # the others are missed
        if not seen:
            continue
        if kind == 2:
            k = int(rng.integers(1, d + 1))
            H = rng.normal(size=(len(seen), k, d))
        else:
            k = 2 if kind == 0 or d == 2 else 4
            H = np.eye(k, d)
        R = np.stack([random_covariance(rng, k, 0.4) for _ in seen])
        expected = np.stack(
            [np.broadcast_to(H, (len(seen), k, d))[i] @ estimator.mean([n])[0] for i, n in enumerate(seen)]
        )
        updates.append(Update(Measurements(np.array(seen), expected + rng.normal(size=(len(seen), k)), H, R)))
    return updates


def random_program(
    rng: Random,
    moments: int = 6,
    kinds: Sequence[NodeType] = (CAR, BUS, TRAM, CONE),
    intervals: Sequence[float] = (0.02, 0.1, 0.37, 0.5, 1.2),
    max_rate: float = 1.0,
    density: float = 0.3,
) -> list[Operation]:
    """New nodes, predictions with a graph that changes every time, several sensors, misses and leaving nodes.

    Measurements scatter about what a textbook estimator that runs along expects, as those of a real sensor do.
    """
    along, next_id = TextbookEstimator(), 10
    roster: dict[int, NodeType] = {}
    program: list[Operation] = []

    def do(operation: Operation) -> None:
        program.append(operation)
        operation.run(along)

    for moment in range(moments):
        if moment and roster:
            nodes = rng.permutation(list(roster))
            types = tuple(roster[node] for node in nodes.tolist())
            graph = random_graph(rng, types, nodes, density, max_rate)
            do(Predict(discretise(graph, float(rng.choice(intervals)))))
        for node_type in kinds:
            count = int(rng.integers(0, 3)) if moment % 2 == 0 else int(rng.random() < 0.2)
            if count:
                ids = [int(next_id + 3 * k) for k in range(count)]
                next_id += 3 * count
                do(new_nodes(rng, ids, node_type))
                roster.update(dict.fromkeys(ids, node_type))
        for _ in range(int(rng.integers(0, 3))):
            for update in random_updates(rng, along, roster):
                do(update)
        leaving = [node for node in roster if rng.random() < 0.15]
        if leaving:
            do(Marginalise(np.array(leaving)))
            for node in leaving:
                del roster[node]
    return program
