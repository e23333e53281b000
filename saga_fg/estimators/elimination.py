r"""Sparse elimination of a whole recording at once, and the covariances of all its states.

GTSAM eliminates the linearised factors to a Bayes tree of cliques, R x_F + S x_S = d each. Means come by back
substitution, covariances from the roots down: with the separator's own covariance, told by the clique above,

    cov x_F = R^-1 R^-T + G cov(x_S) G^T,    cov(x_F, x_S) = -G cov(x_S),    G = R^-1 S

(Takahashi's recursion on blocks; Kaess and Dellaert, Covariance recovery from a square root information matrix for data
association, 2009). Linear problems are solved twice, the second time for the digits that the first left; nonlinear and
robust ones until steps are short.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
import scipy.linalg

from factors import Linearisable, linearised
from saga_fg.estimators.backward import MarginalCovariances
from saga_fg.estimators.elimination_order import Order, sparse_ordering
from saga_fg.estimators.fixed_point import FixedPoint
from saga_fg.estimators.layout import Layout
from saga_fg.numerics.arrays import FloatArray

log = logging.getLogger(__name__)

_SHORT = 1e-8  # length of a step, in posterior standard deviations of all states together
_DIGITS = 1e-10  # of a step that elimination may get wrong


class NoSolution(Exception):  # noqa: N818 -- it is no error of the caller's
    """Elimination has too few digits for this recording."""


def solved_tree(
    graph: gtsam.NonlinearFactorGraph,
    factors: Sequence[Linearisable],
    values: gtsam.Values,
    order: Order,
    max_iterations: int,
) -> tuple[gtsam.Values, gtsam.GaussianBayesTree]:
    """The minimum of the linear factors in `graph` and others, and the Bayes tree there. Raises `NoSolution`.

    Of a linear problem the first step should be all; what is left of it tells how many digits elimination has.
    """
    ordering, accelerated, linear_problem = None, FixedPoint(), not factors
    first = length = np.inf
    for iteration in range(max_iterations):
        linear = linearised(graph, factors, values)
        ordering = ordering or _ordering(linear, order)
        try:
            tree = linear.eliminateMultifrontal(ordering)
        except RuntimeError as error:
            raise NoSolution(" ".join(str(error).split())[:200]) from error
        step = tree.optimize()
        length = float(np.sqrt(max(0.0, -linear.gradientAtZero().dot(step))))
        log.debug("iteration %d: step of %.3g standard deviations", iteration + 1, length)
        if not np.isfinite(length):
            raise NoSolution("a step is not finite")
        if iteration == 0:
            first = max(length, 1.0)
        elif iteration == 1 and linear_problem and length > _DIGITS * first:
            raise NoSolution(f"of a step of {first:.3g} standard deviations {length:.2g} were wrong")
        if length <= _SHORT and iteration > 0:
            return values.retract(step), tree
        values = values.retract(step) if linear_problem else _mixed(values, step, accelerated)
    raise NoSolution(f"no convergence in {max_iterations} iterations; the last step is {length:.2g} sigma")


def _mixed(values: gtsam.Values, step: gtsam.VectorValues, accelerated: FixedPoint) -> gtsam.Values:
    """Where to linearise next."""
    keys = list(values.keys())
    sizes = [len(values.atVector(key)) for key in keys]
    x = np.concatenate([values.atVector(key) for key in keys])
    point = accelerated.next(x, x + step.vector(keys), np.ones(len(x)))
    mixed = gtsam.Values()
    for key, part in zip(keys, np.split(point, np.cumsum(sizes)[:-1]), strict=True):
        mixed.insert(key, part)
    return mixed


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


def marginal_covariances(
    blocks: Mapping[int, FloatArray], keys: Sequence[Mapping[int, int]], layouts: Sequence[Layout]
) -> list[MarginalCovariances]:
    """The same by epoch; keys of each epoch's nodes."""
    epochs = []
    for own, layout in zip(keys, layouts, strict=True):
        by_size, place = {}, np.empty(len(layout), dtype=np.int64)
        for d in np.unique(layout.dims).tolist():
            rows = np.flatnonzero(layout.dims == d)
            by_size[d] = np.array([blocks[own[node]] for node in layout.nodes[rows].tolist()])
            place[rows] = np.arange(len(rows))
        epochs.append(MarginalCovariances(layout, by_size, place))
    return epochs


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


def _ordering(linear: gtsam.GaussianFactorGraph, order: Order) -> gtsam.Ordering:
    return sparse_ordering([linear.at(i).keys() for i in range(linear.size())], order)
