"""Validated arrays, and tables that are held by columns.

Validation of arrays at construction: convert once, check once, freeze.

Every public value type funnels its arrays through `checked`, so that nothing of a wrong shape, with a NaN where a
number is needed, ever reaches the numerics (or GTSAM, which would crash the interpreter).
"""

import weakref
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from saga_fg.errors import InputError
from saga_fg.kernels.compilation import BoolArray as BoolArray
from saga_fg.kernels.compilation import FloatArray as FloatArray
from saga_fg.kernels.compilation import IntArray as IntArray
from saga_fg.kernels.compilation import StrArray as StrArray
from saga_fg.kernels.components import numbered_rows

Values = Literal["finite", "finite-or-nan", "any"]
_MAX_INT64 = np.iinfo(np.int64).max
T = TypeVar("T")


def checked(name: str, value: ArrayLike, shape: tuple[int | None, ...], values: Values = "finite") -> FloatArray:
    """Return `value` as a read-only float64 array of `shape` (None: any length).

    An empty list stands for no rows. Raises `InputError` naming the array, the offending entry and what was expected.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind == "c":
            raise TypeError("complex")
        array = np.array(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected numbers, got {_short(value)}") from error
    if array.shape == (0,) and not shape[0]:
        array = array.reshape((0, *(n or 0 for n in shape[1:])))
    if array.shape != shape and not _fits(array.shape, shape):
        raise InputError(f"{name}: expected shape {_shape(shape)}, got {array.shape}")
    if values != "any":
        bad = ~np.isfinite(array) if values == "finite" else np.isinf(array)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            expected = "a finite number" if values == "finite" else "a finite number, or NaN for unknown"
            raise InputError(f"{name}{list(where)}: expected {expected}, got {array[where]}")
    array.flags.writeable = False
    return array


def refuse(bad: BoolArray | np.bool_, fault: Callable[[int], InputError]) -> None:
    """Raise the error about the first of the rows (N,) that are bad, if there is one."""
    if bad.any():
        raise fault(int(np.argmax(bad)))


def unchecked(kind: type[T], **values: Any) -> T:
    """A dataclass of values that were checked where they came in, or made inside: all its fields, as they are."""
    made = object.__new__(kind)
    made.__dict__.update(values)
    return made


def shallow_copy(value: T) -> T:
    """A copy of an object that has nothing but attributes, which both share."""
    twin = object.__new__(type(value))
    twin.__dict__.update(value.__dict__)
    return twin


def checked_covariances(name: str, value: ArrayLike, count: int, dim: int) -> FloatArray:
    """Return `value` as read-only symmetric positive definite matrices (count, dim, dim).

    What is off symmetry by rounding is made symmetric; what is singular to within rounding is refused.
    """
    P = checked(name, value, (count, dim, dim))
    scale = np.sqrt(np.abs(np.diagonal(P, axis1=1, axis2=2)))
    asymmetric = np.abs(P - np.swapaxes(P, 1, 2)) > 1e-9 * scale[:, :, None] * scale[:, None, :]
    if asymmetric.any():
        raise InputError(f"{name}[{int(np.argwhere(asymmetric)[0][0])}]: expected a symmetric matrix")
    P = (P + np.swapaxes(P, 1, 2)) / 2
    try:
        pivots = np.diagonal(np.linalg.cholesky(P), axis1=1, axis2=2)
        margin = (pivots - 1e-7 * scale).min(axis=1, initial=np.inf)
        singular = bool((margin <= 0).any())
    except np.linalg.LinAlgError:
        margin, singular = np.linalg.eigvalsh(P)[:, 0], True
    if singular:
        row = int(np.argmin(margin))
        raise InputError(f"{name}[{row}]: expected a positive definite matrix, got {_short(P[row].tolist())}")
    P.flags.writeable = False
    return P


def checked_labels(name: str, value: Any, length: int | None = None) -> StrArray:
    """Return `value` as a read-only array of non-empty strings of shape (length,)."""
    array = _listed(value)
    if array.size == 0:
        array = np.empty(0, dtype="<U1")
    if array.dtype.kind != "U" or array.ndim != 1:
        raise InputError(f"{name}: expected a list of strings, got {_short(value)}")
    if length is not None and len(array) != length:
        raise InputError(f"{name}: expected {length} entries, got {len(array)}")
    if (array == "").any():
        raise InputError(f"{name}[{int(np.argmax(array == ''))}]: expected a name, got an empty string")
    array = array.copy()
    array.flags.writeable = False
    return array


def checked_ids(name: str, value: ArrayLike, length: int | None = None) -> IntArray:
    """Return `value` as a read-only int64 array of unique entries, of shape (length,)."""
    array = checked_rows(name, value, length)
    if (array[1:] > array[:-1]).all():  # ascending, as ids are given out
        return array
    unique, counts = np.unique(array, return_counts=True)
    if len(unique) != len(array):
        raise InputError(f"{name}: expected unique ids, {int(unique[counts > 1][0])} occurs more than once")
    return array


def checked_rows(name: str, value: ArrayLike, length: int | None = None) -> IntArray:
    """Return `value` as a read-only int64 array of shape (length,); entries may repeat."""
    array = _listed(value)
    if array.size == 0:
        array = np.empty(0, dtype=np.int64)
    if array.dtype.kind not in "iu" or array.ndim != 1 or (array.dtype.kind == "u" and (array > _MAX_INT64).any()):
        raise InputError(f"{name}: expected a list of integers, got {_short(value)}")
    if length is not None and len(array) != length:
        raise InputError(f"{name}: expected {length} entries, got {len(array)}")
    array = array.astype(np.int64)
    array.flags.writeable = False
    return array


def _listed(value: Any) -> NDArray[Any]:
    """`value` as an array of whatever kind; nested lists of different lengths as one of objects."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.asarray(value, dtype=object)


