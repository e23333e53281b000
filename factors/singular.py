"""Variables that a singular linear system leaves undetermined.

GTSAM names the one variable at which elimination broke down, which depends on the ordering and is often an innocent
neighbour. The undetermined directions are the null space of the information matrix Lambda = A^T A. Scaled to a unit
diagonal, D^-1/2 Lambda D^-1/2, so that units do not matter, its eigenvectors of eigenvalue zero say which variables can
move without any factor noticing.
"""

from __future__ import annotations

import re

import gtsam
import numpy as np

from factors.errors import FactorError, SingularSystemError
from factors.validation import FloatArray, format_key, format_keys

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
    share: FloatArray = (null**2).sum(axis=1)
    return share


def _owners(
    keys: list[int], owner: np.ndarray[tuple[int, ...], np.dtype[np.int64]], share: FloatArray
) -> tuple[int, ...]:
    total = np.zeros(len(keys))
    np.maximum.at(total, owner, share)
    return tuple(keys[i] for i in np.flatnonzero(total > _SHARE))
