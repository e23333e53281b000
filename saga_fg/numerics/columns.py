"""Tables that are held by columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, IntArray


class Columns:
    """For dataclasses whose fields are arrays (n, ...), or other tables, row by row of the same n things.

    A field that is neither belongs to the whole table, and is the same in every selection.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int:
        return len(self.__dict__[next(iter(self.__dataclass_fields__))])

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