def _fits(got: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(got) == len(shape) and all(n is None or n == m for n, m in zip(shape, got, strict=True))


def _shape(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def upper_triangle(P: FloatArray) -> FloatArray:
    """Symmetric matrices (N, 2, 2) as their entries (N, 3): xx, xy, yy."""
    return np.stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]], axis=-1)


def from_upper_triangle(entries: FloatArray) -> FloatArray:
    """The symmetric matrices (N, 2, 2) of entries (N, 3): xx, xy, yy."""
    return entries[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def distinct(label: StrArray) -> tuple[tuple[str, ...], IntArray]:
    """The labels that occur, in order of appearance, and the number (n,) of each row's among them, read-only.

    A read-only array is looked up when it is asked for again.
    """
    known = _of_array.get(id(label))
    if known is not None and known[0]() is label:
        return known[1]
    found = _numbered(label)
    if not label.flags.writeable and _unchanging(label.base):
        key = id(label)
        _of_array[key] = weakref.ref(label, lambda _: _of_array.pop(key, None)), found
    return found


def _unchanging(base: object) -> bool:
    """True for what an array is a view of where nobody can write to it."""
    return base is None or (isinstance(base, np.ndarray) and not base.flags.writeable and base.base is None)


_Distinct = tuple[tuple[str, ...], IntArray]
_NO_ROWS: IntArray = np.empty(0, dtype=np.int64)
_NO_ROWS.flags.writeable = False
_of_array: dict[int, tuple[weakref.ref[StrArray], _Distinct]] = {}  # by id, while the array lives


def _numbered(label: StrArray) -> _Distinct:
    if len(label) == 0:
        return (), _NO_ROWS
    number, first = numbered_rows(np.ascontiguousarray(label).view(np.uint32).reshape(len(label), -1))
    number.flags.writeable = False
    return tuple(label[first].tolist()), number


def common_numbers(*labels: StrArray, alias: Mapping[str, str] | None = None) -> list[IntArray]:
    """Numbers (n,) of the classes of several arrays of labels (n,), the same in all of them; alias: other names."""
    known = alias or {}
    number: dict[str, int] = {}
    found = []
    for label in labels:
        names, of_row = distinct(label)
        found.append(
            np.array([number.setdefault(known.get(name, name), len(number)) for name in names], dtype=np.int64)[of_row]
        )
    return found


def of_classes(label: StrArray, classes: Container[str]) -> BoolArray:
    """(n,) which labels are among `classes`."""
    names, index = distinct(label)
    return np.array([name in classes for name in names], dtype=bool)[index]


class Columns:
    """For dataclasses whose fields are arrays (n, ...), or other tables, row by row of the same n things.

    A field that is neither belongs to the whole table, and is the same in every selection.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int:
        return len(self.__dict__[next(iter(self.__dataclass_fields__))])

    def check_lengths(self) -> None:
        """Raise `InputError` unless all columns have as many rows as the first."""
        for name in self.__dataclass_fields__:
            column = getattr(self, name)
            if isinstance(column, np.ndarray | Columns) and len(column) != len(self):
                raise InputError(f"{type(self).__name__}.{name}: expected {len(self)} rows, got {len(column)}")

    def select(self, rows: IntArray | BoolArray | slice | Sequence[int]) -> Self:
        """The rows of a mask, of row indices or of a slice."""
        if isinstance(rows, slice):
            return self._rows(rows)
        index = np.asarray(rows, dtype=None if len(rows) else np.int64)
        if index.dtype == np.bool_:
            if len(index) != len(self):
                raise IndexError(f"expected a mask of {len(self)} rows, got {len(index)}")
            index = index.nonzero()[0]
        return self._rows(index)

    def _rows(self, rows: Any) -> Self:
        """The rows of a validated table: nothing to check again."""
        mine, chosen = self.__dict__, object.__new__(type(self))
        columns = chosen.__dict__
        for name in self.__dataclass_fields__:
            column = mine[name]
            if isinstance(column, np.ndarray):  # anything else belongs to the whole table, or is one
                matrix = column.ndim > 1 and not isinstance(rows, slice)
                column = column.take(rows, 0) if matrix else column[rows]  # each the fastest of its kind
                if column.dtype.char == "U":
                    column.flags.writeable = False  # strings are replaced as a whole, and looked up often
            elif isinstance(column, Columns):
                column = column._rows(rows)
            columns[name] = column
        return chosen

    def copied(self) -> Self:
        """A table of the same rows that shares no array with this one that can be written."""
        twin = object.__new__(type(self))
        columns = twin.__dict__
        for name in self.__dataclass_fields__:
            column = self.__dict__[name]
            if isinstance(column, np.ndarray):
                column = column.copy() if column.flags.writeable else column
            elif isinstance(column, Columns):
                column = column.copied()
            columns[name] = column
        return twin

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, of which there is one at least, in order; nothing is checked again."""
        tables, whole = [part.__dict__ for part in parts], object.__new__(cls)
        columns = whole.__dict__
        for name in cls.__dataclass_fields__:
            column = tables[0][name]
            if isinstance(column, np.ndarray):
                column = np.concatenate([table[name] for table in tables])
                if column.dtype.char == "U":
                    column.flags.writeable = False
            elif isinstance(column, Columns):
                column = column.concatenate([table[name] for table in tables])
            columns[name] = column
        return whole

    def append(self, other: Self) -> Self:
        """With the rows of another at the end."""
        return self.concatenate([self, other])
