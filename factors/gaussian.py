"""Linear Gaussian factors: priors, interactions, marginals, and what a singular system leaves undetermined.

Linear Gaussian factors of any number of variables, native to GTSAM.

    phi(x) = exp( -1/2 || sum_k A_k x_k - b ||_R^2 )

GTSAM keeps it whitened as one block matrix [W A_1 ... W A_n | W b], W R W^T = 1. From Python its `JacobianFactor` takes
three variables at most; a `GaussianConditional` without frontal variables takes any number, and its clone is a plain
`JacobianFactor`. Handing the block matrix over whole costs half of handing it over block by block.

Priors of a variable, or of several together, are phi(x) = || x - m ||_P^2.

Marginalisation of variables: Gaussian factors that keep their information on the others.

    phi(x_b) = max_{x_a} prod phi(x_a, x_b)        ||A_a x_a + A_b x_b - b||^2  ->  ||(Q_2^T A_b) x_b - Q_2^T b||^2

with Q_2 the part of the QR factor of A_a that is orthogonal to it; for Gaussians this is the integral over x_a, up to a
constant. A node that disappears is marginalised, never just deleted together with its factors.

Two eliminations, both GTSAM's. "cholesky" works on the information matrix A^T A, whose condition number is the square
of A's; "qr" works on A itself. Over a hundred steps of five coupled nodes at coordinates of 1000 m, measured to 0.1 m
ten times a second, Cholesky's means come to lie 2e-9 posterior sigmas from those of a covariance filter at an
acceleration noise of 0.1 m^2/s^3, 2e-6 at 1e-4 and 4e-2 at 1e-8; QR's 1e-10, 1e-8 and 8e-7. QR takes half as long again
on small components, and up to twenty times as long on a large, densely connected graph. Increments from a point nearby,
in place of coordinates, shrink both errors alike.

Variables that a singular linear system leaves undetermined.

GTSAM names the one variable at which elimination broke down, which depends on the ordering and is often an innocent
neighbour. The undetermined directions are the null space of the information matrix Lambda = A^T A. Scaled to a unit
diagonal, D^-1/2 Lambda D^-1/2, so that units do not matter, its eigenvectors of eigenvalue zero say which variables can
move without any factor noticing.

Interactions: a node's next state is an affine combination of its own state and its neighbours' (Sani et al., SAGA-KF,
ICPR 2024):

    x_i(t+dt) = sum_j F_ij x_j(t) + b_i + q_i,    q_i ~ N(0, Q_i)

    phi  =  || x_i(t+dt) - sum_j F_ij x_j(t) - b_i ||_{Q_i}^2      one factor a node and step

The sum runs over the node itself and its neighbours, who may have states of other dimensions. The factors are native
GTSAM Jacobian factors: nothing calls back into Python while a solver runs. A nonlinear one,
x_i(t+dt) = f( x_i(t), [x_j(t)], dt ) + q_i, is a residual of `factors.ResidualFactors`.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.validation import (
    FactorError,
    FloatArray,
    KeyArray,
    SingularSystemError,
    checked,
    checked_covariances,
    checked_key_array,
    checked_key_rows,
    checked_keys,
    format_key,
    format_keys,
    whiteners,
)


def gaussian_factor(
    keys: Iterable[int], blocks: Sequence[ArrayLike], rhs: ArrayLike, covariance: ArrayLike | None = None
) -> gtsam.JacobianFactor:
    """Return the factor || sum_k blocks[k] x_k - rhs ||_covariance.

    keys: n distinct keys, in any order; blocks[k]: (m, d_k); rhs: (m,); covariance: (m, m), None for the identity.
    Raises `FactorError` when shapes disagree, a number is not finite, or the covariance is not positive definite.
    """
    b = checked("rhs", rhs, (None,))
    matrices = [checked(f"blocks[{k}]", block, (len(b), None))[None] for k, block in enumerate(blocks)]
    noise = np.eye(len(b)) if covariance is None else checked("covariance", covariance, (len(b), len(b)))
    (factor,) = gaussian_factors([checked_keys("keys", keys)], matrices, b[None], noise).native()
    return factor


@dataclass(frozen=True, eq=False)
class GaussianFactors:
    """n linear factors of one shape, || sum_k A_ik x(rows[i, k]) - b_i ||^2, whitened, as arrays.

    rows: keys (n, k), distinct within a row; dims: of the k variables; augmented (n, sum(dims) + 1, m): each factor's
    [A_i1 ... A_ik | b_i] transposed, so that it is column-major, as GTSAM wants it
    """

    rows: KeyArray
    dims: tuple[int, ...]
    augmented: FloatArray

    @property
    def keys(self) -> list[int]:
        """All keys, with repetitions."""
        return list(self.rows.ravel().tolist())

    def native(
        self, origins: FloatArray | None = None, chosen: Sequence[int] | None = None
    ) -> list[gtsam.JacobianFactor]:
        """Return them as GTSAM's; on increments from `origins` (n, sum(dims)) of their variables; some, if `chosen`."""
        augmented = self.augmented
        if origins is not None:
            augmented = augmented.copy()
            augmented[:, -1] -= (origins[:, None] @ augmented[:, :-1])[:, 0]
        rows, matrices = self.rows.tolist(), augmented.swapaxes(1, 2)
        which = range(len(rows)) if chosen is None else chosen
        return [native_factor(rows[i], self.dims, matrices[i]) for i in which]


