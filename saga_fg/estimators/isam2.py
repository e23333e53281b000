r"""The filter as an incremental factor graph: `gtsam.ISAM2` with interaction factors, the past marginalised.

Every interval adds variables for the new states and the interaction factors that lead to them; measurements add
detection factors, with which the tree is updated; then the old variables are marginalised, so that the graph always
holds one epoch and cost and memory of a frame do not grow. The variables are those of
`saga_fg.estimators.block_variables`.

A node that is correlated with no other has nothing to be solved jointly: such nodes are filtered all at once by
covariances, and the tree has the components of several nodes. It is eliminated once for the measurements that come
together, with the intervals before them: what is predicted is read before that, by covariances, P <- F P F^T + Q, from
the posterior that the tree has given. Then it gives the means and covariances of the components that were measured;
those of others have not changed.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of
variance P costs Cholesky elimination log10(P/Q) digits, QR half as many. So small components are eliminated by QR,
large ones by Cholesky while that leaves enough digits. Components that an interval would leave fewer (Q singular, or
many million times smaller than P), and those that have come apart, begin anew: the prediction is their prior. So does
the whole tree after several intervals without measurements, which are chained by covariances, and where GTSAM refuses
an update, which is then done by covariances, counted and warned of.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import smoothed_means
from saga_fg.estimators.bayes_tree import BayesTree
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.block_variables import first_nodes
from saga_fg.estimators.dynamics import Dynamics, noise_ratio
from saga_fg.estimators.epoch import Epoch, NewNodes
from saga_fg.estimators.filter_pass import filter_epochs
from saga_fg.estimators.filter_steps import corrected, predicted
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.layout import StateLayout, checked_prior
from saga_fg.estimators.measurements import Observations, RecordedMeasurements, WhitenedMeasurements, whitened
from saga_fg.estimators.object_factors import recording_graph
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.protocol import LatestMarginals, Measurements, live_rows
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import BoolArray, IntArray

log = logging.getLogger(__name__)

_SMALL = 64  # size of the largest component up to which QR costs no more than Cholesky
_CHOLESKY_LIMIT = 1e6  # trace of Q^-1 P up to which Cholesky elimination is exact enough, P predicted
_QR_LIMIT = 1e11


@dataclass(frozen=True, eq=False)
class IncrementalState:
    """The filter as a value: its Gaussian; the last interval, with the Gaussian before it, for `graph()`; refusals."""

    x: BlockGaussian
    before: BlockGaussian
    epochs: tuple[Epoch, ...]
    refusals: int


@dataclass(frozen=True, eq=False)
class _State:
    """The state of the filter.

    live    the present nodes
    tree    iSAM2, with what its next update takes in; None where it has to begin anew
    x       the Gaussian of the nodes, with those that leave after this epoch
    before  the Gaussian before the `epochs`: the last interval, and the present
    refusals  number of times that GTSAM's arithmetic has failed
    """

    live: StateLayout
    tree: BayesTree | None
    x: BlockGaussian
    before: BlockGaussian
    epochs: tuple[Epoch, ...]
    refusals: int

    @property
    def newest(self) -> Epoch:
        return self.epochs[-1]

    def with_newest(self, epoch: Epoch) -> tuple[Epoch, ...]:
        """The epochs with `epoch` in the place of the newest."""
        return (*self.epochs[:-1], epoch)


class IncrementalFilter(LatestMarginals):
    """The exact filter, by `gtsam.ISAM2`. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def __init__(self) -> None:
        self._state: _State
        self.restore(IncrementalState(BlockGaussian.empty(), BlockGaussian.empty(), (Epoch(0.0),), 0))

    def __copy__(self) -> IncrementalFilter:
        twin = object.__new__(IncrementalFilter)
        twin._state = self._state  # never changed, and GTSAM's tree is that of the first to be corrected
        return twin

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (), self.snapshot()

    @property
    def nodes(self) -> IntArray:
        return self._state.live.nodes

    @property
    def time(self) -> float:
        return self._state.newest.time

    @property
    def refusals(self) -> int:
        """Number of times that GTSAM's arithmetic has failed: covariances gave the estimate, the tree began anew."""
        return self._state.refusals

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        state = self._state
        live = state.live.extended(nodes, mean.shape[1])
        added = live.nodes[len(state.live) :]
        if len(added) == 0:
            return
        if np.isin(added, state.newest.leaving).any():  # removed and added at the same time
            state = _moved(state, ZeroInterval())
        x = state.x.extended(state.x.layout.extended(added, mean.shape[1]), mean, covariance)
        new = NewNodes(added, mean, covariance)
        epochs = state.with_newest(replace(state.newest, new_nodes=(*state.newest.new_nodes, new)))
        tree = None if state.tree is None else state.tree.with_new_nodes(x)
        self._state = replace(state, live=live, tree=tree, x=x, epochs=epochs)

    def predict(self, transition: Transition) -> None:
        interval = IntervalDynamics(transition)
        interval.check(self._state.live)
        state = self._state
        if transition.dt == 0 and interval.linearised(state.live, np.zeros(state.live.size)).unchanged.all():
            return
        self._state = _moved(state, interval)

    def update(self, *measurements: Measurements | Observations) -> float:
        """Take in measurements, several kinds of them by one update of the tree."""
        kinds = [RecordedMeasurements(each) for each in measurements]
        for recorded in kinds:
            recorded.check(self._state.live)
        kinds = [recorded for recorded in kinds if len(recorded.measured)]
        if not kinds:
            return 0.0
        state, white, log_likelihood = self._state, list[WhitenedMeasurements](), 0.0
        by_covariance = state.x
        for recorded in kinds:
            linear = recorded.linearised(state.x.layout, by_covariance.mean)
            by_covariance, likelihood = corrected(by_covariance, linear)
            log_likelihood += likelihood
            white.append(whitened(linear))
        tree, x, refusals = _corrected(state, white, by_covariance)
        epochs = state.with_newest(replace(state.newest, measurements=(*state.newest.measurements, *kinds)))
        self._state = replace(state, tree=tree, x=x, epochs=epochs, refusals=refusals)
        return log_likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        state = self._state
        rows = state.live.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        leaving = (*state.newest.leaving, *state.live.nodes[rows].tolist())
        self._state = replace(
            state, live=state.live.without(rows), epochs=state.with_newest(replace(state.newest, leaving=leaving))
        )

    def posterior(self) -> BlockGaussian:
        """Posterior of the present nodes, and perhaps of some that have just left."""
        return self._state.x

    def graph(self) -> SceneFactorGraph:
        """The last interval: the posterior before it as prior, its factors, and all measurements since."""
        state = self._state
        steps = filter_epochs(state.before, list(state.epochs))
        means = [*smoothed_means(reversed(steps))[:-1], state.x.mean]
        return recording_graph(state.before, state.epochs, [step.layout for step in steps], means)

    def snapshot(self) -> IncrementalState:
        """The whole state as a value. The filter itself restarts from it, so that both go on to the same bits."""
        now = self._state
        state = IncrementalState(now.x, now.before, now.epochs, now.refusals)
        self.restore(state)
        return state

    def restore(self, state: IncrementalState) -> None:
        """Continue from a snapshot."""
        require_type("state", state, IncrementalState)
        live = state.x.layout.without(state.x.layout.rows(state.epochs[-1].leaving))
        self._state = _State(live, None, state.x, state.before, state.epochs, state.refusals)

    __setstate__ = restore

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return live_rows(self._state.x, self._state.live, nodes)


