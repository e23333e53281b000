r"""The filter as an incremental factor graph: `gtsam.ISAM2` with interaction factors, the past marginalised.

Every interval adds variables for the new states and the interaction factors that lead to them; measurements add
detection factors; then the old variables are marginalised, so that the graph always holds one epoch and cost and memory
of a frame do not grow. Means and covariances are read from the Bayes tree. The variables are those of
`saga_fg.estimators.block_variables`.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of
variance P costs Cholesky elimination log10(P/Q) digits, QR half as many. So small components are eliminated by QR,
large ones by Cholesky while that leaves enough digits, and an interval that would leave fewer (Q singular, or many
million times smaller than P) is predicted by covariances, P <- F P F^T + Q, after which iSAM2 begins anew.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import smoothed_means
from saga_fg.estimators.bayes_tree import BayesTree
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import innovation_likelihood, posterior_likelihood
from saga_fg.estimators.dynamics import Dynamics, PredictionSummary, predict
from saga_fg.estimators.epoch import Epoch, NewNodes
from saga_fg.estimators.filter_pass import filter_epochs
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.layout import StateLayout, checked_prior
from saga_fg.estimators.measurements import Observations, RecordedMeasurements, whitened
from saga_fg.estimators.object_factors import recording_graph
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.protocol import LatestMarginals, Measurements, live_rows
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import IntArray

log = logging.getLogger(__name__)

_SMALL = 64  # size of the largest component up to which QR costs no more than Cholesky
_CHOLESKY_LIMIT = 1e6  # variance predicted over process noise, up to which Cholesky elimination is exact enough
_QR_LIMIT = 1e11
_WIDE = 1e6  # variance predicted over measurement noise, from which the likelihood needs the prediction itself


@dataclass(frozen=True, eq=False)
class IncrementalState:
    """The filter as a value: the Gaussian of the present nodes, and the time, s."""

    x: BlockGaussian
    time: float


@dataclass(frozen=True, eq=False)
class _State:
    """The state of the filter.

    live    the present nodes
    tree    iSAM2, None where it has to begin anew
    x       the Gaussian of the nodes, with those that leave after this epoch; None while the tree is not updated
    before  the Gaussian before the `epochs`: the last interval, and the present
    """

    live: StateLayout
    tree: BayesTree | None
    x: BlockGaussian | None
    before: BlockGaussian
    epochs: tuple[Epoch, ...]

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
        self.restore(IncrementalState(BlockGaussian.empty(), 0.0))

    @property
    def nodes(self) -> IntArray:
        return self._state.live.nodes

    @property
    def time(self) -> float:
        return self._state.newest.time

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        state = self._state
        live = state.live.extended(nodes, mean.shape[1])
        added = live.nodes[len(state.live) :]
        if len(added) == 0:
            return
        if np.isin(added, state.newest.leaving).any():  # removed and added at the same time
            state = _moved(state, ZeroInterval())
        state, x = _solve(state)
        x = x.extended(x.layout.extended(added, mean.shape[1]), mean, covariance)
        new = NewNodes(added, mean, covariance)
        epochs = state.with_newest(replace(state.newest, new_nodes=(*state.newest.new_nodes, new)))
        tree = None if state.tree is None else state.tree.with_new_nodes(x)
        self._state = replace(state, live=live, tree=tree, x=x, epochs=epochs)

    def predict(self, transition: Transition) -> None:
        interval = IntervalDynamics(transition)
        interval.check(self._state.live)
        self._state = _moved(self._state, interval)

    def update(self, measurements: Measurements | Observations) -> float:
        recorded = RecordedMeasurements(measurements)
        recorded.check(self._state.live)
        if len(measurements) == 0:
            return 0.0
        state = self._state
        if state.x is None and _is_wide(state, recorded):
            state, _ = _solve(state)
        epochs = state.with_newest(replace(state.newest, measurements=(*state.newest.measurements, recorded)))
        if state.x is None:
            assert state.tree is not None
            prior_mean = state.tree.variables.origin
            linear = recorded.linearised(state.tree.components.layout, prior_mean)
            white = whitened(linear)
            self._state, x = _solve(replace(state, tree=state.tree.with_measurements(white), epochs=epochs))
            return posterior_likelihood(x, prior_mean, *white)
        linear = recorded.linearised(state.x.layout, state.x.mean)
        likelihood = innovation_likelihood(state.x, *linear)
        tree = _begun(state.x, _largest(state.x.partition) <= _SMALL) if state.tree is None else state.tree
        tree = None if tree is None else tree.with_measurements(whitened(linear))
        self._state, _ = _solve(replace(state, tree=tree, x=None, epochs=epochs))
        return likelihood

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
        self._state, x = _solve(self._state)
        return x

    def graph(self) -> SceneFactorGraph:
        """The last interval: the posterior before it as prior, its factors, and all measurements since."""
        self._state, x = _solve(self._state)
        state = self._state
        steps = filter_epochs(state.before, list(state.epochs))
        means = [*smoothed_means(reversed(steps))[:-1], x.mean]
        return recording_graph(state.before, state.epochs, [step.layout for step in steps], means)

    def snapshot(self) -> IncrementalState:
        """The whole state as a value. The filter itself restarts from it, so that both go on to the same bits."""
        self._state, x = _solve(self._state)
        leaving = x.layout.rows(self._state.newest.leaving)
        state = IncrementalState(x.without(leaving), self.time)
        self.restore(state)
        return state

    def restore(self, state: IncrementalState) -> None:
        """Continue from a snapshot."""
        require_type("state", state, IncrementalState)
        self._state = _State(state.x.layout, None, state.x, state.x, (Epoch(state.time),))

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return live_rows(self.posterior(), self._state.live, nodes)


def _solve(state: _State) -> tuple[_State, BlockGaussian]:
    """Update the tree; where GTSAM's arithmetic fails, filter by covariances without it."""
    if state.x is not None:
        return state, state.x
    tree: BayesTree | None = None
    if state.tree is not None:
        try:
            tree, x = state.tree.updated()
        except RuntimeError as error:
            log.info("iSAM2 begins anew at %.3f s: %s", state.newest.time, " ".join(str(error).split())[:200])
    if tree is None:
        x = filter_epochs(state.before, list(state.epochs))[-1].filtered
    return replace(state, tree=tree, x=x), x


