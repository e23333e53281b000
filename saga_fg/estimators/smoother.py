r"""Smoothing of a recording: every state given all measurements, in memory that need not grow with its length.

    filter      N(m, P) given what was measured until then      m' = F m + b,  P' = F P F^T + Q: prior of the next epoch
    smoother    m <- m + G (s - m'),  P <- P + G (S - P') G^T   G = P F^T P'^-1,  N(s, S) the smoothed next epoch

(Rauch, Tung and Striebel 1965), by components: what is uncorrelated when it is filtered may be joined by a later
interaction, and is then correlated given the future. Marginals of single nodes need no more than the blocks over the
components of the next prior. (Where a component is taken apart in between, what had decayed to the last digit is lost.)
A node that leaves after an epoch is a source of nothing, and still learns through its neighbours of before.

What may still be measured after the last epoch T moves x_T by d ~ N(0, D), D <= P_T, and an earlier epoch by the
product of all G from there to T: with a covariance of at most C <- G C G^T, from C = P_T. Epochs are final when

    5 s <= tolerance        for every component of this epoch and of all before it, s the square roots of diag C

They are those of the whole recording to the tolerance, whatever the memory of a graph is: an object in view settles in
a second or two, a hidden one when it is seen again, or has left.

The filter's pass is read from its end. A step takes the square of its components, so that not all are kept of many: the
priors of a few stretches are found first, and each stretch is filtered again when its turn comes, itself in stretches
if need be, with the same result to the last digit. Where something is nonlinear, it is linearised at the
smoothed means until these stand still (Bell, The iterated Kalman smoother as a Gauss-Newton method, SIAM J.
Optimization 4, 1994).
"""

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import tee

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.filtering import ComponentBounds, Dynamics, Measurements, Observations, corrected, predict
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.partition import BlockDiagonal, BlockGaussian, Partition, StateLayout, checked_prior, regrouped
from saga_fg.model import Transition
from saga_fg.numerics import FloatArray, IntArray

log = logging.getLogger(__name__)

MOST_KEPT = 200_000_000  # bytes of the filter's pass
_PARTS = 4  # stretches
_SURE = 5.0  # standard deviations
STEP = 5.0  # s between two searches for final epochs
TOLERANCE = 1e-3  # largest difference of a final mean from the whole recording's, m (m/s, ...)
LONGEST = 60.0  # s, older epochs are final in any case; bounds the memory
_MAX_LINEARISATIONS = 100
_STANDS_STILL = 1e-9  # largest step of a mean, standard deviations


@dataclass(frozen=True, eq=False)
class SmoothedState:
    """Gaussian of an epoch's nodes given all measurements; the nodes that leave after it are among them.

    time (s, on the estimator's clock); of a recording the marginals of single nodes, without their correlations
    """

    time: float
    x: BlockGaussian

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        return self.x.layout.nodes

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d."""
        return self.x.means_of(nodes)

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) marginal covariances of nodes of equal size d."""
        return self.x.covariances_of(nodes)


@dataclass(eq=False)
class _Epoch:
    """The input at a time, s: new nodes with their priors, measurements, nodes that leave; the interval after it."""

    time: float
    new: list[tuple[IntArray, FloatArray, FloatArray]] = field(default_factory=list)
    measured: list[Measurements | Observations] = field(default_factory=list)
    leaving: list[int] = field(default_factory=list)
    interval: IntervalDynamics | None = None

    @property
    def linear(self) -> bool:
        """True where linearising it again elsewhere changes nothing."""
        return (self.interval is None or self.interval.linear) and all(one.linear for one in self.measured)


