"""`gtsam.ISAM2` as a value: what it holds of one moment, and what it is to be told next.

GTSAM's object is never changed in place: an update works on a copy, which costs microseconds, so that whatever GTSAM
refuses leaves the last good one untouched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import nonlinear_graph
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.cells import Cells
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.prediction import Prediction
from saga_fg.estimators.sighting import WhitenedRows
from saga_fg.numerics.arrays import IntArray


@dataclass(frozen=True, eq=False)
class BayesTree:
    """iSAM2 over the states of one moment.

    isam, cells (its present variables), components (what they are correlated with); and what it has not been told yet:
    factors, fresh (keys of new variables and their sizes), leaving (keys of the past, to be marginalised)
    """

    isam: gtsam.ISAM2
    cells: Cells
    components: Partition
    factors: tuple[gtsam.JacobianFactor, ...]
    fresh: dict[int, int]
    leaving: dict[int, int]

    @staticmethod
    def begun(x: BlockGaussian, qr: bool) -> BayesTree:
        """From what is known of some nodes; by QR or by Cholesky elimination. LinAlgError where P has no root."""
        variances = x.variances()
        if not (variances > 0).all():
            raise np.linalg.LinAlgError("a variance is not positive")
        cells = Cells.over(x.partition, 0, x.mean, np.sqrt(variances))
        priors = tuple(cells.priors(x, np.arange(len(x.layout))))
        return BayesTree(gtsam.ISAM2(_parameters(qr)), cells, x.partition, priors, cells.dims(), {})

    def born(self, x: BlockGaussian) -> BayesTree:
        """With the nodes that `x` has at its end and the tree has not, which are correlated with nobody."""
        known, first = self.cells.partition.layout, self._next_key
        rows = np.arange(len(known), len(x.layout))
        scale = np.sqrt(x.variances()[known.size :])
        cells = self.cells.extended(x.layout, x.mean[known.size :], scale, first)
        fresh = {key: size for key, size in cells.dims().items() if key >= first}
        factors = self.factors + tuple(cells.births(rows, x.covariances(rows)))
        return replace(self, cells=cells, components=x.partition, factors=factors, fresh=self.fresh | fresh)

    def seen(self, rows: WhitenedRows) -> BayesTree:
        """With linear measurements of some nodes."""
        return replace(self, factors=self.factors + tuple(self.cells.detections(rows)))

    def moved(self, rows: IntArray, dynamics: Dynamics, prediction: Prediction, in_moments: BlockGaussian) -> BayesTree:
        """After an interval, of the nodes that stay, which stood at `rows`.

        dynamics: of those whose new state is told by interaction factors; in_moments: the prediction of the others.
        """
        components = prediction.components
        cells = Cells.over(components, self._next_key, prediction.mean, prediction.scale, dynamics)
        others = components.layout.rows(in_moments.layout.nodes)
        factors = (*cells.interactions(self.cells, rows, dynamics), *cells.priors(in_moments, others))
        return BayesTree(
            self.isam,
            cells,
            components,
            self.factors + factors,
            self.fresh | cells.dims(),
            self.leaving | self.cells.dims(),
        )

    @property
    def qr(self) -> bool:
        """Whether it is eliminated by QR, or by Cholesky."""
        return self.isam.params().getFactorization() == "QR"

    @property
    def _next_key(self) -> int:
        return int(self.cells.keys.max(initial=-1)) + 1

    def updated(self) -> tuple[BayesTree, BlockGaussian]:
        """With everything told and the past marginalised; and what is known of the present.

        GTSAM raises RuntimeError where its arithmetic fails.
        """
        isam = gtsam.ISAM2(self.isam)
        present = self.cells.dims()
        graph = nonlinear_graph(self.factors, present | self.leaving | self.fresh)
        values = gtsam.Values()
        for key, size in self.fresh.items():
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
        mean = self.cells.mean(isam.getDelta())
        if not np.isfinite(mean).all():
            raise RuntimeError("iSAM2 answers with numbers that are not finite")
        x = BlockGaussian(self.components, mean, self.cells.marginals(isam, self.components))
        return replace(self, isam=isam, factors=(), fresh={}, leaving={}), x


def _parameters(qr: bool) -> gtsam.ISAM2Params:
    """Linear factors: no relinearisation, and every update solved to the last digit."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR" if qr else "CHOLESKY")
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    parameters.enableRelinearization = False
    parameters.findUnusedFactorSlots = True
    return parameters
