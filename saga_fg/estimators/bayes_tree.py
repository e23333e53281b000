"""`gtsam.ISAM2` over the states of one epoch.

Updates change GTSAM's object itself, which is not copied. Of several copies of a filter the first to be corrected goes
on with it; the trees of the others are no longer current, and begin anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors.gaussian import gaussian_graph
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.block_variables import BlockVariables
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.measurements import WhitenedMeasurements
from saga_fg.estimators.partition import Partition
from saga_fg.numerics.arrays import BoolArray, IntArray


class RunningTree:
    """GTSAM's object, and the number of its updates."""

    def __init__(self, isam: gtsam.ISAM2) -> None:
        self.isam, self.updates = isam, 0


@dataclass(frozen=True, eq=False)
class BayesTree:
    """iSAM2 as of one of its updates, and the changes that its next one takes in.

    running     the tree, which may have gone on
    updates     that it had had
    variables   of the present states
    held (n,)   which nodes' variables the tree has, or will have: those that are correlated with others
    factors     to be added
    new         keys of the variables to be added, with their sizes
    leaving     keys of the past variables, to be marginalised
    """

    running: RunningTree
    updates: int
    variables: BlockVariables
    held: BoolArray
    factors: tuple[gtsam.JacobianFactor, ...]
    new: dict[int, int]
    leaving: tuple[int, ...]

    @staticmethod
    def begun(x: BlockGaussian, qr: bool) -> BayesTree:
        """Start from a Gaussian, by QR or by Cholesky elimination. Raises LinAlgError where P has no root."""
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        variables, held = BlockVariables.over(x.partition, 0, x.mean, np.sqrt(variances)), _tied(x.partition)
        priors = variables.priors(x.without(np.flatnonzero(~held)), np.flatnonzero(held))
        running = RunningTree(gtsam.ISAM2(_parameters(qr)))
        return BayesTree(running, 0, variables, held, tuple(priors), variables.dims(held), ())

    def with_new_nodes(self, x: BlockGaussian) -> BayesTree:
        """Add the nodes that `x` has at its end and the tree has not, independent of all others."""
        known = self.variables.partition.layout
        scale = np.sqrt(x.variances()[known.size :])
        variables = self.variables.extended(x.layout, x.mean[known.size :], scale, self._next_key)
        new = np.zeros(len(x.layout) - len(known), dtype=bool)
        return replace(self, variables=variables, held=np.concatenate([self.held, new]))

    def predicted(self, x: BlockGaussian, rows: IntArray, dynamics: Dynamics, anew: BoolArray) -> BayesTree:
        """Move over an interval, whose prediction is `x`; rows: of its nodes in the tree's present variables.

        Interaction factors lead to the components of several nodes, but to those that begin `anew` (n,), or have nodes
        that the tree has not: they have a prior of their own. Raises LinAlgError where a covariance has no root.
        """
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        label, held = x.partition.label, _tied(x.partition)
        by_prior = held & np.isin(label, label[anew | ~self.held[rows]])
        variables = BlockVariables.over(x.partition, self._next_key, x.mean, np.sqrt(variances), dynamics)
        interactions = variables.interactions(self.variables, rows, dynamics.only(np.flatnonzero(held & ~by_prior)))
        priors = variables.priors(x.without(np.flatnonzero(~by_prior)), np.flatnonzero(by_prior))
        return replace(
            self,
            variables=variables,
            held=held,
            factors=(*self.factors, *interactions, *priors),
            new=self.new | variables.dims(held),
            leaving=(*self.leaving, *self.variables.dims(self.held)),
        )

    @property
    def is_current(self) -> bool:
        """False where another copy of the filter has gone on with GTSAM's tree."""
        return self.running.updates == self.updates

    @property
    def qr(self) -> bool:
        """True where it is eliminated by QR, false by Cholesky."""
        return self.running.isam.params().getFactorization() == "QR"

    @property
    def _next_key(self) -> int:
        return int(self.variables.keys.max(initial=-1)) + 1

    def corrected(self, x: BlockGaussian, measured: Sequence[WhitenedMeasurements]) -> tuple[BayesTree, BlockGaussian]:
        """Take in linear measurements, with all that is still to be taken in; returns also the posterior. If current.

        x: the posterior by covariances, of the components that the tree has not. The others are read from the tree
        where something was measured; nowhere else has that changed them. Raises RuntimeError or LinAlgError where
        GTSAM's arithmetic fails.
        """
        factors, rows = list(self.factors), list[IntArray]()
        for white in measured:
            mine = self.held[white.rows]
            if mine.any():
                seen = WhitenedMeasurements(white.rows[mine], white.z[mine], white.H[mine])
                factors += self.variables.detections(seen)
                rows.append(seen.rows)
        if not rows:
            return self, x
        tree = replace(self, factors=tuple(factors))._updated()
        return tree, tree.variables.posterior(tree.running.isam, x, np.concatenate(rows))

    def _updated(self) -> BayesTree:
        """Take in all changes and marginalise the past."""
        isam, values = self.running.isam, gtsam.Values()
        self.running.updates += 1
        zeros = {size: np.zeros(size) for size in {*self.new.values()}}
        for key, size in self.new.items():
            values.insert(key, zeros[size])
        # No linearisation point: all values stay at zero, where factors speak of the variables themselves.
        graph = gtsam.LinearContainerFactor.ConvertLinearGraph(gaussian_graph(self.factors))
        parameters, leaving = gtsam.ISAM2UpdateParams(), gtsam.KeyList()
        if self.leaving:
            groups = gtsam.KeyGroupMap()
            for key in self.leaving:  # eliminated first, so that they are leaves: GTSAM crashes on others
                groups.insert2(key, 0)
                leaving.push_back(key)
            for key in self.variables.dims(self.held):
                groups.insert2(key, 1)
            parameters.constrainedKeys, parameters.extraReelimKeys = groups, leaving
        isam.update(graph, values, parameters)
        if self.leaving:
            isam.marginalizeLeaves(leaving)
        return replace(self, updates=self.running.updates, factors=(), new={}, leaving=())


def _tied(partition: Partition) -> BoolArray:
    """(n,) which nodes are in components of several."""
    return np.asarray(np.bincount(partition.label, minlength=1)[partition.label] > 1)


def _parameters(qr: bool) -> gtsam.ISAM2Params:
    """Linear factors: no relinearisation, and every update solved to the last digit."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR" if qr else "CHOLESKY")
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.enableRelinearization = False
    parameters.findUnusedFactorSlots = True
    return parameters