def _begun(x: BlockGaussian, small: bool) -> BayesTree | None:
    """Start a tree from a Gaussian; None where a covariance has no digits left to be inverted."""
    try:
        return BayesTree.begun(x, qr=small)
    except np.linalg.LinAlgError:
        return None


def _moved(state: _State, interval: IntervalDynamics | ZeroInterval) -> _State:
    """Move over an interval: by interaction factors, or by covariances for components whose digits these would lose."""
    state, x = _solve(state)
    stay = x.without(x.layout.rows(state.newest.leaving))
    dynamics = interval.linearised(stay.layout, stay.mean)
    apart = dynamics.separated(stay)
    prediction = PredictionSummary.of(apart, dynamics)
    components, small = prediction.components, _largest(prediction.components) <= _SMALL
    lossy = np.zeros(components.count, dtype=bool)
    lossy[components.label[prediction.ratio > (_QR_LIMIT if small else _CHOLESKY_LIMIT)]] = True
    by_covariance = np.flatnonzero(lossy[components.label])
    by_factors = np.flatnonzero(~lossy[components.label])
    tree, rows = state.tree, x.layout.rows(apart.layout.nodes)
    if len(by_factors) == 0:
        tree, predicted = None, predict(apart, dynamics)
    else:
        predicted = predict(apart.without(by_factors), dynamics.restricted(by_covariance))
        if tree is None or tree.qr != small or apart is not stay:
            tree, rows = _begun(apart, small), np.arange(len(apart.layout))
        tree = _tree_predicted(tree, rows, dynamics.only(by_factors), prediction, predicted)
        if tree is None:
            predicted = predict(apart, dynamics)
    then, now = state.newest.time, state.newest.time + interval.dt
    epochs = (Epoch(then, leaving=state.newest.leaving, interval=interval), Epoch(now))
    return _State(apart.layout, tree, predicted if tree is None else None, x, epochs)


def _tree_predicted(
    tree: BayesTree | None,
    rows: IntArray,
    dynamics: Dynamics,
    prediction: PredictionSummary,
    by_covariance: BlockGaussian,
) -> BayesTree | None:
    """Move the tree over an interval; None where a covariance has no digits left to be inverted."""
    try:
        return None if tree is None else tree.predicted(rows, dynamics, prediction, by_covariance)
    except np.linalg.LinAlgError:
        return None


def _is_wide(state: _State, recorded: RecordedMeasurements) -> bool:
    """True where a prediction is so uncertain beside the measurements that its trace is lost in the posterior."""
    assert state.tree is not None
    variables = state.tree.variables
    layout = variables.partition.layout
    rows, _, H, R = recorded.linearised(layout, variables.origin)
    predicted = (H**2 @ (variables.scale**2)[layout.spans(rows)][:, :, None])[:, :, 0]
    noise = np.diagonal(R, axis1=1, axis2=2)
    return bool((predicted > _WIDE * noise).any())


def _largest(partition: Partition) -> int:
    """Size of the largest component."""
    return max((places.shape[1] for places in partition.groups), default=0)
