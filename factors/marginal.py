"""Marginalisation of variables: Gaussian factors that keep their information on the others.

    phi(x_b) = max_{x_a} prod phi(x_a, x_b)        ||A_a x_a + A_b x_b - b||^2  ->  ||(Q_2^T A_b) x_b - Q_2^T b||^2

with Q_2 the part of the QR factor of A_a that is orthogonal to it; for Gaussians this is the integral over x_a, up to a
constant. A node that disappears is marginalised, never just deleted together with its factors.

Two eliminations, both GTSAM's. "cholesky" works on the information matrix A^T A, whose condition number is the square
of A's; "qr" works on A itself. Over a hundred steps of five coupled nodes at coordinates of 1000 m, measured to 0.1 m
ten times a second, Cholesky's means come to lie 2e-9 posterior sigmas from those of a covariance filter at an
acceleration noise of 0.1 m^2/s^3, 2e-6 at 1e-4 and 4e-2 at 1e-8; QR's 1e-10, 1e-8 and 8e-7. QR takes half as long again
on small components, and up to twenty times as long on a large, densely connected graph. Increments from a point nearby,
in place of coordinates, shrink both errors alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, get_args

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.singular import singular_system
from factors.validation import FloatArray, checked_keys, format_keys

Elimination = Literal["cholesky", "qr"]


def marginal_factors(
    graph: gtsam.GaussianFactorGraph, eliminate: Iterable[int], elimination: Elimination = "cholesky"
) -> gtsam.GaussianFactorGraph:
    """Return factors on the remaining keys that carry all the graph says about them.

    Factors without eliminated keys are passed on as they are (shared, not copied). Raises `FactorError` for a key that
    the graph lacks, and `SingularSystemError` when the graph does not determine the eliminated variables.
    """
    leaving = checked_keys("eliminate", eliminate)
    _present(graph, leaving)
    if not leaving:
        return graph
    try:  # in the order COLAMD finds best
        if _checked(elimination) == "qr":
            tree, remaining = graph.eliminatePartialMultifrontal(list(leaving), gtsam.EliminateQR)
        else:
            tree, remaining = graph.eliminatePartialMultifrontal(list(leaving))
    except RuntimeError as error:
        raise singular_system(graph, error) from error
    if not np.isfinite(tree.gradientAtZero().norm()):  # GTSAM passes NaN on without a word
        raise singular_system(graph)
    return remaining


def marginal_moments(
    graph: gtsam.GaussianFactorGraph, keys: Iterable[int], elimination: Elimination = "cholesky"
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (D,) and covariance (D, D) of `keys` together, in this order, all other variables integrated out.

    Raises `FactorError` for a key that the graph lacks, `SingularSystemError` when the system is not determined.
    """
    wanted = checked_keys("keys", keys)
    _present(graph, wanted)
    remaining = marginal_factors(graph, set(graph.keyVector()) - set(wanted), elimination)
    if set(wanted) - set(remaining.keyVector()):  # nothing is left that speaks of them
        raise singular_system(graph)
    try:
        root, mean = _solve(remaining, gtsam.Ordering(list(wanted)), elimination)
    except np.linalg.LinAlgError as error:
        raise singular_system(graph, error) from error
    return mean, root @ root.T


def block_covariances(tree: gtsam.GaussianBayesTree, dims: Mapping[int, int]) -> dict[int, FloatArray]:
    """Return the covariances (d, d) of all variables, one by one, in one pass from the roots of a tree to its leaves.

    dims: of the variables. With x_F = R^-1 (d - S x_S) for the frontal variables of a clique and its separator,

        G = -R^-1 S,     Sigma_FS = G Sigma_SS,     Sigma_FF = R^-1 R^-T + G Sigma_SS G^T

    The separator is part of the clique above, so that nothing but the blocks of the tree is ever computed (Takahashi,
    Fagan, Chin 1973; Kaess and Dellaert, Robotics and Autonomous Systems 2009). Raises `FactorError` for a tree whose
    variables have other dimensions, and for hard constraints.
    """
    found: dict[int, FloatArray] = {}
    waiting = [(clique, np.empty((0, 0)), dict[int, slice]()) for clique in tree.roots()]
    while waiting:
        clique, above, place = waiting.pop()
        conditional = clique.conditional()
        noise = conditional.get_model()
        if noise is not None and noise.isConstrained():
            raise FactorError("noise: expected variance in all directions, got a hard constraint")
        keys, R = list(conditional.keys()), conditional.R()
        ends = np.cumsum([0, *(dims.get(key, 0) for key in keys)])
        count = int(np.searchsorted(ends, len(R)))
        if ends[-1] != len(R) + conditional.S().shape[1] or ends[count] != len(R):
            raise FactorError(f"dims: expected the dimensions of {format_keys(keys)}")
        rows = np.r_[tuple(place[key] for key in keys[count:])] if len(keys) > count else np.empty(0, dtype=np.int64)
        of_separator, inverse = above[rows[:, None], rows], np.linalg.inv(R)
        G = -inverse @ conditional.S()
        across = G @ of_separator
        joint = np.block([[inverse @ inverse.T + across @ G.T, across], [across.T, of_separator]])
        place = {key: slice(start, stop) for key, start, stop in zip(keys, ends[:-1], ends[1:], strict=True)}
        found.update({key: joint[place[key], place[key]] for key in keys[:count]})
        waiting += [(clique[k], joint, place) for k in range(clique.nrChildren())]
    return found


def _solve(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, elimination: Elimination
) -> tuple[FloatArray, FloatArray]:
    """Return a root S of the covariance S S^T, and the mean; raise LinAlgError when there is none."""
    if elimination == "cholesky":
        information, vector = graph.hessian(ordering)
        root = np.linalg.inv(np.linalg.cholesky(information)).T
        return root, root @ (root.T @ vector)
    A, b = graph.jacobian(ordering)
    dim = A.shape[1]
    triangle: FloatArray = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"), dtype=np.float64)
    pivots = np.abs(np.diagonal(triangle)[:dim])
    if len(pivots) < dim or (pivots <= dim * np.finfo(float).eps * pivots.max()).any():
        raise np.linalg.LinAlgError("rank deficient")
    root = np.asarray(np.linalg.inv(triangle[:dim, :dim]))
    return root, root @ triangle[:dim, dim]


def _checked(elimination: str) -> str:
    if elimination not in get_args(Elimination):
        raise FactorError(f"elimination: expected one of {', '.join(get_args(Elimination))}, got {elimination!r}")
    return elimination


def _present(graph: gtsam.GaussianFactorGraph, keys: tuple[int, ...]) -> None:
    known = set(graph.keyVector())
    missing = [key for key in keys if key not in known]
    if missing:
        raise FactorError(f"the graph has no variable {format_keys(missing)}")
