"""Smoothing backwards over a filter's pass, and Gauss-Newton with Anderson acceleration by such passes.

Smoothing: from the filter's pass back to the marginals given everything (modified Bryson-Frazier smoother).

Backwards through the same interval, from r = 0 and N = 0 after the last epoch,

    smoothed    m + P r                      P - P N P              with m, P the filter's posterior of the epoch
    correction  r <- r + H^T L^-T (w - W r)  N <- A^T N A + B^T B   B = L^-1 H, A = 1 - W^T B, w = L^-1 (z - H m)
    prediction  r <- F^T r                   N <- F^T N F

It needs no inverse of a covariance, so that singular noise does no harm, and nodes that appear or go are rows that
begin or end. Sources: Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 18 (1973); Durbin
and Koopman, Time Series Analysis by State Space Methods (2012), section 4.4. It gives the marginals of Rauch, Tung
and Striebel (1965).

What may still come after the last epoch T acts on earlier ones through x_T alone, and moves it by d ~ N(0, D),
D <= P_T. So it moves the smoothed mean of an earlier epoch by P G^T P_T^-1 d, where G is the product of all A and F
from there to T (its transition to x_T, as corrections leave it), with a covariance of at most P M P, M = G^T P_T^-1 G:
the recursion of N from M = P_T^-1 instead of 0 and without the terms B^T B.

Components: what is uncorrelated when it is filtered may be joined by a later interaction, and is then correlated
given the future. So joint covariances are smoothed over components joined through all epochs. The marginals of single
nodes need no more of N than its blocks over the components of P, for P N P has no others on its diagonal, and those of
an epoch follow from those of the next: F does not leave the components that it leads to. (Where a component has been
taken apart in between, the rest of its N acts through what had decayed to `BlockGaussian.decoupled`'s last digit.)

Gauss-Newton over a recording: linearised at the smoothed means until they converge.

Source: Bell, The iterated Kalman smoother as a Gauss-Newton method, SIAM J. Optimization 4 (1994).

Anderson acceleration: x = g(x) found from fewer evaluations of g.

Iteratively reweighted least squares converges linearly, slowly where a robust loss holds many measurements down. From
the last evaluations, with f_i = g(x_i) - x_i, the next point is

    x = sum_i a_i g(x_i),     a = argmin || sum_i a_i f_i ||,  sum_i a_i = 1

Where the step grew, the memory is dropped and the plain step is taken. Source: Walker and Ni, Anderson acceleration for
fixed-point iterations, SIAM J. Numerical Analysis 49 (2011).
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian, block_product, joint_block
from saga_fg.estimators.correction import Gain, solve_lower
from saga_fg.estimators.epoch import Epoch, FilterStep, filter_epochs
from saga_fg.estimators.partition import BlockDiagonal, Partition, StateLayout, regrouped, zeros
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import setting


def smoothed_means(steps: Iterable[FilterStep]) -> list[FloatArray]:
    """Smoothed joint mean of every epoch, over all its nodes; steps: from the last to the first."""
    return list(_means_backwards(steps))[::-1]


def smoothed_marginals(steps: Iterable[FilterStep]) -> tuple[list[FloatArray], list[MarginalCovariances]]:
    """Smoothed joint mean of every epoch, and covariances of its nodes; steps: from the last to the first."""
    latest: deque[FilterStep] = deque(maxlen=1)  # for both recursions, of which the first is one step ahead

    def counted() -> Iterator[FilterStep]:
        for step in steps:
            latest.append(step)
            yield step
        latest.clear()

    def again() -> Iterator[FilterStep]:
        while latest:
            yield latest[0]

    means, covariances = [], []
    for mean, whole in zip(_means_backwards(counted()), _swept(_own(again()), False), strict=True):
        means.append(mean)
        covariances.append(MarginalCovariances.of(whole.partition.layout, whole.blocks))
    return means[::-1], covariances[::-1]


def _means_backwards(steps: Iterable[FilterStep]) -> Iterator[FloatArray]:
    """Smoothed joint mean of every epoch, from the last to the first, as the steps are."""
    after: FloatArray | None = None  # r of the next epoch, before it saw anything
    for step in steps:
        x, dynamics = step.filtered, step.dynamics
        r = np.zeros(len(x.mean))
        if after is None or dynamics is None:
            yield x.mean
        else:
            back = dynamics.transpose_times(after)
            if len(back) == len(r):
                r = back
            else:
                r[x.layout.places(x.layout.rows(dynamics.layout.nodes))] = back
            yield x.mean + block_product(x.blocks, x.partition, r)
        for gain in reversed(step.gains):
            local = r[gain.places]
            unexplained = gain.whitened - (gain.W @ local[:, :, None])[:, :, 0]
            y = solve_lower(gain.L, unexplained[:, :, None], transposed=True)
            r[gain.places] = local + (np.swapaxes(gain.H, 1, 2) @ y)[:, :, 0]
        after = r[: x.layout.offsets[step.carried]]


@dataclass(frozen=True, eq=False)
class SmoothedCovariance:
    """P - P N P of one epoch, computed where it is asked for; P and N over one partition."""

    partition: Partition
    P: BlockDiagonal
    N: BlockDiagonal

    def blocks(self, rows: IntArray) -> FloatArray:
        """(k, d, d) of the nodes at `rows`, whose states have equal size d."""
        partition = self.partition
        d = int(partition.layout.dims[rows[0]]) if len(rows) else 0
        result = np.empty((len(rows), d, d))
        for number, members, at in partition.members(rows, d):
            row = partition.row[rows[members]]
            P = self.P[number][row[:, None], at]
            if 4 * len(members) * d < len(self.P[number]) * self.P[number].shape[1]:  # a few nodes only
                P_N = P @ self.N[number][row]
            else:
                P_N = (self.P[number] @ self.N[number])[row[:, None], at]
            own = np.take_along_axis(P, at[:, None, :], axis=2)
            reduced = own - P_N @ np.swapaxes(P, 1, 2)
            result[members] = (reduced + np.swapaxes(reduced, 1, 2)) / 2
        return result

    def joint(self, rows: IntArray) -> FloatArray:
        """Joint covariance of the nodes at `rows`, in this order, of any sizes."""
        whole = tuple(P - P @ N @ P for P, N in zip(self.P, self.N, strict=True))
        whole = tuple((block + np.swapaxes(block, 1, 2)) / 2 for block in whole)
        return joint_block(whole, self.partition, rows)


@dataclass(frozen=True, eq=False)
class MarginalCovariances:
    """The covariances of single nodes of one epoch: for each size of states, its rows and blocks (k, d, d)."""

    layout: StateLayout
    own: dict[int, FloatArray]
    place: IntArray  # (n,) of each node among those of its size

    @staticmethod
    def of(layout: StateLayout, blocks: Callable[[IntArray], FloatArray]) -> MarginalCovariances:
        """Marginals of all nodes; blocks: of rows whose states have equal size."""
        own, place = {}, np.empty(len(layout), dtype=np.int64)
        for d in np.unique(layout.dims).tolist():
            rows = np.flatnonzero(layout.dims == d)
            own[d], place[rows] = blocks(rows), np.arange(len(rows))
        return MarginalCovariances(layout, own, place)

    def blocks(self, rows: IntArray) -> FloatArray:
        """(k, d, d) of the nodes at `rows`, whose states have equal size d."""
        if len(rows) == 0:
            return np.empty((0, 0, 0))
        return self.own[int(self.layout.dims[rows[0]])][self.place[rows]]

    def joint(self, rows: IntArray) -> FloatArray:
        """Raises `InputError`: joint covariances were not kept."""
        raise InputError("joint covariance: only those of single nodes were kept; ask for joint covariances")


def joint_covariances(steps: Sequence[FilterStep]) -> Iterator[SmoothedCovariance]:
    """Smoothed joint covariance of every epoch, from the last to the first; steps: from the first to the last."""
    return _swept(zip(reversed(steps), reversed(joined_partitions(steps)), strict=True), future_known=False)


def future_influence(steps: Iterable[FilterStep]) -> Iterator[FloatArray]:
    """For every epoch from the last to the first: (D,) standard deviations, of each component of its joint state.

    Nothing that is measured after the last epoch can be expected to move a smoothed mean by more. steps: from the last
    to the first
    """
    for reduced in _swept(_own(steps), future_known=True):
        variance: FloatArray = np.empty(reduced.partition.layout.size)
        for places, P, M in zip(reduced.partition.groups, reduced.P, reduced.N, strict=True):
            variance[places] = ((P @ M) * P).sum(axis=2)
        yield np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _own(steps: Iterable[FilterStep]) -> Iterator[tuple[FilterStep, Partition]]:
    """Every step with its components as they are filtered."""
    return ((step, step.filtered.partition) for step in steps)


def _swept(steps: Iterable[tuple[FilterStep, Partition]], future_known: bool) -> Iterator[SmoothedCovariance]:
    """N of every epoch from the last to the first, or M with `future_known`, over the partition of each."""
    after: BlockDiagonal | None = None  # N of the next epoch, before it saw anything, over the nodes carried there
    after_partition: Partition | None = None
    for step, partition in steps:
        x = step.filtered.over(partition)
        if after is not None and after_partition is not None and step.dynamics is not None:
            back = step.dynamics.pulled_back(after_partition, after)
            N = _moved(back, after_partition, partition)
        elif future_known:
            N = tuple(np.asarray(np.linalg.pinv(P, hermitian=True), dtype=np.float64) for P in x.blocks)
        else:
            N = zeros(partition)
        yield SmoothedCovariance(partition, x.blocks, N)
        for gain in reversed(step.gains):
            N = _before(gain, N, step.filtered, partition, 0.0 if future_known else 1.0)
        after_partition = partition
        if step.carried < len(partition.layout):
            carried = np.arange(step.carried)
            layout = partition.layout.select(carried)
            after_partition = partition.restricted(layout, carried)
        after = _moved(N, partition, after_partition)


def joined_partitions(steps: Sequence[FilterStep]) -> list[Partition]:
    """The components of every epoch's nodes, joined through all epochs before and after."""
    fine = [step.filtered.partition for step in steps]
    starts = np.concatenate([[0], np.cumsum([partition.count for partition in fine])]).astype(np.int64)
    a, b = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for k, step in enumerate(steps[:-1]):
        if step.dynamics is not None:
            stay = step.dynamics.layout
            rows = step.layout.rows(stay.nodes) if len(stay) < len(step.layout) else np.arange(len(stay))
            a.append(starts[k] + fine[k].label[rows])
            b.append(starts[k + 1] + fine[k + 1].label[: len(stay)])
    i, j = np.concatenate(a), np.concatenate(b)
    pairs = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), shape=(int(starts[-1]), int(starts[-1])))
    label = connected_components(pairs, directed=False)[1]
    joined = []
    for k, partition in enumerate(fine):
        own = label[starts[k] : starts[k + 1]]
        distinct, number = np.unique(own, return_inverse=True)
        same = len(distinct) == partition.count
        joined.append(partition if same else Partition(partition.layout, number.astype(np.int64)[partition.label]))
    return joined


