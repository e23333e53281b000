"""The steps of the joint Kalman filter, by the kernels of `saga_fg.kernels.filtering`.

Components are worked on one after the other, and so are measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.bounds import ComponentBounds
from saga_fg.estimators.correction import CANCELLATION, lost_in_rounding
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.measurements import LinearisedMeasurements
from saga_fg.estimators.partition import Partition, unflattened
from saga_fg.kernels.filtering import corrected_state, predicted_state, tie_strengths
from saga_fg.model.transition import Blocks
from saga_fg.numerics.arrays import FloatArray, IntArray


class _FlatBlocks(NamedTuple):
    """m blocks of any sizes: target, source (m,), where each begins (m,), and all values one after the other."""

    target: IntArray
    source: IntArray
    begin: IntArray
    values: FloatArray


def predicted(x: BlockGaussian, dynamics: Dynamics, bounds: ComponentBounds | None, look: bool) -> BlockGaussian:
    """The prior after the interval. Raises `InputError` where it is not finite.

    look: for components that have fallen apart, where there are no `bounds`, which always look
    """
    F, Q = _flat(dynamics.F), _flat(dynamics.Q)
    if bounds is None:
        x = dynamics.separated(x) if look else x
        partition = x.partition.joined(F.target, F.source)
    else:
        partition = _bounded(x, bounds, F)
    x = x.over(partition.packed)  # which keeps what little correlation there is among the nodes of a pack
    layout, at = x.layout, x.partition.block_places
    where = x.partition.label, at.start, at.size, at.offset, layout.dims, layout.offsets
    finite, mean, flat = predicted_state(
        x.mean, x.flat, *where, partition.label, *F, dynamics.b, Q.target, Q.begin, Q.values
    )
    if not finite:
        raise InputError("transition: the prediction is not finite, the dynamics grow beyond all numbers")
    return BlockGaussian(x.partition, mean, unflattened(flat, x.partition))


def _bounded(x: BlockGaussian, bounds: ComponentBounds, F: _FlatBlocks) -> Partition:
    """The components within `bounds`; blocks of F between them are inputs."""
    parts, at = x.uncorrelated(bounds.tolerance), x.partition.block_places
    strength = tie_strengths(x.flat, at.start, at.size, at.offset, x.layout.dims, parts.label, *F)
    strong = (strength > bounds.tolerance).nonzero()[0]
    strong = strong[np.argsort(-strength[strong], kind="stable")]
    return parts.joined_up_to(parts.label[F.target[strong]], parts.label[F.source[strong]], bounds.most)


def corrected(x: BlockGaussian, seen: LinearisedMeasurements) -> tuple[BlockGaussian, float]:
    """The posterior and the log-likelihood of the innovation. Raises `InputError` as `correction.correct` does."""
    at, offsets = x.partition.block_places, x.layout.offsets
    where = at.start, at.size, at.offset, offsets, at.first, at.places
    definite, mean, flat, log_likelihood = corrected_state(x.mean, x.flat, *where, *seen, CANCELLATION)
    if not definite:
        raise lost_in_rounding(x.variances().max())
    return BlockGaussian(x.partition, mean, unflattened(flat, x.partition)), log_likelihood


def _flat(groups: Sequence[Blocks]) -> _FlatBlocks:
    if len(groups) == 1:
        return _FlatBlocks(groups[0].target, groups[0].source, *_values(groups[0], 0))
    if len(groups) == 0:
        none = np.empty(0, dtype=np.int64)
        return _FlatBlocks(none, none, none, np.empty(0))
    sizes = np.cumsum([0, *(group.values.size for group in groups)]).tolist()
    columns = [(group.target, group.source, *_values(group, at)) for group, at in zip(groups, sizes[:-1], strict=True)]
    return _FlatBlocks(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def _values(group: Blocks, begin: int) -> tuple[IntArray, FloatArray]:
    m, d_i, d_j = group.values.shape
    return np.arange(begin, begin + m * d_i * d_j, d_i * d_j), group.values.ravel()