@dataclass(frozen=True, eq=False)
class _Step:
    """The filter at an epoch: x of all its nodes, dynamics of those that stay, their prior at the next epoch."""

    x: BlockGaussian
    dynamics: Dynamics | None
    prior: BlockGaussian

    @property
    def size(self) -> int:
        """Bytes of its covariances."""
        return sum(P.nbytes for P in (*self.x.blocks, *self.prior.blocks))

    @cached_property
    def _places(self) -> tuple[Partition, IntArray]:
        """The components in which the prior after it looks back, and the rows (n,) in the prior, -1 for who leaves."""
        layout, prior = self.x.layout, self.prior.partition
        if len(prior.layout) == len(layout):
            return prior, np.arange(len(layout))
        stay, first = layout.rows(prior.layout.nodes), np.unique(prior.label, return_index=True)[1]
        rows = np.full(len(layout), -1)
        rows[stay] = np.arange(len(stay))
        return self.x.decoupled().partition.joined(stay, stay[first[prior.label]]), rows

    @cached_property
    def _gain(self) -> tuple[FloatArray, ...]:
        """G (c, s, s) of each group of components. Those that leave stand beside, with variance 1, and learn none."""
        (partition, rows), dynamics = self._places, self.dynamics
        assert dynamics is not None
        layout, stay, gains = self.x.layout, np.flatnonzero(rows >= 0), []
        x, after = self.x.over(partition), self._widened(self.prior.blocks)
        gone = np.ones(layout.size)
        gone[layout.places(stay)] = 0.0
        for number, places in enumerate(partition.groups):
            F, P = np.zeros_like(after[number]), after[number]
            for group in dynamics.F:
                target, source = stay[group.target], stay[group.source]
                mine = np.flatnonzero(partition.group[target] == number)
                target, source, (_, d_i, d_j) = target[mine], source[mine], group.values.shape
                i = partition.offset[target][:, None, None] + np.arange(d_i)[:, None]
                j = partition.offset[source][:, None, None] + np.arange(d_j)
                F[partition.row[target][:, None, None], i, j] = group.values[mine]
            if len(stay) < len(layout):
                P = P + gone[places][:, :, None] * np.eye(P.shape[1])
            gains.append(np.swapaxes(np.linalg.solve(P, F @ x.blocks[number]), 1, 2))
        return tuple(gains)

    def _widened(self, blocks: BlockDiagonal) -> BlockDiagonal:
        """Blocks over the components of the prior, with zeros for those that leave."""
        partition, rows = self._places
        return blocks if partition is self.prior.partition else regrouped(blocks, self.prior.partition, partition, rows)

    def pulled_back(self, d: FloatArray, D: BlockDiagonal) -> tuple[BlockGaussian, BlockGaussian]:
        """The filter's Gaussian by the components of the prior after it, and N(G d, G D G^T) over these.

        d, D: at the next epoch, of the nodes that stay, by the components of the prior there
        """
        (partition, rows), layout = self._places, self.x.layout
        difference, mean, changed = np.zeros(layout.size), np.empty(layout.size), []
        difference[layout.places(np.flatnonzero(rows >= 0))] = d
        for places, G, block in zip(partition.groups, self._gain, self._widened(D), strict=True):
            mean[places] = (G @ difference[places][:, :, None])[:, :, 0]
            product = G @ block @ np.swapaxes(G, 1, 2)
            changed.append((product + np.swapaxes(product, 1, 2)) / 2)
        return self.x.over(partition), BlockGaussian(partition, mean, tuple(changed))