def _corrected(
    state: _State, white: Sequence[WhitenedMeasurements], by_covariance: BlockGaussian
) -> tuple[BayesTree | None, BlockGaussian, int]:
    """The tree, its posterior and refusals; where GTSAM's arithmetic fails, that by covariances without a tree."""
    try:
        tree = state.tree
        if tree is None or not tree.is_current:
            tree = BayesTree.begun(state.x, qr=_largest(state.x.partition) <= _SMALL)
        return *tree.corrected(by_covariance, white), state.refusals
    except (RuntimeError, np.linalg.LinAlgError) as error:
        return None, by_covariance, _refused(state, error)


def _moved(state: _State, interval: IntervalDynamics | ZeroInterval) -> _State:
    """Move over an interval: by covariances, and in the tree by interaction factors that its next update takes in."""
    stay = state.x.without(state.x.layout.rows(state.newest.leaving))
    dynamics = interval.linearised(stay.layout, stay.mean)
    apart = dynamics.separated(stay)
    x = predicted(apart, dynamics, None, False).over(dynamics.joined(apart.partition))
    parts = np.bincount(stay.partition.label[first_nodes(apart.partition.label)])
    tree, refusals = _tree_moved(state, x, dynamics, separated=parts[stay.partition.label] > 1)
    then, now = state.newest.time, state.newest.time + interval.dt
    if isinstance(interval, ZeroInterval):  # nodes are exchanged, the last interval is still the last
        epochs = (*state.with_newest(replace(state.newest, interval=interval)), Epoch(now))
        return _State(stay.layout, tree, x, state.before, epochs, refusals)
    epochs = (Epoch(then, leaving=state.newest.leaving, interval=interval), Epoch(now))
    return _State(stay.layout, tree, x, state.x, epochs, refusals)


def _tree_moved(
    state: _State, x: BlockGaussian, dynamics: Dynamics, separated: BoolArray
) -> tuple[BayesTree | None, int]:
    """The tree after an interval, whose prediction is `x`, None where it has to begin anew; and refusals.

    Components whose digits factors would lose begin with a prior of their own, and so do those that have come apart:
    separated (n,).
    """
    small = _largest(x.partition) <= _SMALL
    anew = separated | (noise_ratio(x, dynamics) > (_QR_LIMIT if small else _CHOLESKY_LIMIT))
    tree = state.tree
    if tree is None or tree.leaving or tree.qr != small or anew.all():
        return None, state.refusals
    try:
        return tree.predicted(x, state.x.layout.rows(x.layout.nodes), dynamics, anew), state.refusals
    except (RuntimeError, np.linalg.LinAlgError) as error:
        return None, _refused(state, error)


def _refused(state: _State, error: Exception) -> int:
    """Count a refusal; warn of the first, the tenth, the hundredth, ..."""
    count, text = state.refusals + 1, " ".join(str(error).split())[:200]
    level = logging.WARNING if set(str(count)[1:]) <= {"0"} and str(count)[0] == "1" else logging.INFO
    log.log(level, "iSAM2 begins anew at %.3f s (refusal %d): %s", state.newest.time, count, text)
    return count


def _largest(partition: Partition) -> int:
    """Size of the largest component."""
    return max((places.shape[1] for places in partition.groups), default=0)
