"""Correction of a joint state by components, and the steps of the joint Kalman filter.

    S = H P H^T + R = L L^T     W = L^-1 H P     m <- m + W^T L^-1 (z - H m)     P <- P - W^T W

All components of one size take one batched operation. Where a measurement is so much better than what was known
(a millionfold in variance) that P - W^T W cancels, one refinement with K = W^T L^-1 restores what must hold,
H P = R K^T, so that the measured rows are as exact as in Joseph's form.

The steps of the joint Kalman filter, by the kernels of `saga_fg.kernels.filtering`.

Components are worked on one after the other, and so are measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import ComponentBounds, Dynamics
from saga_fg.estimators.measurements import LinearisedMeasurements
from saga_fg.estimators.partition import Partition, unflattened
from saga_fg.kernels.filtering import corrected_state, predicted_state, tie_strengths
from saga_fg.model.discretisation import Blocks
from saga_fg.numerics.arrays import FloatArray, IntArray

CANCELLATION = 1e-6  # ratio of variances after and before below which a correction is refined
_BATCHED_BELOW = 10  # size from which a triangular system is worth a call of its own


@dataclass(frozen=True, eq=False)
class Gain:
    """A correction of c components of equal size s with up to a measured values each (rows of zeros fill up).

    places (c, s) of the components; H (c, a, s); L (c, a, a) lower triangular, L L^T = S; W (c, a, s) = L^-1 H P;
    whitened (c, a) = L^-1 (z - H m)
    """

    places: IntArray
    H: FloatArray
    L: FloatArray
    W: FloatArray
    whitened: FloatArray


def correct(
    x: BlockGaussian, rows: IntArray, z: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[BlockGaussian, tuple[Gain, ...], float]:
    """Return the posterior, the gains, and the log-likelihood of the innovation.

    rows (m,) of the measured nodes, may repeat; z (m, k); H (m, k, d); R (m, k, k) positive definite. Raises
    `InputError` where a covariance has grown so large that R no longer counts among its digits.
    """
    gains: list[Gain] = []
    posterior, misfit = _posterior(x, _stacks(x, rows, z, H, R), gains.append)
    return posterior, tuple(gains), -0.5 * z.size * math.log(2 * math.pi) - misfit


class WhitenedFactor(NamedTuple):
    """|| H x - z || of several nodes: rows (k,) of these, H (m, D') over their states, innovation (m,) z - H m."""

    rows: IntArray
    H: FloatArray
    innovation: FloatArray


def correct_whitened(x: BlockGaussian, factors: Sequence[WhitenedFactor]) -> BlockGaussian:
    """Return the posterior given factors on any nodes, whose components become one; noise of variance 1."""
    if not factors:
        return x
    ties = [np.array([[factor.rows[0], row] for row in factor.rows[1:]]).reshape(-1, 2) for factor in factors]
    x = x.over(x.partition.joined(*np.concatenate(ties).astype(np.int64).T))
    return _posterior(x, _factor_stacks(x, factors))[0]


class _Stacked(NamedTuple):
    """Measurements of c components of equal size s, a values each (rows of zeros fill up).

    number: of their group; active: their rows in it; places (c, s); P (c, s, s); H_P, H (c, a, s); R (c, a, a);
    innovation (c, a, 1)
    """

    number: int
    active: IntArray | slice
    places: IntArray
    P: FloatArray
    H_P: FloatArray
    H: FloatArray
    R: FloatArray
    innovation: FloatArray


def _posterior(
    x: BlockGaussian, stacks: Iterable[_Stacked], keep: Callable[[Gain], None] | None = None
) -> tuple[BlockGaussian, float]:
    """Correct components, each of which is in one stack at most, and `keep` the gains.

    Returns also -log of the density of the innovations, but for its constant.
    """
    mean, blocks, misfit = x.mean.copy(), list(x.blocks), 0.0
    for stacked in stacks:
        gain, P = _correct(stacked)
        misfit += _half_mahalanobis(gain.L, gain.whitened)
        mean[gain.places] += (np.swapaxes(gain.W, 1, 2) @ gain.whitened[:, :, None])[:, :, 0]
        number = stacked.number
        if isinstance(stacked.active, slice):  # all of the group
            blocks[number] = P
        else:
            if blocks[number] is x.blocks[number]:
                blocks[number] = blocks[number].copy()
            blocks[number][stacked.active] = P
        if keep is not None:
            keep(gain)
    return replace(x, mean=mean, blocks=tuple(blocks)), misfit


def _half_mahalanobis(L: FloatArray, whitened: FloatArray) -> float:
    """-log of the Gaussian density of innovations with covariance L L^T, but for its constant."""
    return 0.5 * float(np.vdot(whitened, whitened) + 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum())


def _stacks(x: BlockGaussian, rows: IntArray, z: FloatArray, H: FloatArray, R: FloatArray) -> Iterator[_Stacked]:
    """Stack the measurements of each group of components, of `most` entries at once."""
    partition, mean, (k, d) = x.partition, x.mean, H.shape[1:]
    for number, members, at in partition.members(rows, d):
        component, places = partition.row[rows[members]], partition.groups[number]
        measured = np.flatnonzero(np.bincount(component, minlength=len(places)))
        active: IntArray | slice = slice(None)
        if len(measured) < len(places):
            component, active = np.searchsorted(measured, component), measured
        P, places = x.blocks[number][active], places[active]
        H_own = H[members]
        c, s = places.shape
        slot = rank(component)  # of a measurement among those of its component
        deep = int(slot.max()) + 1
        H_P, H_all, innovation = np.zeros((c, deep, k, s)), np.zeros((c, deep, k, s)), np.zeros((c, deep, k))
        R_all = np.zeros((c, deep, k, deep, k))
        H_P[component, slot] = H_own @ P[component[:, None], at]
        if s % d == 0 and not (at[:, 0] % d).any():  # states of equal size: node by node
            H_all.reshape(c, deep, k, s // d, d)[component, slot, :, at[:, 0] // d, :] = H_own
        else:
            H_all[component[:, None, None], slot[:, None, None], np.arange(k)[:, None], at[:, None, :]] = H_own
        R_all[component, slot, :, slot, :] = R[members]
        expected = H_own @ mean[places[component[:, None], at]][:, :, None]
        innovation[component, slot] = z[members] - expected[:, :, 0]
        if len(component) < c * deep:
            empty = np.ones((c, deep), dtype=bool)
            empty[component, slot] = False
            i, j = np.nonzero(empty)
            R_all[i, j, :, j, :] = np.eye(k)
        a = deep * k
        stacked = H_P.reshape(c, a, s), H_all.reshape(c, a, s), R_all.reshape(c, a, a), innovation.reshape(c, a, 1)
        yield _Stacked(number, active, places, P, *stacked)


def _factor_stacks(x: BlockGaussian, factors: Sequence[WhitenedFactor]) -> Iterator[_Stacked]:
    """Stack factors of which each is on one component."""
    partition = x.partition
    first = np.array([factor.rows[0] for factor in factors])
    for number in np.unique(partition.group[first]).tolist():
        mine = np.flatnonzero(partition.group[first] == number)
        active, component = np.unique(partition.row[first[mine]], return_inverse=True)
        lengths = np.array([len(factors[k].innovation) for k in mine.tolist()])
        most = int(np.bincount(component, weights=lengths).max())
        P, places, used = x.blocks[number][active], partition.groups[number][active], [0] * len(active)
        H, innovation = np.zeros((len(active), most, P.shape[1])), np.zeros((len(active), most, 1))
        for k, c in zip(mine.tolist(), component.tolist(), strict=True):
            factor, at = factors[k], slice(used[c], used[c] + len(factors[k].innovation))
            within = [np.arange(x.layout.dims[row]) + partition.offset[row] for row in factor.rows]
            H[c][at, np.concatenate(within)] = factor.H
            innovation[c, at, 0], used[c] = factor.innovation, at.stop
        R = np.broadcast_to(np.eye(most), (len(active), most, most))
        yield _Stacked(number, active, places, P, H @ P, H, R, innovation)


def _innovation_root(stacked: _Stacked) -> FloatArray:
    """L (c, a, a) of S = H P H^T + R = L L^T."""
    S = stacked.H_P @ np.swapaxes(stacked.H, 1, 2) + stacked.R
    try:
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)  # reads the lower triangle alone
    except np.linalg.LinAlgError:
        raise lost_in_rounding(S.max()) from None


def lost_in_rounding(variance: float) -> InputError:
    """The error of a correction whose R no longer counts among the digits of a `variance`."""
    return InputError(
        f"measurements: their noise is lost in the rounding of what is predicted, variances up to {variance:.3g}"
    )


def _correct(stacked: _Stacked) -> tuple[Gain, FloatArray]:
    """Gain and posterior covariance (c, s, s)."""
    P, L = stacked.P, _innovation_root(stacked)
    solved = solve_lower(L, np.concatenate([stacked.H_P, stacked.innovation], axis=2))
    gain = Gain(stacked.places, stacked.H, L, solved[:, :, :-1], solved[:, :, -1])
    posterior = np.swapaxes(gain.W, 1, 2) @ gain.W
    np.subtract(P, posterior, out=posterior)
    after, before = (np.diagonal(array, axis1=1, axis2=2) for array in (posterior, P))
    lost = (after < CANCELLATION * before).any(axis=1)
    if lost.any():
        K_T = solve_lower(L[lost], gain.W[lost], transposed=True)
        H, R = stacked.H[lost], stacked.R[lost]
        refined = posterior[lost] + np.swapaxes(K_T, 1, 2) @ (R @ K_T - H @ posterior[lost])
        posterior[lost] = (refined + np.swapaxes(refined, 1, 2)) / 2
    return gain, posterior


def solve_lower(L: FloatArray, B: FloatArray, transposed: bool = False) -> FloatArray:
    """Solve L X = B, or L^T X = B, for a stack of lower triangular L (c, a, a) and B (c, a, b)."""
    if L.shape[1] < _BATCHED_BELOW:
        return np.asarray(np.linalg.solve(np.swapaxes(L, 1, 2) if transposed else L, B), dtype=np.float64)
    solved = np.array(B, order="C")
    for factor, X in zip(L, solved, strict=True):  # X^T L^T = B^T, as columns are contiguous to BLAS
        X[:] = scipy.linalg.blas.dtrsm(1.0, factor.T, X.T, side=1, lower=0, trans_a=int(transposed), overwrite_b=1).T
    return solved


def rank(label: IntArray) -> IntArray:
    """Running number of each entry among those of equal label."""
    order = np.argsort(label, kind="stable")
    ordered = label[order]
    rank = np.empty(len(label), dtype=np.int64)
    rank[order] = np.arange(len(label)) - np.searchsorted(ordered, ordered)
    return rank


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
