"""What it costs to match the moments of every node's modes before nodes are coupled: `python benchmarks/modes.py`.

Up to three nodes that stand or go straight share their velocities; positions are measured. Drawn from the model, and
filtered by full enumeration (a Kalman filter for every sequence of modes of all nodes, which is exact) and by
`saga_fg.model.modes`. Printed, over all frames and scenes: root mean square of the difference between the two means in
units of the exact standard deviation, mean difference of the probabilities that a node stands, and errors of the
velocity against the truth of both and of constant velocity alone, as a ratio to enumeration.
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import NamedTuple

import numpy as np

from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.modes import Mixture, ModeTable, Stationary, mode_dynamics
from saga_fg.numerics.arrays import FloatArray

FRAMES = {1: 10, 2: 6, 3: 4}  # by number of nodes: 1024 to 4096 sequences
DT, NOISE = 0.5, 0.3
MIXTURE = Mixture((Stationary(), ConstantVelocity(2.0)), stay=2.0)
STRAIGHT = NodeType("straight", ConstantVelocity(2.0))
START = np.diag([0.25, 0.25, 4.0, 4.0])
H, R = np.eye(2, 4), NOISE**2 * np.eye(2)


class Step(NamedTuple):
    """x' = F x + q, q ~ N(0, Q), of all nodes, given their modes."""

    F: FloatArray
    Q: FloatArray


def scene(n: int, node_type: NodeType, modes: tuple[ModeTable, ...] = ()) -> SceneGraph:
    """A row of nodes, each of which shares the velocity of the next."""
    pairs = np.arange(n - 1)
    velocity = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (n - 1, 1, 1))
    edges = Edges("shared", pairs, pairs + 1, np.full(n - 1, 0.5), -velocity, velocity, np.zeros((n - 1, 4)))
    return SceneGraph(np.arange(n), (node_type,) * n, (edges,) if n > 1 else (), modes=modes)


def steps(n: int) -> list[tuple[tuple[int, ...], Step]]:
    """All combinations of the nodes' modes, with what they do over an interval."""
    node_type = NodeType("mixture", MIXTURE)
    coupled = discretise(scene(n, node_type), DT).F_matrix.toarray()
    back = np.linalg.inv(np.eye(4) + DT * node_type.generator)
    F, _, Q = (part[0] for part in mode_dynamics(MIXTURE, np.zeros((1, 2, 4)), DT))
    found = []
    for modes in product(range(2), repeat=n):
        joint, noise = coupled.copy(), np.zeros_like(coupled)
        for i, r in enumerate(modes):
            at = slice(4 * i, 4 * i + 4)
            G = coupled[at, at] @ back
            joint[at, at], noise[at, at] = G @ F[r], G @ Q[r] @ G.T
        found.append((modes, Step(joint, noise)))
    return found


def drawn(rng: np.random.Generator, n: int) -> list[tuple[FloatArray, FloatArray]]:
    """True states (n, 4) and measurements (n, 2) of every frame."""
    of_modes, change = dict(steps(n)), MIXTURE.transition(DT)
    modes = rng.integers(0, 2, n)
    x = (rng.normal(size=(n, 4)) @ np.sqrt(START)).ravel()
    frames = []
    for _ in range(FRAMES[n]):
        modes = np.array([rng.choice(2, p=change[r]) for r in modes])
        F, Q = of_modes[tuple(modes.tolist())]
        x = F @ x + np.linalg.cholesky(Q) @ rng.normal(size=4 * n)
        frames.append((x.reshape(n, 4), x.reshape(n, 4)[:, :2] + NOISE * rng.normal(size=(n, 2))))
    return frames


class Estimate(NamedTuple):
    """Of a frame: mean (4 n,), standard deviations (4 n,), probability (n,) that each node stands."""

    mean: FloatArray
    sigma: FloatArray
    stands: FloatArray


