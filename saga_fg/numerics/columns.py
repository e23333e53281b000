"""Tables that are held by columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from saga_fg.numerics.arrays import BoolArray, IntArray


class Columns:
    """For dataclasses whose fields are arrays (n, ...), or other tables, row by row of the same n things.

    A field that is neither belongs to the whole table, and is the same in every selection.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def select(self, rows: IntArray | BoolArray | slice | Sequence[int]) -> Self:
        """The rows of a mask, of row indices or of a slice."""
        if isinstance(rows, slice):
            return self._each(lambda column: column[rows])
        index = np.asarray(rows, dtype=None if len(rows) else np.int64)
        if index.dtype == np.bool_:
            if len(index) != len(self):
                raise IndexError(f"expected a mask of {len(self)} rows, got {len(index)}")
            index = index.nonzero()[0]
        return self._each(lambda column: column[index])

    def copied(self) -> Self:
        """A table of the same rows that shares no array with this one that can be written."""
        return self._each(lambda column: column.copy() if column.flags.writeable else column)

    def _each(self, change: Callable[[Any], Any]) -> Self:
        """The table with its arrays changed: rows of a validated table, nothing to check again."""
        mine, changed = vars(self), object.__new__(type(self))
        for name in self.__dataclass_fields__:
            column = mine[name]
            if isinstance(column, np.ndarray):  # anything else belongs to the whole table, or is one
                column = _frozen_names(change(column))
            elif isinstance(column, Columns):
                column = column._each(change)
            vars(changed)[name] = column
        return changed

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, of which there is one at least, in order."""
        columns = ([getattr(part, name) for part in parts] for name in cls.__dataclass_fields__)
        return cls(*map(_concatenated, columns))

    def append(self, other: Self) -> Self:
        """With the rows of another at the end."""
        return self.concatenate([self, other])


def _concatenated(columns: Sequence[Any]) -> Any:
    first = columns[0]
    if isinstance(first, tuple):
        return first
    return first.concatenate(columns) if isinstance(first, Columns) else _frozen_names(np.concatenate(columns))


def _frozen_names(column: NDArray[Any]) -> NDArray[Any]:
    """A column that nobody else has, read-only if it has strings: they are replaced as a whole, and looked up often."""
    if column.dtype.kind == "U":
        column.flags.writeable = False
    return column