def _moved(blocks: BlockDiagonal, old: Partition, new: Partition) -> BlockDiagonal:
    """The blocks over the nodes of another partition; zero for nodes that are only there."""
    if old is new or (
        len(old.layout) == len(new.layout)
        and (old.layout.nodes == new.layout.nodes).all()
        and (old.label == new.label).all()
    ):
        return blocks
    row = {node: row for row, node in enumerate(old.layout.nodes.tolist())}
    return regrouped(blocks, old, new, np.array([row.get(node, -1) for node in new.layout.nodes.tolist()], dtype=int))


def _before(gain: Gain, N: BlockDiagonal, x: BlockGaussian, partition: Partition, counted: float) -> BlockDiagonal:
    """N before a correction, from N after it; counted: 1 to count its information, 0 not to."""
    fine = x.partition
    node = np.searchsorted(fine.layout.offsets, gain.places[:, 0], side="right") - 1
    number, rows = int(fine.group[node[0]]), fine.row[node]
    B = solve_lower(gain.L, gain.H)
    B_T = np.swapaxes(B, 1, 2)
    if partition is fine:
        N_active = N[number][rows]
        W_N = gain.W @ N_active
        inner = W_N @ np.swapaxes(gain.W, 1, 2)
        half = B_T @ ((counted * np.eye(B.shape[1]) + inner) @ B / 2 - W_N)
        changed = N[number].copy()
        changed[rows] = N_active + half + np.swapaxes(half, 1, 2)
        return (*N[:number], changed, *N[number + 1 :])
    A = [
        np.broadcast_to(np.eye(places.shape[1]), (len(places), places.shape[1], places.shape[1]))
        for places in fine.groups
    ]
    A[number] = A[number].copy()
    A[number][rows] -= np.swapaxes(gain.W, 1, 2) @ B
    C = list(zeros(fine))
    C[number][rows] = counted * (B_T @ B)
    every = np.arange(len(fine.layout))
    A_joined, C_joined = regrouped(tuple(A), fine, partition, every), regrouped(tuple(C), fine, partition, every)
    products = (np.swapaxes(a, 1, 2) @ n @ a + c for a, n, c in zip(A_joined, N, C_joined, strict=True))
    return tuple((product + np.swapaxes(product, 1, 2)) / 2 for product in products)


