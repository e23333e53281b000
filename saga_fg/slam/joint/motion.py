r"""Motion of objects over an interval, with noise that traffic has in common.

A tracker's motion model says how one object moves, x' = F x + b + q, q ~ N(0, Q), and takes the noise of different
objects for independent. Beside a vehicle whose path is unknown that is wrong: traffic brakes, and follows a bend, as
one. Twenty cars that do so by chance are less likely than an error of the vehicle's odometry, and would bend its path.
So vehicles that head the same way, a stream, share a part of their noise,

    x_i' = sum_j F_ij x_j + b_i + sqrt(rho) Q_i^(1/2) c + q_i,     c ~ N(0, I),   q_i ~ N(0, (1 - rho) Q_i)

with one variable c a stream and interval, and the symmetric root, so that c has the same directions for all. Each
object alone moves exactly as in the tracker; only what all do at once is no news of the path.
"""

from __future__ import annotations

import gtsam
import numpy as np

from factors import interaction_factor, prior_factor
from saga_fg.errors import InputError
from saga_fg.graph import NewVariable, VariableKind, key_of
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.graph import object_key
from saga_fg.slam.joint.record import RecordedEpoch

STREAM = VariableKind("traffic stream", "s")
_SHARE = 0.9  # rho
_SECTORS = 4  # of headings beside the vehicle's: the same way, to the left, towards it, to the right


def new_streams(now: RecordedEpoch) -> list[NewVariable]:
    """The variables c of the interval that ends at an epoch."""
    return [NewVariable(STREAM, number, np.zeros(number // _SECTORS), label="stream") for number in _streams(now)]


def stream_keys(now: RecordedEpoch) -> list[int]:
    """Their keys."""
    return [key_of(STREAM, number, now.epoch) for number in _streams(now)]


def motion_factors(now: RecordedEpoch) -> list[gtsam.JacobianFactor]:
    """Motion and interactions from the epoch before, and the priors of c.

    Raises `InputError` for motions and interactions that are not linear.
    """
    transition, k = now.transition, now.epoch
    if transition is None:
        return []
    if transition.graph.nonlinear or any(node_type.flow is not None for node_type in transition.graph.types):
        raise InputError("motion: expected linear motion and interactions of objects beside a vehicle's path")
    streams = _streams(now)
    dims = [number // _SECTORS for number in streams]
    factors = [prior_factor(key, np.zeros(d), np.eye(d)) for key, d in zip(stream_keys(now), dims, strict=True)]
    members = {name: number for number, names in streams.items() for name in names}
    names = transition.nodes.tolist()
    sources: list[list[tuple[int, FloatArray]]] = [[] for _ in names]
    for blocks in transition.F:
        for i, j, F in zip(blocks.target.tolist(), blocks.source.tolist(), blocks.values, strict=True):
            sources[i].append((object_key(k - 1, names[j]), F))
    for blocks in transition.Q:
        roots = _roots(blocks.values)
        for i, Q, root in zip(blocks.target.tolist(), blocks.values, roots, strict=True):
            keys, F, number = [key for key, _ in sources[i]], [one for _, one in sources[i]], members.get(names[i])
            if number is not None:
                keys, F, Q = [*keys, key_of(STREAM, number, k)], [*F, np.sqrt(_SHARE) * root], (1 - _SHARE) * Q
            b = transition.b[transition.offsets[i] : transition.offsets[i + 1]]
            factors.append(interaction_factor(object_key(k, names[i]), keys, F, b, Q))
    return factors


def _streams(now: RecordedEpoch) -> dict[int, list[int]]:
    """Objects of each stream of two and more, by its number: size of a state times the sectors, plus the sector."""
    found: dict[int, list[int]] = {}
    if now.transition is not None:
        for name, d in zip(now.transition.nodes.tolist(), now.transition.graph.dims.tolist(), strict=True):
            heading = now.headings.get(name)
            if heading is not None:
                sector = round(heading / (2 * np.pi / _SECTORS)) % _SECTORS
                found.setdefault(d * _SECTORS + sector, []).append(name)
    return {number: names for number, names in found.items() if len(names) > 1}


def _roots(Q: FloatArray) -> FloatArray:
    """Symmetric square roots of covariances (n, d, d)."""
    values, vectors = np.linalg.eigh(Q)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ vectors.swapaxes(1, 2))
