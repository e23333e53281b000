r"""The filter as an incremental factor graph: `gtsam.ISAM2` with interaction factors, the past marginalised.

Every interval adds variables for the new states and the interaction factors that lead to them; measurements add
detection factors; then the old variables are marginalised, so that the graph always holds one moment: cost and memory a
frame stay what they are for ever. Means and covariances are read from the Bayes tree. See `saga_fg.estimators.cells`
for the variables.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of
variance P costs Cholesky elimination log10(P/Q) digits, QR half as many. So small components are eliminated by QR,
large ones by Cholesky while that leaves enough digits, and an interval that would leave fewer (Q singular, or many
million times smaller than P) is carried out in moments, P <- F P F^T + Q, after which iSAM2 begins anew from there.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.backward import smoothed_means
from saga_fg.estimators.bayes_tree import BayesTree
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import innovation_likelihood, posterior_likelihood
from saga_fg.estimators.dynamics import Dynamics, predict
from saga_fg.estimators.factor_graph import recording_graph
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.moment import Birth, Moment, passed
from saga_fg.estimators.motion import Motion, Standstill
from saga_fg.estimators.newest import NewestMarginals, live_rows
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.prediction import Prediction
from saga_fg.estimators.protocol import Measurements, require_kind
from saga_fg.estimators.sighting import Observations, Sighting, whitened
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
    """The filter as a value: what it knows of the nodes that are there, and when."""

    x: BlockGaussian
    time: float


@dataclass(frozen=True, eq=False)
class _Held:
    """All that the filter holds.

    live    the nodes that are there
    tree    iSAM2, None where it has to begin anew
    x       what is known of the nodes, those too that go after this moment; None while the tree is not updated
    before  what was known before the `moments`: the last interval, and the present
    """

    live: Layout
    tree: BayesTree | None
    x: BlockGaussian | None
    before: BlockGaussian
    moments: tuple[Moment, ...]

    @property
    def newest(self) -> Moment:
        return self.moments[-1]

    def noted(self, moment: Moment) -> tuple[Moment, ...]:
        """The moments with `moment` as the newest."""
        return (*self.moments[:-1], moment)


class IncrementalFilter(NewestMarginals):
    """The exact filter, by `gtsam.ISAM2`. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def __init__(self) -> None:
        self._held: _Held
        self.restore(IncrementalState(BlockGaussian.empty(), 0.0))

    @property
    def nodes(self) -> IntArray:
        return self._held.live.nodes

    @property
    def time(self) -> float:
        return self._held.newest.time

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        held = self._held
        live = held.live.extended(nodes, mean.shape[1])
        added = live.nodes[len(held.live) :]
        if len(added) == 0:
            return
        if np.isin(added, held.newest.gone).any():  # gone and back at the same time
            held = _moved(held, Standstill())
        held, x = _solved(held)
        x = x.extended(x.layout.extended(added, mean.shape[1]), mean, covariance)
        birth = Birth(added, mean, covariance)
        moments = held.noted(replace(held.newest, births=(*held.newest.births, birth)))
        tree = None if held.tree is None else held.tree.born(x)
        self._held = replace(held, live=live, tree=tree, x=x, moments=moments)

    def predict(self, transition: Transition) -> None:
        motion = Motion(transition)
        motion.check(self._held.live)
        self._held = _moved(self._held, motion)

    def update(self, measurements: Measurements | Observations) -> float:
        sighting = Sighting(measurements)
        sighting.check(self._held.live)
        if len(measurements) == 0:
            return 0.0
        held = self._held
        if held.x is None and _is_wide(held, sighting):
            held, _ = _solved(held)
        moments = held.noted(replace(held.newest, sightings=(*held.newest.sightings, sighting)))
        if held.x is None:
            assert held.tree is not None
            prior_mean = held.tree.cells.origin
            seen = sighting.linearised(held.tree.components.layout, prior_mean)
            white = whitened(seen)
            self._held, x = _solved(replace(held, tree=held.tree.seen(white), moments=moments))
            return posterior_likelihood(x, prior_mean, *white)
        seen = sighting.linearised(held.x.layout, held.x.mean)
        likelihood = innovation_likelihood(held.x, *seen)
        tree = _begun(held.x, _largest(held.x.partition) <= _SMALL) if held.tree is None else held.tree
        tree = None if tree is None else tree.seen(whitened(seen))
        self._held, _ = _solved(replace(held, tree=tree, x=None, moments=moments))
        return likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        held = self._held
        rows = held.live.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        gone = (*held.newest.gone, *held.live.nodes[rows].tolist())
        self._held = replace(held, live=held.live.without(rows), moments=held.noted(replace(held.newest, gone=gone)))

    def posterior(self) -> BlockGaussian:
        """The filter's, of the nodes that are there now, and perhaps of some that just went."""
        self._held, x = _solved(self._held)
        return x

    def graph(self) -> SceneFactorGraph:
        """The last interval: what was known before it as prior, its factors, and everything seen since."""
        self._held, x = _solved(self._held)
        held = self._held
        passes = passed(held.before, list(held.moments))
        means = [*smoothed_means(passes)[:-1], x.mean]
        return recording_graph(held.before, held.moments, [state.layout for state in passes], means)

    def snapshot(self) -> IncrementalState:
        """The whole state, as a value. The filter itself begins anew from it, so that both go on to the same bits."""
        self._held, x = _solved(self._held)
        gone = x.layout.rows(self._held.newest.gone)
        state = IncrementalState(x.without(gone), self.time)
        self.restore(state)
        return state

    def restore(self, state: IncrementalState) -> None:
        """Continue from a snapshot."""
        require_kind("state", state, IncrementalState)
        self._held = _Held(state.x.layout, None, state.x, state.x, (Moment(state.time),))

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return live_rows(self.posterior(), self._held.live, nodes)


