"""What does it cost to match the moments of every node's modes before nodes are coupled?

Up to three nodes that stand or go straight share their velocities; positions are measured. Scenes are drawn from the
model, and filtered in three ways: by full enumeration, a Kalman filter for every sequence of modes of all nodes, which
is exact; by `saga_fg.model.modes`; and by constant velocity alone. The table has, over all frames and scenes,

    means, sigma    root mean square of the difference between the means, in the standard deviations of enumeration
    P(stands)       mean difference of the probability that a node stands
    velocity RMSE   against the truth by enumeration, and of the other two as ratios to it
"""

from __future__ import annotations

from itertools import product
from typing import Annotated, NamedTuple

import numpy as np
import typer

from benchmarks.runner import Rows, Seed, each
from pipelines.tracking import one_thread
from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model import Mixture, ModeTable, Stationary, discretise, mode_dynamics
from saga_fg.numerics import FloatArray

TITLE = "moments matched node by node, against every sequence of modes"
FRAMES = {1: 10, 2: 6, 3: 4}  # by number of nodes: 1024 to 4096 sequences
INTERVAL, NOISE = 0.5, 0.3  # s; m
MIXTURE = Mixture((Stationary(), ConstantVelocity(2.0)), dwell_time=3.0)
MIXED, STRAIGHT = NodeType("mixture", MIXTURE), NodeType("straight", ConstantVelocity(2.0))
START = np.diag([0.25, 0.25, 4.0, 4.0])
H, R = np.eye(2, 4), NOISE**2 * np.eye(2)


class Frame(NamedTuple):
    """True states (n, 4) and measured positions (n, 2)."""

    states: FloatArray
    z: FloatArray


class Estimate(NamedTuple):
    """Of a frame: mean (4 n,), standard deviations (4 n,), probability (n,) that each node stands."""

    mean: FloatArray
    sigma: FloatArray
    stands: FloatArray


class JointMode(NamedTuple):
    """One mode of each node: their numbers (n,), and x' = F x + q, q ~ N(0, Q), of all nodes given them."""

    modes: tuple[int, ...]
    F: FloatArray
    Q: FloatArray


def modes(
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Scenes of each number of nodes.")] = 50,
    seed: Seed = 0,
) -> Rows:
    """What matching the moments of modes node by node costs, against full enumeration on up to three nodes.

    \b
    Examples:
      python -m benchmarks modes
      python -m benchmarks modes --scenes 10 --json figures.json
    """
    with one_thread():
        for n, frames in FRAMES.items():
            differences, of_modes, errors = [], [], []
            for number in each(range(scenes), f"{n} nodes"):
                drawn = draw(np.random.default_rng([seed, n, number]), n)
                for frame, exact, own, plain in zip(
                    drawn, enumerated(drawn), matched(drawn), constant_velocity(drawn), strict=True
                ):
                    differences.append((own.mean - exact.mean) / exact.sigma)
                    of_modes.append(np.abs(own.stands - exact.stands))
                    errors.append([_speed_error(mean, frame) for mean in (exact.mean, own.mean, plain)])
            rms = np.sqrt(np.mean(errors, axis=0))
            yield (
                TITLE,
                {
                    "nodes": n,
                    "frames": frames,
                    "sequences": len(MIXTURE.motions) ** (n * frames),
                    "means, sigma": np.sqrt(np.mean(np.square(differences))),
                    "P(stands)": np.mean(of_modes),
                    "velocity RMSE, m/s": rms[0],
                    "matched / enumerated": rms[1] / rms[0],
                    "constant velocity / enumerated": rms[2] / rms[0],
                },
            )


def scene(n: int, node_type: NodeType, mode_tables: tuple[ModeTable, ...] = ()) -> SceneGraph:
    """A row of nodes, each of which shares the velocity of the next."""
    pairs = np.arange(n - 1)
    velocity = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (n - 1, 1, 1))
    edges = Edges("shared", pairs, pairs + 1, np.full(n - 1, 0.5), -velocity, velocity, np.zeros((n - 1, 4)))
    return SceneGraph(np.arange(n), (node_type,) * n, (edges,) if n > 1 else (), motions=mode_tables)


def joint_modes(n: int) -> list[JointMode]:
    """Return all combinations of the modes of n nodes."""
    coupled = discretise(scene(n, MIXED), INTERVAL).F_matrix.toarray()
    back = np.linalg.inv(np.eye(4) + INTERVAL * MIXTURE.generator)
    F, _, Q = (part[0] for part in mode_dynamics(MIXTURE, np.zeros((1, 2, 4)), INTERVAL))
    found = []
    for numbers in product(range(2), repeat=n):
        joint, noise = coupled.copy(), np.zeros_like(coupled)
        for i, r in enumerate(numbers):
            at = slice(4 * i, 4 * i + 4)
            G = coupled[at, at] @ back
            joint[at, at], noise[at, at] = G @ F[r], G @ Q[r] @ G.T
        found.append(JointMode(numbers, joint, noise))
    return found


