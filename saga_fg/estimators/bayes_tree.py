"""`gtsam.ISAM2` over the states of one epoch, as a value.

GTSAM's object is never changed in place: an update works on a copy, which costs microseconds, so that an update that
GTSAM refuses leaves the last good one untouched.
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


@dataclass(frozen=True, eq=False)
class BayesTree:
    """iSAM2, and the changes that its next update takes in.

    isam        as of the last update
    variables   of the present states
    factors     to be added
    new         keys of the variables to be added, with their sizes
    leaving     keys of the past variables, to be marginalised, with their sizes
    """

    isam: gtsam.ISAM2
    variables: BlockVariables
    factors: tuple[gtsam.JacobianFactor, ...]
    new: dict[int, int]
    leaving: dict[int, int]

    @staticmethod
    def begun(x: BlockGaussian, qr: bool) -> BayesTree:
        """Start from a Gaussian, by QR or by Cholesky elimination. Raises LinAlgError where P has no root."""
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        variables = BlockVariables.over(x.partition, 0, x.mean, np.sqrt(variances))
        priors = tuple(variables.priors(x, np.arange(len(x.layout))))
        return BayesTree(gtsam.ISAM2(_parameters(qr)), variables, priors, variables.dims(), {})

    def with_new_nodes(self, x: BlockGaussian) -> BayesTree:
        """Add the nodes that `x` has at its end and the tree has not, independent of all others."""
        known, first = self.variables.partition.layout, self._next_key
        rows = np.arange(len(known), len(x.layout))
        scale = np.sqrt(x.variances()[known.size :])
        variables = self.variables.extended(x.layout, x.mean[known.size :], scale, first)
        new = {key: size for key, size in variables.dims().items() if key >= first}
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
        return BayesTree(
            self.isam,
            variables,
            (*self.factors, *interactions, *priors),
            self.new | variables.dims(),
            self.leaving | self.variables.dims(),
        )

    @property
    def qr(self) -> bool:
        """True where it is eliminated by QR, false by Cholesky."""
        return self.isam.params().getFactorization() == "QR"

    @property
    def _next_key(self) -> int:
        return int(self.variables.keys.max(initial=-1)) + 1

    def corrected(self, x: BlockGaussian, measured: WhitenedMeasurements) -> tuple[BayesTree, BlockGaussian]:
        """Take in linear measurements, with all that is still to be taken in; returns also the posterior.

        x: the Gaussian before them. It is read anew where something was measured; nowhere else have they changed it.
        """
        tree = replace(self, factors=self.factors + tuple(self.variables.detections(measured))).updated()
        return tree, tree.variables.posterior(tree.isam, x, measured.rows)

    def updated(self) -> BayesTree:
        """Take in all changes and marginalise the past. GTSAM raises RuntimeError where its arithmetic fails."""
        isam = gtsam.ISAM2(self.isam)
        present = self.variables.dims()
        dims = present | self.leaving | self.new
        zeros = {size: np.zeros(size) for size in {*dims.values()}}
        values, point = gtsam.Values(), gtsam.Values()  # where factors are linearised: those of increments from there
        for key, size in self.new.items():
            values.insert(key, zeros[size])
        for key in {key for factor in self.factors for key in factor.keys()}:  # noqa: SIM118 -- a factor is no dict
            point.insert(key, zeros[dims[key]])
        graph = gtsam.LinearContainerFactor.ConvertLinearGraph(gaussian_graph(self.factors), point)
        parameters = gtsam.ISAM2UpdateParams()
        if self.leaving:
            groups, leaving = gtsam.KeyGroupMap(), gtsam.KeyList()
            for key in self.leaving:  # eliminated first, so that they are leaves: GTSAM crashes on others
                groups.insert2(key, 0)
                leaving.push_back(key)
            for key in present:
                groups.insert2(key, 1)
            parameters.constrainedKeys, parameters.extraReelimKeys = groups, leaving
        isam.update(graph, values, parameters)
        if self.leaving:
            isam.marginalizeLeaves(leaving)
        return replace(self, isam=isam, factors=(), new={}, leaving={})


def _parameters(qr: bool) -> gtsam.ISAM2Params:
    """Linear factors: no relinearisation, and every update solved to the last digit."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR" if qr else "CHOLESKY")
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.enableRelinearization = False
    parameters.findUnusedFactorSlots = True
    return parameters