def _solved(held: _Held) -> tuple[_Held, BlockGaussian]:
    """With the tree updated, or, where GTSAM's arithmetic fails, without it: in moments."""
    if held.x is not None:
        return held, held.x
    tree: BayesTree | None = None
    if held.tree is not None:
        try:
            tree, x = held.tree.updated()
        except RuntimeError as error:
            log.info("iSAM2 begins anew at %.3f s: %s", held.newest.time, " ".join(str(error).split())[:200])
    if tree is None:
        x = passed(held.before, list(held.moments))[-1].filtered
    return replace(held, tree=tree, x=x), x


def _begun(x: BlockGaussian, small: bool) -> BayesTree | None:
    """A new tree of what is known, None where a covariance has no digits left to be inverted."""
    try:
        return BayesTree.begun(x, qr=small)
    except np.linalg.LinAlgError:
        return None


def _moved(held: _Held, motion: Motion | Standstill) -> _Held:
    """After an interval: by interaction factors, or in moments for the components whose digits these would lose."""
    held, x = _solved(held)
    stay = x.without(x.layout.rows(held.newest.gone))
    dynamics = motion.dynamics(stay.layout, stay.mean)
    apart = dynamics.separated(stay)
    prediction = Prediction.of(apart, dynamics)
    components, small = prediction.components, _largest(prediction.components) <= _SMALL
    lossy = np.zeros(components.count, dtype=bool)
    lossy[components.label[prediction.ratio > (_QR_LIMIT if small else _CHOLESKY_LIMIT)]] = True
    in_moments = np.flatnonzero(lossy[components.label])
    by_factors = np.flatnonzero(~lossy[components.label])
    tree, rows = held.tree, x.layout.rows(apart.layout.nodes)
    if len(by_factors) == 0:
        tree, predicted = None, predict(apart, dynamics)
    else:
        predicted = predict(apart.without(by_factors), dynamics.restricted(in_moments))
        if tree is None or tree.qr != small or apart is not stay:
            tree, rows = _begun(apart, small), np.arange(len(apart.layout))
        tree = _told_of(tree, rows, dynamics.only(by_factors), prediction, predicted)
        if tree is None:
            predicted = predict(apart, dynamics)
    then, now = held.newest.time, held.newest.time + motion.dt
    moments = (Moment(then, gone=held.newest.gone, motion=motion), Moment(now))
    return _Held(apart.layout, tree, predicted if tree is None else None, x, moments)


def _told_of(
    tree: BayesTree | None, rows: IntArray, dynamics: Dynamics, prediction: Prediction, in_moments: BlockGaussian
) -> BayesTree | None:
    """The tree after an interval, None where a covariance has no digits left to be inverted."""
    try:
        return None if tree is None else tree.moved(rows, dynamics, prediction, in_moments)
    except np.linalg.LinAlgError:
        return None


def _is_wide(held: _Held, sighting: Sighting) -> bool:
    """Whether a prediction is so uncertain beside the measurements that its trace is lost in the posterior."""
    assert held.tree is not None
    cells = held.tree.cells
    layout = cells.partition.layout
    rows, _, H, R = sighting.linearised(layout, cells.origin)
    predicted = (H**2 @ (cells.scale**2)[layout.spans(rows)][:, :, None])[:, :, 0]
    noise = np.diagonal(R, axis1=1, axis2=2)
    return bool((predicted > _WIDE * noise).any())


def _largest(partition: Partition) -> int:
    """Size of the largest component."""
    return max((places.shape[1] for places in partition.groups), default=0)