def gaussian_factors(
    keys: ArrayLike, blocks: Sequence[ArrayLike], rhs: ArrayLike, covariances: ArrayLike
) -> GaussianFactors:
    """Return n factors of the same shape, || sum_k `blocks[k][i]` x(keys[i, k]) - rhs[i] ||_covariances[i], i = 1..n.

    keys: (n, k), distinct within a row; blocks[k]: (n, m, d_k); rhs: (n, m); covariances: (n, m, m) or one (m, m) for
    all. Whitening and checks are done for all at once, which is what makes them cheap. Raises `FactorError`.
    """
    b = checked("rhs", rhs, (None, None))
    n, m = b.shape
    names = checked_key_rows("keys", keys, len(blocks))
    if len(names) != n:
        raise FactorError(f"keys: expected {n} rows, one per factor, got {len(names)}")
    matrices = [checked(f"blocks[{k}]", block, (n, m, None)) for k, block in enumerate(blocks)]
    W = whiteners("covariances", checked_covariances("covariances", covariances, n, m))
    return whitened_factors(names, W, matrices, b)


def prior_factor(key: int, mean: ArrayLike, covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return the factor || x(key) - mean ||_covariance; mean: (d,), covariance: (d, d), positive definite."""
    return joint_prior_factor([key], [mean], covariance)


def prior_factors(keys: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> GaussianFactors:
    """Return one prior a key; keys: (n,); means: (n, d); covariances: (n, d, d), or one (d, d) for all."""
    centers = checked("means", means, (None, None))
    names = checked_key_array("keys", keys)
    checked_keys("keys", names.tolist())
    identity = np.broadcast_to(np.eye(centers.shape[1]), (*centers.shape, centers.shape[1]))
    return gaussian_factors(names[:, None], [identity], centers, covariances)


def joint_prior_factor(keys: Iterable[int], means: Sequence[ArrayLike], covariance: ArrayLike) -> gtsam.JacobianFactor:
    """Return one factor on all `keys` from their joint covariance: what a filter knows of the past, in one factor.

    means: one vector (d_k,) a key; covariance: (D, D) with D = sum_k d_k, in the order of the keys, positive definite.
    Raises `FactorError` on anything else.
    """
    vectors = [checked("means", mean, (None,)) for mean in means]
    mean = np.concatenate([np.empty(0), *vectors])
    ends = np.cumsum([len(vector) for vector in vectors])
    return gaussian_factor(keys, np.split(np.eye(len(mean)), ends[:-1], axis=1), mean, covariance)


def whitened_factors(keys: KeyArray, W: FloatArray, blocks: Sequence[FloatArray], rhs: FloatArray) -> GaussianFactors:
    """Return the factors || W[i] (sum_k blocks[k][i] x(keys[i, k]) - rhs[i]) ||^2 of `gaussian_factors`.

    Unchecked, except for empty blocks: keys distinct within a row, shapes and numbers right.
    """
    dims = tuple(block.shape[2] for block in blocks)
    n, m = rhs.shape
    if n and (m == 0 or 0 in dims):
        raise FactorError("blocks: expected at least one row, and one column per block")
    augmented = np.empty((n, sum(dims) + 1, m))
    column = 0
    for block, dim in zip(blocks, dims, strict=True):
        np.matmul(block.swapaxes(1, 2), W.swapaxes(1, 2), out=augmented[:, column : column + dim])
        column += dim
    np.matmul(W, rhs[:, :, None], out=augmented[:, -1, :, None])
    return GaussianFactors(keys, dims, augmented)


def native_factor(keys: Sequence[int], dims: Sequence[int], augmented: FloatArray) -> gtsam.JacobianFactor:
    """Return the factor of the whitened block matrix [A_1 ... A_n | b], of shape (m, sum(dims) + 1).

    Unchecked, for inner loops: keys distinct, dims positive, entries finite. Column-major matrices are copied fastest.
    """
    matrix = gtsam.VerticalBlockMatrix(dims, augmented, True)
    factor: gtsam.JacobianFactor = gtsam.GaussianConditional(keys, 0, matrix).clone()  # type: ignore[assignment]
    return factor


def gaussian_graph(factors: Iterable[gtsam.GaussianFactor]) -> gtsam.GaussianFactorGraph:
    """Return a graph that shares these factors."""
    graph = gtsam.GaussianFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def nonlinear_graph(factors: Iterable[gtsam.GaussianFactor], dims: Mapping[int, int]) -> gtsam.NonlinearFactorGraph:
    """Wrap linear factors on vector variables for nonlinear solvers and iSAM2.

    dims: the dimension of every key. GTSAM's `LinearContainerFactor` without a linearisation point is silently wrong in
    iSAM2, so these get one, at zero: there the factors speak of the variables themselves, not of increments.
    Raises `FactorError` for a key whose dimension is missing or contradicts its factor.
    """
    point = gtsam.Values()
    for key, dim in dims.items():
        point.insert(key, np.zeros(dim))
    return nonlinear_graph_at(factors, point)


def nonlinear_graph_at(factors: Iterable[gtsam.GaussianFactor], point: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Wrap linear factors on increments from `point` (as `NonlinearFactorGraph.linearize(point)` gives them).

    The variables may be of any type. Raises `FactorError` for a key that `point` lacks or holds in another dimension.
    """
    linear = gaussian_graph(factors)
    check_dimensions(map(linear.at, range(linear.size())), point.dims())
    return gtsam.LinearContainerFactor.ConvertLinearGraph(linear, point)


def check_dimensions(factors: Iterable[gtsam.GaussianFactor], dims: Mapping[int, int]) -> None:
    """Raise `FactorError` for a factor whose columns are not as many as its variables' dimensions, or unknown."""
    for factor in factors:
        keys = factor.keys()
        try:
            total = sum([dims[key] for key in keys])
        except KeyError as error:
            raise FactorError(f"{format_key(error.args[0])}: expected its dimension to be known") from error
        width = (factor.cols() if isinstance(factor, gtsam.JacobianFactor) else factor.information().shape[0] + 1) - 1
        if total != width:
            raise FactorError(
                f"the factor on {format_keys(keys)} has {width} columns, but these variables have {total} dimensions"
            )


_LARGEST = 3000  # dimensions: beyond, the eigenvalues would take minutes
_ZERO = 1e-11  # eigenvalue relative to the unit diagonal
_SHARE = 1e-2  # share of a variable in the null space above which it is named


def singular_system(graph: gtsam.GaussianFactorGraph, cause: Exception | None = None) -> FactorError:
    """Return the exception that explains why `graph` cannot be solved; `cause` is what the solver said, if anything.

    A `SingularSystemError` naming the undetermined variables, or a `FactorError` naming those whose factors hold
    numbers that are not finite.
    """
    steps = graph.gradientAtZero()  # one vector a key: the only way to learn the dimensions
    keys = [int(key) for key in graph.keyVector()]
    dims = [int(steps.dim(key)) for key in keys]
    if sum(dims) > _LARGEST:
        return _unresolved(cause or _complaint(graph))
    information, vector = graph.hessian(gtsam.Ordering(keys))
    owner = np.repeat(np.arange(len(keys)), dims)
    broken = ~(np.isfinite(information).all(axis=1) & np.isfinite(vector))
    if broken.any():
        concerned = _owners(keys, owner, broken.astype(float))
        return FactorError(f"factors on {format_keys(concerned)} hold numbers that are not finite")
    concerned = _owners(keys, owner, _freedom(information))
    if not concerned:
        return SingularSystemError("the linear system is too badly conditioned to be solved")
    return SingularSystemError(
        f"the linear system does not determine {format_keys(concerned)}; add factors, or a prior, that do",
        concerned,
    )


def _complaint(graph: gtsam.GaussianFactorGraph) -> Exception | None:
    try:
        graph.optimize()
    except RuntimeError as error:
        return error
    return None


def _unresolved(cause: Exception | None) -> FactorError:
    near = re.search(r"near variable\s+(\d+)", str(cause))
    if near is None:
        return FactorError("the linear system cannot be solved: its factors hold numbers that are not finite")
    key = int(near[1])
    return SingularSystemError(
        f"the linear system does not determine all variables: elimination stopped near {format_key(key)}", (key,)
    )


def _freedom(information: FloatArray) -> FloatArray:
    """Return for each dimension its share in the null space, from 0 to 1."""
    scale = np.sqrt(np.diagonal(information))
    scale[scale == 0] = 1.0
    eigenvalues, vectors = np.linalg.eigh(information / scale[:, None] / scale)
    null: FloatArray = vectors[:, eigenvalues < _ZERO * max(1.0, len(scale) ** 0.5)]
    return np.asarray((null**2).sum(axis=1))


def _owners(
    keys: list[int], owner: np.ndarray[tuple[int, ...], np.dtype[np.int64]], share: FloatArray
) -> tuple[int, ...]:
    total = np.zeros(len(keys))
    np.maximum.at(total, owner, share)
    return tuple(keys[i] for i in np.flatnonzero(total > _SHARE))


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


def interaction_factor(
    next_key: int, keys: Iterable[int], F: Sequence[ArrayLike], b: ArrayLike, Q: ArrayLike
) -> gtsam.JacobianFactor:
    """Return the factor || x(next_key) - sum_j F[j] x(keys[j]) - b ||_Q.

    next_key: the node at t+dt; keys: the node itself and its neighbours at t, in any order; F[j]: (d, d_j); b: (d,);
    Q: (d, d), positive definite. Raises `FactorError` on anything else.
    """
    offset = checked("b", b, (None,))
    transitions = [checked("F", block, (len(offset), None)) for block in F]
    return gaussian_factor([next_key, *keys], [np.eye(len(offset)), *(-block for block in transitions)], offset, Q)


def interaction_factors(
    next_keys: ArrayLike, keys: ArrayLike, indptr: ArrayLike, F: ArrayLike, b: ArrayLike, Q: ArrayLike
) -> list[GaussianFactors]:
    """Return the factors of a whole step, one a node, from arrays in block compressed rows.

    Those with equally many neighbours are together. Node i owns the entries indptr[i] to indptr[i+1] of `keys` and `F`:
    keys (nnz,) of the states at t and blocks F (nnz, d, e). next_keys: (n,); indptr: (n+1,); b: (n, d); Q: (n, d, d),
    each positive definite. Nodes of another dimension, or who listen to some, go into a call of their own, or through
    `interaction_factor`. Raises `FactorError`, naming the node, when shapes disagree, a key occurs twice in one factor,
    a number is not finite or a Q is singular.
    """
    nexts = checked_key_array("next_keys", next_keys)
    previous = checked_key_array("keys", keys)
    checked_keys("next_keys", nexts.tolist())
    offsets = checked("b", b, (len(nexts), None))
    d = offsets.shape[1]
    blocks = checked("F", F, (len(previous), d, None))
    starts, degrees = _rows(indptr, len(nexts), len(previous))
    if not len(nexts):
        return []
    W = whiteners("Q", checked("Q", Q, (len(nexts), d, d)))

    stacks, sharpest = [], np.argsort(-np.abs(W).max(axis=(1, 2)), kind="stable")
    for degree in np.unique(degrees).tolist():  # factors of one shape together, the sharpest first
        rows = sharpest[degrees[sharpest] == degree]
        entries = starts[rows, None] + np.arange(degree)
        names = checked_key_rows("keys", np.concatenate([nexts[rows, None], previous[entries]], axis=1), 1 + degree)
        identity = np.broadcast_to(np.eye(d), (len(rows), d, d))
        own = [identity, *(-blocks[column] for column in entries.T)]
        stacks.append(whitened_factors(names, W[rows], own, offsets[rows]))
    return stacks


def _rows(indptr: ArrayLike, nodes: int, entries: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    pointers = np.asarray(indptr)
    if pointers.shape != (nodes + 1,) or pointers.dtype.kind not in "iu":
        raise FactorError(f"indptr: expected {nodes + 1} integers, got shape {pointers.shape}")
    pointers = pointers.astype(np.int64)
    degrees = np.diff(pointers)
    if pointers[0] != 0 or pointers[-1] != entries or (degrees < 0).any():
        raise FactorError(f"indptr: expected to rise from 0 to the number of entries, {entries}")
    return pointers[:-1], degrees
