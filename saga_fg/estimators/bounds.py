r"""Bounds on the components of a joint state, for speed: which correlations a prediction leaves out.

    x_i' = sum_{j with i} F_ij x_j + sum_{j not with i} F_ij x_j + b_i + q_i        i and j are "with" in one component

A node j of another component is an independent input: F_ij m_j is taken over exactly, F_ij P_jj F_ij^T is further noise
of x_i', and the correlation of the two is left out. Covariances are blocks of exact ones, and stay positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.partition import Partition
from saga_fg.model.transition import Blocks
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class ComponentBounds:
    """Nodes that become, or remain, one component.

    tolerance  correlation up to which nodes count as independent
    most       largest number of nodes of a component; the strongest ties come first
    """

    tolerance: float
    most: int

    def applied(self, x: BlockGaussian, dynamics: Dynamics) -> tuple[Dynamics, Partition]:
        """The dynamics with inputs, and the components they leave."""
        parts = x.uncorrelated(self.tolerance)
        a, b, strength = _ties(x, dynamics, parts)
        strong = np.flatnonzero(strength > self.tolerance)
        strong = strong[np.argsort(-strength[strong], kind="stable")]
        partition = parts.joined_up_to(a[strong], b[strong], self.most)
        return _with_inputs(x, dynamics, partition), partition


def checked_most(most: int | None) -> int | None:
    """Raise `InputError` unless it is a number of nodes, or None."""
    if most is not None and (isinstance(most, bool) or not isinstance(most, int) or most < 1):
        raise InputError(f"max_component: expected a whole number of nodes >= 1, got {most!r}")
    return most


def _ties(x: BlockGaussian, dynamics: Dynamics, partition: Partition) -> tuple[IntArray, IntArray, FloatArray]:
    """Blocks F_ij between components of `partition`: labels of those of i and j, and how the nodes would correlate.

    That is the largest correlation of F_ij x_j with x_j, in deviations of x_i and x_j before the interval.
    """
    starts, sigma = x.layout.offsets[:-1], np.sqrt(x.variances())
    found: list[tuple[IntArray, IntArray, FloatArray]] = []
    for _, blocks, across in _between(dynamics, partition):
        target, source, values = blocks.target[across], blocks.source[across], blocks.values[across]
        _, d_i, d_j = values.shape
        by_i = sigma[starts[target][:, None] + np.arange(d_i)][:, :, None]
        by_j = sigma[starts[source][:, None] + np.arange(d_j)][:, None, :]
        strength = np.abs(values @ x.covariances(source) / (by_i * by_j)).max(axis=(1, 2))
        found.append((partition.label[target], partition.label[source], strength))
    none = np.empty(0, dtype=np.int64)
    a, b, strength = zip((none, none, np.empty(0)), *found, strict=True)
    return np.concatenate(a), np.concatenate(b), np.concatenate(strength)


def _with_inputs(x: BlockGaussian, dynamics: Dynamics, partition: Partition) -> Dynamics:
    """Nodes of other components of `partition` as independent inputs."""
    starts, F, Q, b = x.layout.offsets[:-1], list(dynamics.F), list(dynamics.Q), dynamics.b.copy()
    for number, blocks, across in _between(dynamics, partition):
        target, source, values = blocks.target[across], blocks.source[across], blocks.values[across]
        _, d_i, d_j = values.shape
        kept = np.ones(len(blocks.target), dtype=bool)
        kept[across] = False
        F[number] = Blocks(blocks.target[kept], blocks.source[kept], blocks.values[kept])
        inputs = values @ x.mean[starts[source][:, None] + np.arange(d_j)][:, :, None]
        np.add.at(b, starts[target][:, None] + np.arange(d_i), inputs[:, :, 0])
        rows, index = np.unique(target, return_inverse=True)
        noise = np.zeros((len(rows), d_i, d_i))
        np.add.at(noise, index, values @ x.covariances(source) @ np.swapaxes(values, 1, 2))
        Q.append(Blocks(rows, rows, noise))
    return dynamics if len(Q) == len(dynamics.Q) else replace(dynamics, F=tuple(F), b=b, Q=tuple(Q))


def _between(dynamics: Dynamics, partition: Partition) -> list[tuple[int, Blocks, IntArray]]:
    """Blocks between components of a partition: the number of their group, the group, which of it."""
    label = partition.label
    found = ((k, F, np.flatnonzero(label[F.target] != label[F.source])) for k, F in enumerate(dynamics.F))
    return [(number, blocks, across) for number, blocks, across in found if len(across)]