_MEMORY = 6  # evaluations that are kept
_GROWTH = 2.0  # of the step, from which the memory misleads


class AndersonAcceleration:
    """The memory of an iteration."""

    def __init__(self) -> None:
        self._images: list[FloatArray] = []
        self._steps: list[FloatArray] = []

    def next(self, x: FloatArray, image: FloatArray, scale: FloatArray) -> FloatArray:
        """The point at which to evaluate next, given `image` = g(x) (D,); `scale` (D,): the unit of each entry."""
        step = (image - x) / scale
        if self._steps and np.abs(step).max(initial=0.0) > _GROWTH * np.abs(self._steps[-1]).max(initial=0.0):
            self._images, self._steps = [], []
        self._images, self._steps = [*self._images, image][-_MEMORY:], [*self._steps, step][-_MEMORY:]
        if len(self._steps) == 1:
            return image
        differences = np.diff(np.array(self._steps), axis=0).T
        gamma = np.linalg.lstsq(differences, step, rcond=1e-12)[0]
        return np.asarray(image - np.diff(np.array(self._images), axis=0).T @ gamma)


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings of Gauss-Newton over a recording."""

    max_iterations: int = setting(100, "largest number of linearisations of the whole recording")
    tolerance: float = setting(1e-9, "largest step of a mean at convergence, standard deviations")

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations: expected at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise InputError(f"tolerance: expected a positive number, got {self.tolerance}")


def relinearised(
    steps: Sequence[FilterStep], prior: BlockGaussian, epochs: Sequence[Epoch], settings: GaussNewtonSettings
) -> tuple[list[FilterStep], list[FloatArray]]:
    """The converged filter's pass and smoothed means, from a first pass."""
    means, step, iteration = smoothed_means(reversed(steps)), math.inf, AndersonAcceleration()
    ends = np.cumsum([len(mean) for mean in means])[:-1]
    for count in range(settings.max_iterations):
        found = filter_epochs(prior, epochs, means)
        solved = smoothed_means(reversed(found))
        sigma = np.sqrt(np.concatenate([step.filtered.variances() for step in found]))
        before, after = np.concatenate(means), np.concatenate(solved)
        step = float(np.max(np.abs(after - before) / sigma, initial=0.0))
        log.debug("iteration %d: largest step %.3g standard deviations", count + 1, step)
        if step <= settings.tolerance:
            break
        means = np.split(iteration.next(before, after, sigma), ends)
    else:
        log.warning("no convergence in %d iterations; last step %.2g sigma", settings.max_iterations, step)
    return found, solved
