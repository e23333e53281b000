"""Solutions of linearised graphs as values: where all variables are, their covariances, the step to the minimum."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import cached_property

import gtsam
import numpy as np

from factors import marginal_moments
from factors.gaussian import Elimination, block_covariances, singular_system
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import LinearisationPoint
from saga_fg.numerics.arrays import FloatArray

_WIDE = 400  # dimensions of a clique from which QR takes ten times as long as Cholesky


class GraphSolution:
    """values: where all variables are; converged: whether the last step was short enough.

    point: the values with their bases; linear: all factors, on increments from the bases
    """

    def __init__(self, point: LinearisationPoint, linear: gtsam.GaussianFactorGraph, converged: bool) -> None:
        self._point, self._linear = point, linear
        self.values, self.converged = point.values, converged

    def covariance(self, keys: Iterable[int]) -> FloatArray:
        """Joint covariance (D, D) of variables in the order given; of poses in their own frames, as GTSAM's."""
        wanted = list(keys)
        return self._point.transported(wanted, marginal_moments(self._linear, wanted, self._eliminated[1])[1])

    def marginal(self, key: int) -> FloatArray:
        """Covariance (d, d) of one variable, by elimination of everything once for all variables that are asked for."""
        return self._point.transported([key], self._marginals[key])

    @property
    def step(self) -> gtsam.VectorValues:
        """Step from the linearisation point to the minimum. Raises `SingularSystemError`."""
        step = self._eliminated[0].optimize()
        if not np.isfinite(step.norm()):
            raise singular_system(self._linear)
        return step

    @cached_property
    def _marginals(self) -> dict[int, FloatArray]:
        dims = {key: variable.dim for key, variable in self._point.variables.items()}
        return block_covariances(self._eliminated[0], dims)

    @cached_property
    def _eliminated(self) -> tuple[gtsam.GaussianBayesTree, Elimination]:
        """By QR where cliques are narrow, else by Cholesky, which has half the digits and is ten times as fast."""
        with contextlib.suppress(RuntimeError):
            tree = self._linear.eliminateMultifrontal()
            if width(tree) > _WIDE:
                return tree, "cholesky"
        try:
            order = gtsam.Ordering.ColamdGaussianFactorGraph(self._linear)
            return self._linear.eliminateMultifrontal(order, gtsam.EliminateQR), "qr"
        except RuntimeError as error:
            raise singular_system(self._linear, error) from error


def linear_solution(graph: SceneFactorGraph) -> GraphSolution:
    """The factors of a graph as they are linearised where its variables are; the step counts from their base."""
    linear, point = gtsam.GaussianFactorGraph(), graph.point()
    for number in sorted(graph.groups, key=lambda number: graph.groups[number].elimination_order):
        for factor in graph.linear(number, point):
            linear.push_back(factor)
    return GraphSolution(point, linear, True)


def width(tree: gtsam.GaussianBayesTree) -> int:
    """Dimensions of the largest clique."""
    widest, below = 0, list(tree.roots())
    while below:
        clique = below.pop()
        widest = max(widest, clique.conditional().cols() - 1)
        below += [clique[k] for k in range(clique.nrChildren())]
    return widest
