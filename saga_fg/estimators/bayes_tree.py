"""`gtsam.ISAM2` over the states of one epoch.

Updates change GTSAM's object itself: to copy it costs a tenth of an update. Of several copies of a filter the first to
be corrected goes on with it; the others find that out, and begin anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors.gaussian import gaussian_graph
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.block_variables import BlockVariables
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.measurements import WhitenedMeasurements
from saga_fg.numerics.arrays import IntArray


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
    factors     to be added
    new         keys of the variables to be added, with their sizes
    leaving     keys of the past variables, to be marginalised
    """

    running: RunningTree
    updates: int
    variables: BlockVariables
    factors: tuple[gtsam.JacobianFactor, ...]
    new: dict[int, int]
    leaving: tuple[int, ...]

    @staticmethod
    def begun(x: BlockGaussian, qr: bool) -> BayesTree:
        """Start from a Gaussian, by QR or by Cholesky elimination. Raises LinAlgError where P has no root."""
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        variables = BlockVariables.over(x.partition, 0, x.mean, np.sqrt(variances))
        priors = tuple(variables.priors(x, np.arange(len(x.layout))))
        running = RunningTree(gtsam.ISAM2(_parameters(qr)))
        return BayesTree(running, 0, variables, priors, variables.dims(), ())

    def with_new_nodes(self, x: BlockGaussian) -> BayesTree:
        """Add the nodes that `x` has at its end and the tree has not, independent of all others."""
        known, first = self.variables.partition.layout, self._next_key
        rows = np.arange(len(known), len(x.layout))
        scale = np.sqrt(x.variances()[known.size :])
        variables = self.variables.extended(x.layout, x.mean[known.size :], scale, first)
        further = slice(len(self.variables.keys), None)
        new = dict(zip(variables.keys[further].tolist(), variables.sizes[further].tolist(), strict=True))
        factors = self.factors + tuple(variables.node_priors(rows, x.covariances(rows)))
        return replace(self, variables=variables, factors=factors, new=self.new | new)

    def predicted(
        self, x: BlockGaussian, rows: IntArray, dynamics: Dynamics, by_factors: IntArray, by_covariance: IntArray
    ) -> BayesTree:
        """Move over an interval, whose prediction is `x`; rows: of its nodes in the tree's present variables.

        by_factors, by_covariance: rows of `x`, of the components that interaction factors lead to, and of those that
        begin with a prior of their own. Raises LinAlgError where a covariance has no root.
        """
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        variables = BlockVariables.over(x.partition, self._next_key, x.mean, np.sqrt(variances), dynamics)
        interactions = variables.interactions(self.variables, rows, dynamics.only(by_factors))
        priors = variables.priors(x.without(by_factors), by_covariance)
        return replace(
            self,
            variables=variables,
            factors=(*self.factors, *interactions, *priors),
            new=self.new | variables.dims(),
            leaving=(*self.leaving, *self.variables.keys.tolist()),
        )

    @property
    def qr(self) -> bool:
        """True where it is eliminated by QR, false by Cholesky."""
        return self.running.isam.params().getFactorization() == "QR"

    @property
    def _next_key(self) -> int:
        return int(self.variables.keys.max(initial=-1)) + 1

    def corrected(self, x: BlockGaussian, measured: WhitenedMeasurements) -> tuple[BayesTree, BlockGaussian]:
        """Take in linear measurements, with all that is still to be taken in; returns also the posterior.

        x: the Gaussian before them. It is read anew where something was measured; nowhere else have they changed it.
        """
        tree = replace(self, factors=self.factors + tuple(self.variables.detections(measured))).updated()
        return tree, tree.variables.posterior(tree.running.isam, x, measured.rows)

    def updated(self, copied: bool = False) -> BayesTree:
        """Take in all changes and marginalise the past.

        copied: for this state to stay that of the running tree. Raises RuntimeError where the tree has gone on, and
        where GTSAM's arithmetic fails.
        """
        if self.running.updates != self.updates:
            raise RuntimeError("another copy of the filter has gone on with the tree")
        running = RunningTree(gtsam.ISAM2(self.running.isam)) if copied else self.running
        isam, values = running.isam, gtsam.Values()
        running.updates += 1
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
            for key in self.variables.keys.tolist():
                groups.insert2(key, 1)
            parameters.constrainedKeys, parameters.extraReelimKeys = groups, leaving
        isam.update(graph, values, parameters)
        if self.leaving:
            isam.marginalizeLeaves(leaving)
        return replace(self, running=running, updates=running.updates, factors=(), new={}, leaving=())


def _parameters(qr: bool) -> gtsam.ISAM2Params:
    """Linear factors: no relinearisation, and every update solved to the last digit."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR" if qr else "CHOLESKY")
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.enableRelinearization = False
    parameters.findUnusedFactorSlots = True
    return parameters
