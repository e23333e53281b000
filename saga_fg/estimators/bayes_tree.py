"""`gtsam.ISAM2` over the states of one epoch, as a value.

GTSAM's object is never changed in place: an update works on a copy, which costs microseconds, so that an update that
GTSAM refuses leaves the last good one untouched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import nonlinear_graph
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.block_variables import BlockVariables
from saga_fg.estimators.dynamics import Dynamics, PredictionSummary
from saga_fg.estimators.measurements import WhitenedMeasurements
from saga_fg.estimators.partition import Partition
from saga_fg.numerics.arrays import IntArray


@dataclass(frozen=True, eq=False)
class BayesTree:
    """iSAM2, and the changes that its next update takes in.

    isam        as of the last update
    variables   of the present states
    components  nodes that are correlated
    factors     to be added
    new         keys of the variables to be added, with their sizes
    leaving     keys of the past variables, to be marginalised, with their sizes
    """

    isam: gtsam.ISAM2
    variables: BlockVariables
    components: Partition
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
        return BayesTree(gtsam.ISAM2(_parameters(qr)), variables, x.partition, priors, variables.dims(), {})

    def with_new_nodes(self, x: BlockGaussian) -> BayesTree:
        """Add the nodes that `x` has at its end and the tree has not, independent of all others."""
        known, first = self.variables.partition.layout, self._next_key
        rows = np.arange(len(known), len(x.layout))
        scale = np.sqrt(x.variances()[known.size :])
        variables = self.variables.extended(x.layout, x.mean[known.size :], scale, first)
        new = {key: size for key, size in variables.dims().items() if key >= first}
        factors = self.factors + tuple(variables.node_priors(rows, x.covariances(rows)))
        return replace(self, variables=variables, components=x.partition, factors=factors, new=self.new | new)

    def with_measurements(self, rows: WhitenedMeasurements) -> BayesTree:
        """Add linear measurements."""
        return replace(self, factors=self.factors + tuple(self.variables.detections(rows)))

    def predicted(
        self, rows: IntArray, dynamics: Dynamics, prediction: PredictionSummary, by_covariance: BlockGaussian
    ) -> BayesTree:
        """Move over an interval; rows: of the nodes that stay.

        dynamics: of the nodes predicted by interaction factors; by_covariance: the prediction of the others.
        """
        components = prediction.components
        variables = BlockVariables.over(components, self._next_key, prediction.mean, prediction.scale, dynamics)
        others = components.layout.rows(by_covariance.layout.nodes)
        factors = (*variables.interactions(self.variables, rows, dynamics), *variables.priors(by_covariance, others))
        return BayesTree(
            self.isam,
            variables,
            components,
            self.factors + factors,
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

    def updated(self) -> tuple[BayesTree, BlockGaussian]:
        """Take in all changes and marginalise the past; returns the posterior as well.

        GTSAM raises RuntimeError where its arithmetic fails.
        """
        isam = gtsam.ISAM2(self.isam)
        present = self.variables.dims()
        graph = nonlinear_graph(self.factors, present | self.leaving | self.new)
        values = gtsam.Values()
        for key, size in self.new.items():
            values.insert(key, np.zeros(size))
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
        mean = self.variables.mean(isam.getDelta())
        if not np.isfinite(mean).all():
            raise RuntimeError("iSAM2 answers with numbers that are not finite")
        x = BlockGaussian(self.components, mean, self.variables.marginals(isam, self.components))
        return replace(self, isam=isam, factors=(), new={}, leaving={}), x


def _parameters(qr: bool) -> gtsam.ISAM2Params:
    """Linear factors: no relinearisation, and every update solved to the last digit."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR" if qr else "CHOLESKY")
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.enableRelinearization = False
    parameters.findUnusedFactorSlots = True
    return parameters
