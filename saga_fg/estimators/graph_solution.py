r"""The solution of a running graph as a value, which stays when the graph goes on, with the marginals of its variables.

Covariances come from the Bayes tree of cliques, R x_F + S x_S = d each, from the roots down: with the separator's own
covariance from the clique above,

    cov x_F = R^-1 R^-T + G cov(x_S) G^T,    cov(x_F, x_S) = -G cov(x_S),    G = R^-1 S

(Takahashi's recursion on blocks; Kaess and Dellaert, Covariance recovery from a square root information matrix for data
association, 2009).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from functools import cached_property

import gtsam
import numpy as np
import scipy.linalg

from factors import marginal_moments
from factors.marginal import Elimination
from factors.singular import singular_system
from saga_fg.graph.linearisation_point import LinearisationPoint
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.numerics.arrays import FloatArray

_WIDE = 400  # dimensions of a clique from which QR takes ten times as long as Cholesky


class NoSolution(Exception):  # noqa: N818 -- it is no error of the caller's
    """Elimination has too few digits for this recording."""


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
        return tree_covariances(self._eliminated[0], dims)

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


def tree_covariances(tree: gtsam.GaussianBayesTree, dims: Mapping[int, int]) -> dict[int, FloatArray]:
    """The covariance of every single variable, by key; dims: their sizes. Raises `NoSolution` for hard constraints."""
    blocks: dict[int, FloatArray] = {}
    open_cliques: list[tuple[gtsam.GaussianBayesTreeClique, FloatArray]]
    open_cliques = [(root, np.empty((0, 0))) for root in tree.roots()]
    while open_cliques:
        clique, separator = open_cliques.pop()
        conditional = clique.conditional()
        model = conditional.get_model()
        if model is not None and model.isConstrained():
            raise NoSolution("some noise has no variance in a direction")
        R = np.array(conditional.R())
        joint = _joint(R, np.array(conditional.S()), separator)
        spans, end = {}, 0
        for key in conditional.keys():  # noqa: SIM118 -- frontal ones first; a conditional is no dict
            begin, end = end, end + dims[key]
            spans[key] = np.arange(begin, end)
            if end <= len(R):
                blocks[key] = joint[begin:end, begin:end]
        for k in range(clique.nrChildren()):
            child = clique[k]
            at = [spans[key] for key in child.conditional().keys() if key in spans]  # noqa: SIM118
            shared = np.concatenate(at) if at else np.empty(0, dtype=np.int64)
            open_cliques.append((child, joint[np.ix_(shared, shared)]))
    return blocks


def width(tree: gtsam.GaussianBayesTree) -> int:
    """Dimensions of the largest clique."""
    widest, below = 0, list(tree.roots())
    while below:
        clique = below.pop()
        widest = max(widest, clique.conditional().cols() - 1)
        below += [clique[k] for k in range(clique.nrChildren())]
    return widest


def _joint(R: FloatArray, S: FloatArray, separator: FloatArray) -> FloatArray:
    """Covariance of a clique's frontal variables and its separator together."""
    inverse = scipy.linalg.lapack.dtrtri(R)[0]
    if separator.size == 0:
        return np.asarray(inverse @ inverse.T)
    f = len(R)
    G = inverse @ S
    joint = np.empty((f + len(separator), f + len(separator)))
    joint[f:, f:] = separator
    joint[:f, f:] = -G @ separator
    joint[f:, :f] = joint[:f, f:].T
    joint[:f, :f] = inverse @ inverse.T - joint[:f, f:] @ G.T
    return joint