def draw(rng: np.random.Generator, n: int) -> list[Frame]:
    """A scene of n nodes."""
    by_numbers, change = {one.modes: one for one in joint_modes(n)}, MIXTURE.transition(INTERVAL)
    numbers = rng.integers(0, 2, n)
    x = (rng.normal(size=(n, 4)) @ np.sqrt(START)).ravel()
    frames = []
    for _ in range(FRAMES[n]):
        numbers = np.array([rng.choice(2, p=change[r]) for r in numbers])
        step = by_numbers[tuple(numbers.tolist())]
        x = step.F @ x + np.linalg.cholesky(step.Q) @ rng.normal(size=4 * n)
        states = x.reshape(n, 4)
        frames.append(Frame(states, states[:, :2] + NOISE * rng.normal(size=(n, 2))))
    return frames


def enumerated(frames: list[Frame]) -> list[Estimate]:
    """Filter by one Kalman filter for each sequence of modes."""
    n = len(frames[0].z)
    change, combinations = MIXTURE.transition(INTERVAL), joint_modes(n)
    together = np.array([[np.prod(change[list(a.modes), list(b.modes)]) for b in combinations] for a in combinations])
    picks, noise = np.kron(np.eye(n), H), np.kron(np.eye(n), R)
    last = np.arange(len(combinations))
    log_w = np.full(len(last), -np.log(len(last)))
    m, P = np.zeros((len(last), 4 * n)), np.tile(np.kron(np.eye(n), START), (len(last), 1, 1))
    stands = np.array([one.modes for one in combinations]) == 0
    result = []
    for frame in frames:
        parts = []
        for c, (_, F, Q) in enumerate(combinations):
            mean, cov = m @ F.T, F @ P @ F.T + Q
            S = picks @ cov @ picks.T + noise
            gain = np.swapaxes(np.linalg.solve(S, picks @ cov), 1, 2)
            v = frame.z.ravel() - mean @ picks.T
            distance = (v * np.linalg.solve(S, v[..., None])[..., 0]).sum(axis=1)
            weight = log_w + np.log(together[last, c]) - (distance + np.linalg.slogdet(S)[1]) / 2
            updated = mean + (gain @ v[..., None])[..., 0], cov - gain @ S @ np.swapaxes(gain, 1, 2)
            parts.append((np.full(len(last), c), weight, *updated))
        last, log_w, m, P = (np.concatenate(column) for column in zip(*parts, strict=True))
        log_w -= np.logaddexp.reduce(log_w)
        w = np.exp(log_w)
        mean = w @ m
        sigma = np.sqrt(w @ (np.diagonal(P, axis1=1, axis2=2) + (m - mean) ** 2))
        result.append(Estimate(mean, sigma, w @ stands[last]))
    return result


def matched(frames: list[Frame]) -> list[Estimate]:
    """Filter by one joint Gaussian, as the tracker does: moments are matched node by node."""
    n = len(frames[0].z)
    ids, joint = np.arange(n), JointKalmanFilter()
    start = np.zeros((n, 4)), np.tile(START, (n, 1, 1))
    joint.add(ids, *start)
    table, result = ModeTable.new(MIXTURE, ids, *start), []
    for frame in frames:
        table = table.anchored(joint.mean(ids), joint.covariance(ids))
        joint.predict(discretise(scene(n, MIXED, (table,)), INTERVAL))
        table = table.predicted(INTERVAL)[0].anchored(joint.mean(ids), joint.covariance(ids))
        table, z, directions = table.updated(ids, frame.z, np.tile(H, (n, 1, 1)), np.tile(R, (n, 1, 1)))
        joint.update(Measurements(ids, z, directions, np.eye(4)))
        sigma = np.sqrt(np.diag(joint.joint_covariance(ids)))
        result.append(Estimate(joint.joint_mean(ids), sigma, table.weight[:, 0]))
    return result


def constant_velocity(frames: list[Frame]) -> list[FloatArray]:
    """Means (4 n,) of a filter that knows of no modes."""
    n = len(frames[0].z)
    ids, joint, means = np.arange(n), JointKalmanFilter(), []
    joint.add(ids, np.zeros((n, 4)), np.tile(START, (n, 1, 1)))
    for frame in frames:
        joint.predict(discretise(scene(n, STRAIGHT), INTERVAL))
        joint.update(Measurements(ids, frame.z, H, R))
        means.append(joint.joint_mean(ids))
    return means


def _speed_error(mean: FloatArray, frame: Frame) -> float:
    """Mean square of the errors of velocity, m^2/s^2."""
    return float(np.square(mean.reshape(-1, 4) - frame.states)[:, 2:].mean())
