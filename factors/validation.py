"""The exceptions of factors, and validation of arrays before GTSAM's C++ sees them.

Validation of arrays before GTSAM's C++, which answers a wrong shape with a crash or a wrong number.

Noise enters a linear factor by whitening. With Q = L L^T (Cholesky) and W = L^-1,

    || r ||_Q^2  =  r^T Q^-1 r  =  || W r ||^2.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray


class FactorError(ValueError):
    """An argument of a factor is not what was expected; the text names which one and what was expected."""


class SingularSystemError(FactorError):
    """A linear system does not determine all of its variables.

    `keys` are the variables concerned, as far as they could be found; the text names them in GTSAM's notation.
    """

    def __init__(self, message: str, keys: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys

    def __reduce__(self) -> tuple[type[SingularSystemError], tuple[str, tuple[int, ...]]]:
        return type(self), (str(self), self.keys)


FloatArray = NDArray[np.float64]
KeyArray = NDArray[np.uint64]

_SYMMETRY = 1e-8  # relative asymmetry that rounding may leave in a covariance


def checked(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """Return `value` as a float64 array of `shape` (None: any length), every entry finite, or raise `FactorError`."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FactorError(f"{name}: expected numbers in a regular array") from error
    if array.shape != shape and not _fits(array.shape, shape):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise FactorError(f"{name}: expected shape ({wanted}), got {array.shape}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise FactorError(f"{name}{list(where)}: expected a finite number, got {array[where]}")
    return array


def checked_keys(name: str, keys: Iterable[int]) -> tuple[int, ...]:
    """Return `keys` as distinct GTSAM keys (integers from 0 to 2^64 - 1), or raise `FactorError`."""
    given = list(keys)
    for key in given:
        if isinstance(key, bool) or not isinstance(key, int | np.integer) or not 0 <= key < 1 << 64:
            raise FactorError(f"{name}: expected integers from 0 to 2^64 - 1, got {key!r}")
    row = np.array([given], dtype=np.uint64)  # at once: of large and small ones NumPy makes floating point numbers
    return tuple(checked_key_rows(name, row, len(given))[0].tolist()) if given else ()


def checked_key_array(name: str, keys: ArrayLike) -> KeyArray:
    """Return `keys` (any shape) as an array of GTSAM keys, not necessarily distinct, or raise `FactorError`."""
    try:
        array = np.asarray(keys)
    except (ValueError, OverflowError) as error:
        raise FactorError(f"{name}: expected rows of the same length, of integers from 0 to 2^64 - 1") from error
    negative = array.dtype.kind == "i" and array.size > 0 and int(array.min()) < 0
    if negative or (array.dtype.kind not in "iu" and array.size > 0):
        raise FactorError(f"{name}: expected integers from 0 to 2^64 - 1")
    return array.astype(np.uint64)


def checked_key_rows(name: str, rows: ArrayLike, columns: int) -> KeyArray:
    """Return `rows` as an array of GTSAM keys (n, columns), distinct in a row, or raise `FactorError`; [] are none."""
    array = checked_key_array(name, rows)
    if array.shape == (0,):
        array = array.reshape(0, columns)
    if array.ndim != 2 or array.shape[1] != columns or not columns:
        raise FactorError(f"{name}: expected shape (any, {columns}), got {array.shape}")
    ordered = np.sort(array, axis=1)
    twice = ordered[:, 1:] == ordered[:, :-1]
    if twice.any():
        row = int(np.argmax(twice.any(axis=1)))
        key = int(ordered[row, 1:][twice[row]][0])
        raise FactorError(f"{name}: {format_key(key)} occurs twice in one factor, the one on {format_keys(array[row])}")
    return array


def whitener(name: str, covariance: ArrayLike, dim: int) -> FloatArray:
    """Return W of shape (dim, dim), upper triangular, with W `covariance` W^T = identity.

    States have positions first, whose noise over an interval is the least. The first row of W is then the sharpest, and
    QR, which goes from the first column on, keeps five digits more than with a lower triangle (P = 800 m^2 of a track
    that nobody sees, Q = 2e-5 m^2: 2e-14 of P in place of 2e-9).
    Raises `FactorError` when the covariance is not symmetric and positive definite (or is so only up to rounding).
    """
    return np.asarray(whiteners(name, checked(name, covariance, (dim, dim))[None])[0])


def whiteners(name: str, covariances: ArrayLike, dim: int | None = None) -> FloatArray:
    """Return the whiteners (n, dim, dim) of a stack of covariances of the same shape; see `whitener`."""
    stack = checked(name, covariances, (None, dim, dim))
    if stack.shape[1] != stack.shape[2]:
        raise FactorError(f"{name}: expected square matrices, got shape {stack.shape[1:]}")
    if stack.shape[1] == 0 or len(stack) == 0:
        return stack
    variances = np.diagonal(stack, axis1=1, axis2=2)
    asymmetric = np.abs(stack - stack.swapaxes(1, 2)).max(axis=(1, 2)) > _SYMMETRY * np.abs(variances).max(axis=1)
    if asymmetric.any():
        raise FactorError(f"{_entry(name, stack, asymmetric)}: expected a symmetric covariance")
    try:
        factor = np.linalg.cholesky(stack[:, ::-1, ::-1])[:, ::-1, ::-1]  # upper: covariance = factor factor^T
    except np.linalg.LinAlgError as error:
        failed = np.linalg.eigvalsh(stack)[:, 0] <= 0
        raise FactorError(_not_definite(_entry(name, stack, failed))) from error
    pivots = np.diagonal(factor, axis1=1, axis2=2) ** 2
    singular = (pivots <= 16 * stack.shape[1] * np.finfo(float).eps * variances).any(axis=1)
    if singular.any():
        raise FactorError(_not_definite(_entry(name, stack, singular)))
    return np.triu(np.linalg.inv(factor))


def checked_covariances(name: str, value: ArrayLike, n: int, dim: int | None) -> FloatArray:
    """Return `value`, n covariances (n, dim, dim) or one for all (dim, dim), as a stack of n or of one."""
    try:
        stack = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FactorError(f"{name}: expected numbers in a regular array") from error
    stack = checked(name, stack[None] if stack.ndim == 2 else stack, (None, dim, dim))
    if len(stack) not in (1, n):
        raise FactorError(f"{name}: expected {n} covariances, got {len(stack)}")
    return stack


def format_key(key: int) -> str:
    """Return the key as people write it: x12 for a GTSAM symbol, the number itself otherwise."""
    letter = chr(int(key) >> 56)  # GTSAM's own formatter fails on what is not a letter
    return f"{letter}{int(key) & (1 << 56) - 1}" if letter.isascii() and letter.isalpha() else str(int(key))


def format_keys(keys: Iterable[int], limit: int = 8) -> str:
    """Return up to `limit` keys, separated by commas, and how many more there are."""
    names = [format_key(key) for key in keys]
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(n in (None, m) for n, m in zip(wanted, shape, strict=True))


def _entry(name: str, stack: FloatArray, bad: NDArray[np.bool_]) -> str:
    return f"{name}[{int(np.argmax(bad))}]" if len(stack) > 1 else name


def _not_definite(name: str) -> str:
    return f"{name}: expected a positive definite covariance, this one is singular or indefinite"