class RecordingSmoother:
    """Takes in a recording, and gives out smoothed epochs, oldest first, each once.

        smoother.predict(...); smoother.update(...); for epoch in smoother.final(): ...   # with `windowed`
        for epoch in smoother.finish(): ...                                       # after the last measurement

    windowed      whether epochs are given out by `final`, as soon as nothing that is measured later moves them any more
                  by `TOLERANCE`; else all wait for `finish`
    max_component largest number of nodes that are smoothed jointly: where more are connected, the weakest interactions
                  take over the neighbour's mean and variance only; None: any number, exact

    The methods that take something in are those of `saga_fg.estimators.Estimator`; measurements come in the order of
    time.
    """

    def __init__(self, windowed: bool = False, max_component: int | None = None) -> None:
        if max_component is not None and (isinstance(max_component, bool) or max_component < 1):
            raise InputError(f"max_component: expected a whole number of nodes >= 1, got {max_component!r}")
        self._most, self._next_look = max_component, STEP if windowed else math.inf
        self._prior, self._epochs, self._layout = BlockGaussian.empty(), [_Epoch(0.0)], StateLayout()
        self._means: list[FloatArray] = []  # where what is nonlinear is linearised
        self.bound = 0.0
        """Largest change that later measurements could make to final epochs; `LONGEST` forces it above `TOLERANCE`."""

    @property
    def time(self) -> float:
        """Time of the newest epoch: the sum of all intervals, s."""
        return self._epochs[-1].time

    @property
    def nodes(self) -> IntArray:
        """(n,) ids of the present nodes."""
        return self._layout.nodes

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        """Add nodes independent of all others: ids (k,), means (k, d), covariances (k, d, d)."""
        mean, covariance = checked_prior(nodes, means, covariances)
        if left := set(np.asarray(nodes).tolist()) & set(self._epochs[-1].leaving):
            raise InputError(f"node {min(left)} leaves at this time, and can come back after the next prediction")
        layout = self._layout.extended(nodes, mean.shape[1])
        self._epochs[-1].new.append((layout.nodes[len(self._layout) :], mean, covariance))
        self._layout = layout

    def predict(self, transition: Transition) -> None:
        """Begin an epoch: move all nodes by a transition over exactly the present ones."""
        Dynamics.of(transition, self._layout)  # which checks it
        self._epochs[-1].interval = IntervalDynamics(transition)
        self._epochs.append(_Epoch(self.time + transition.dt))

    def update(self, measured: Measurements | Observations) -> None:
        """Take in measurements of the newest epoch."""
        if len(measured.rows(self._layout)):
            self._epochs[-1].measured.append(measured)

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes leave after this epoch; their information on their neighbours stays."""
        rows = self._layout.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        self._epochs[-1].leaving += self._layout.nodes[rows].tolist()
        self._layout = self._layout.without(rows)

    def final(self) -> list[SmoothedState]:
        """Epochs that have become final, with the covariances of their nodes: none most of the time."""
        if self.time < self._next_look:
            return []
        self._next_look = self.time + STEP
        times = [epoch.time for epoch in self._epochs]
        settled = newest = len(times) - 1  # epochs before `settled` are final, and those before `forced`
        forced = min(int(np.searchsorted(times, self.time - LONGEST)), newest)
        states, influence = list[SmoothedState](), list[float]()
        steps, *copies = tee(self._steps_backwards(), 3)
        for step, x, moved in zip(steps, _smoothed(copies[0]), _influence(copies[1]), strict=True):
            k = newest - len(states)
            if k + 1 == settled:
                after_settled = step.prior
            if k + 1 == forced:
                after_forced = step.prior
            states.append(self._state(k, x))
            influence.append(_SURE * float(np.sqrt(moved.variances().max(initial=0.0))))
            settled = k if influence[-1] > TOLERANCE else settled
        count = max(settled, forced)
        if count:
            self._prior = after_settled if settled >= forced else after_forced
            self.bound = max(self.bound, *influence[::-1][:count])
        del self._epochs[:count], self._means[:count]
        return states[::-1][:count]

    def finish(self) -> list[SmoothedState]:
        """All epochs that are left. Nothing can be taken in afterwards."""
        numbers = range(len(self._epochs) - 1, -1, -1)
        states = [self._state(k, x) for k, x in zip(numbers, _smoothed(self._steps_backwards()), strict=True)]
        del self._epochs[:]
        return states[::-1]

    def _state(self, k: int, x: BlockGaussian) -> SmoothedState:
        """The marginals of an epoch."""
        return SmoothedState(self._epochs[k].time, x.over(Partition.apart(x.layout)))

    def _steps_backwards(self) -> Iterator[_Step]:
        """The filter's pass from the last epoch to the first, linearised where it should be."""
        if all(epoch.linear for epoch in self._epochs):
            return _filtered_backwards(self._prior, self._epochs, self._most)
        means: list[FloatArray] = []
        for _ in range(_MAX_LINEARISATIONS):
            steps = list(_filtered(self._prior, self._epochs, self._most, means))
            found = [x.mean for x in _smoothed(reversed(steps))][::-1]
            sigma = [np.sqrt(step.x.variances()) for step in steps]
            moved = (np.abs(x - at) / s for x, at, s in zip(found, means, sigma, strict=False))
            if means and max(part.max(initial=0.0) for part in moved) <= _STANDS_STILL:
                break
            means = found
        else:
            log.warning("no convergence in %d linearisations", _MAX_LINEARISATIONS)
        self._means = means
        return reversed(steps)


