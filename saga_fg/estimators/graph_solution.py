"""The solution of a running graph at one moment, as a value: it stays as it is when the graph goes on."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import gtsam
import numpy as np

from factors import marginal_moments
from saga_fg.arrays import FloatArray
from saga_fg.graph.point import Point


class GraphSolution:
    """values: where all variables are; converged: whether the last step was short enough.

    point: the values with their bases; linear: all factors, on increments from the bases
    """

    def __init__(self, point: Point, linear: gtsam.GaussianFactorGraph, converged: bool) -> None:
        self._point, self._linear = point, linear
        self.values, self.converged = point.values, converged

    def covariance(self, keys: Iterable[int]) -> FloatArray:
        """Joint covariance (D, D) of variables in the order given; of poses in their own frames, as GTSAM's."""
        wanted = list(keys)
        return self._transported(wanted, marginal_moments(self._linear, wanted, "qr")[1])

    def marginal(self, key: int) -> FloatArray:
        """Covariance (d, d) of one variable, by elimination of everything once for all variables that are asked for."""
        try:
            return self._transported([key], np.asarray(self._tree.marginalCovariance(key)))
        except RuntimeError:  # Cholesky squares the condition number
            return self.covariance([key])

    def _transported(self, keys: list[int], P: FloatArray) -> FloatArray:
        P, start = P.copy(), 0
        for key in keys:
            span, D = slice(start, start + self._point.variables[key].dim), self._point.transport(key)
            if D is not None:
                P[span] = D @ P[span]
                P[:, span] = P[:, span] @ D.T
            start = span.stop
        return P

    @cached_property
    def _tree(self) -> gtsam.GaussianBayesTree:
        return self._linear.eliminateMultifrontal()