def enumerated(frames: list[tuple[FloatArray, FloatArray]], n: int) -> list[Estimate]:
    """A Kalman filter a sequence of modes."""
    change, combinations = MIXTURE.transition(DT), steps(n)
    together = np.array([[np.prod(change[list(a), list(b)]) for b, _ in combinations] for a, _ in combinations])
    picks = np.kron(np.eye(n), H)
    last = np.arange(len(combinations))
    log_w = np.full(len(last), -np.log(len(last)))
    m, P = np.zeros((len(last), 4 * n)), np.tile(np.kron(np.eye(n), START), (len(last), 1, 1))
    stands = np.array([modes for modes, _ in combinations]) == 0
    result = []
    for _, z in frames:
        parts = []
        for c, (_, (F, Q)) in enumerate(combinations):
            predicted = m @ F.T, F @ P @ F.T + Q
            S = picks @ predicted[1] @ picks.T + np.kron(np.eye(n), R)
            gain = np.swapaxes(np.linalg.solve(S, picks @ predicted[1]), 1, 2)
            v = z.ravel() - predicted[0] @ picks.T
            distance = (v * np.linalg.solve(S, v[..., None])[..., 0]).sum(axis=1)
            weight = log_w + np.log(together[last, c]) - (distance + np.linalg.slogdet(S)[1]) / 2
            updated = predicted[0] + (gain @ v[..., None])[..., 0], predicted[1] - gain @ S @ np.swapaxes(gain, 1, 2)
            parts.append((np.full(len(last), c), weight, *updated))
        last, log_w, m, P = (np.concatenate(column) for column in zip(*parts, strict=True))
        log_w -= np.logaddexp.reduce(log_w)
        w = np.exp(log_w)
        mean = w @ m
        sigma = np.sqrt(w @ (np.diagonal(P, axis1=1, axis2=2) + (m - mean) ** 2))
        result.append(Estimate(mean, sigma, w @ stands[last]))
    return result


def matched(frames: list[tuple[FloatArray, FloatArray]], n: int) -> list[Estimate]:
    """One joint Gaussian, moments matched by node."""
    ids, node_type, joint = np.arange(n), NodeType("mixture", MIXTURE), JointKalmanFilter()
    start = np.zeros((n, 4)), np.tile(START, (n, 1, 1))
    joint.add(ids, *start)
    modes, result = ModeTable.new(MIXTURE, ids, *start), []
    for _, z in frames:
        modes = modes.anchored(joint.mean(ids), joint.covariance(ids))
        joint.predict(discretise(scene(n, node_type, (modes,)), DT))
        modes = modes.predicted(DT)[0].anchored(joint.mean(ids), joint.covariance(ids))
        modes, said, directions = modes.updated(ids, z, np.tile(H, (n, 1, 1)), np.tile(R, (n, 1, 1)))
        joint.update(Measurements(ids, said, directions, np.eye(4)))
        sigma = np.sqrt(np.diag(joint.joint_covariance(ids)))
        result.append(Estimate(joint.joint_mean(ids), sigma, modes.weight[:, 0]))
    return result


def straight(frames: list[tuple[FloatArray, FloatArray]], n: int) -> list[FloatArray]:
    """Means (4 n,) of a filter that knows of no modes."""
    ids, joint, means = np.arange(n), JointKalmanFilter(), []
    joint.add(ids, np.zeros((n, 4)), np.tile(START, (n, 1, 1)))
    for _, z in frames:
        joint.predict(discretise(scene(n, STRAIGHT), DT))
        joint.update(Measurements(ids, z, H, R))
        means.append(joint.joint_mean(ids))
    return means


def compared(n: int, scenes: int) -> str:
    """A row of the table."""
    apart, stands, speed_errors = [], [], []
    for seed in range(scenes):
        frames = drawn(np.random.default_rng(seed), n)
        exact, ours, plain = enumerated(frames, n), matched(frames, n), straight(frames, n)
        for (x, _), a, b, c in zip(frames, exact, ours, plain, strict=True):
            apart.append(((b.mean - a.mean) / a.sigma) ** 2)
            stands.append(np.abs(b.stands - a.stands))
            speed_errors.append([((mean.reshape(n, 4) - x)[:, 2:] ** 2).mean() for mean in (a.mean, b.mean, c)])
    rms = np.sqrt(np.mean(speed_errors, axis=0))
    return (
        f"| {n} | {FRAMES[n]} | {2 ** (n * FRAMES[n])} | {np.sqrt(np.mean(apart)):.3f} | {np.mean(stands):.3f} "
        f"| {rms[0]:.3f} | {rms[1] / rms[0]:.3f} | {rms[2] / rms[0]:.3f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=50)
    scenes = parser.parse_args().scenes
    print(f"{scenes} scenes of each number of nodes, seeds 0 to {scenes - 1}; interval {DT} s")
    print("| nodes | frames | sequences | means, sigma | P(stands) | velocity RMSE, m/s | matched | no modes |")
    print("|---|---|---|---|---|---|---|---|")
    for n in FRAMES:
        print(compared(n, scenes))


if __name__ == "__main__":
    main()