def _filtered(
    prior: BlockGaussian, epochs: Sequence[_Epoch], most: int | None, means: Sequence[FloatArray] = ()
) -> Iterator[_Step]:
    """The filter's pass over epochs, linearised at joint states `means` if given.

    Where a component would have more nodes than `most`, those that come last are inputs (see
    `saga_fg.estimators.filtering`), so that what is filtered, and smoothed, is exact for another linear model.
    """
    for k, epoch in enumerate(epochs):
        x = prior
        for nodes, mean, covariance in epoch.new:
            x = x.extended(x.layout.extended(nodes, mean.shape[1]), mean, covariance)
        for measured in epoch.measured:
            x, _ = corrected(x, measured.linearised(x.layout, means[k] if means else x.mean))
        if epoch.interval is None:
            yield _Step(x, None, x)
            return
        stay = x.without(x.layout.rows(epoch.leaving))
        at = means[k][x.layout.places(x.layout.rows(stay.layout.nodes))] if means else stay.mean
        dynamics = epoch.interval.linearised(stay.layout, at)
        partition = dynamics.joined(stay.partition)
        if most is not None and np.bincount(partition.label).max(initial=0) > most:
            partition = ComponentBounds(0.0, most).components(stay, dynamics)
            prior = predict(stay, dynamics, partition)
            dynamics = dynamics.within(partition)
        else:
            prior = predict(dynamics.separated(stay), dynamics)
        yield _Step(x, dynamics, prior)


def _filtered_backwards(prior: BlockGaussian, epochs: Sequence[_Epoch], most: int | None) -> Iterator[_Step]:
    """The filter's pass from the last epoch to the first, keeping about `MOST_KEPT` bytes and a few priors."""
    steps, size = list[_Step](), 0
    for step in _filtered(prior, epochs, most):
        steps.append(step)
        size += step.size
        if size > MOST_KEPT and len(epochs) > 1:
            break
    else:
        while steps:
            yield steps.pop()
        return
    steps.clear()
    length = math.ceil(len(epochs) / _PARTS)
    begins, priors = range(0, len(epochs), length), [prior]
    for k, step in enumerate(_filtered(prior, epochs[: begins[-1]], most), 1):
        if k in begins:
            priors.append(step.prior)
    for begin in reversed(begins):
        yield from _filtered_backwards(priors.pop(), epochs[begin : begin + length], most)


def _smoothed(steps: Iterable[_Step]) -> Iterator[BlockGaussian]:
    """The Gaussian of every epoch given all measurements, from the last to the first, as the steps are."""
    later: BlockGaussian | None = None
    for step in steps:
        if later is None:
            later = step.x
        else:
            later, prior = _carried(later, step.prior), step.prior
            difference = tuple(S - P for S, P in zip(later.blocks, prior.blocks, strict=True))
            x, change = step.pulled_back(later.mean - prior.mean, difference)
            blocks = tuple(P + D for P, D in zip(x.blocks, change.blocks, strict=True))
            later = BlockGaussian(x.partition, x.mean + change.mean, blocks)
        yield later


def _influence(steps: Iterable[_Step]) -> Iterator[BlockGaussian]:
    """Bounds on how far later measurements can move the smoothed means of each epoch, from the last on."""
    later: BlockGaussian | None = None
    for step in steps:
        if later is None:
            later = step.x
        else:
            later = _carried(later, step.prior)
            _, later = step.pulled_back(later.mean, later.blocks)
        yield later


def _carried(later: BlockGaussian, prior: BlockGaussian) -> BlockGaussian:
    """The Gaussian of an epoch over those nodes that have come from the epoch before, and their components."""
    return later.without(np.arange(len(prior.layout), len(later.layout))).over(prior.partition)
