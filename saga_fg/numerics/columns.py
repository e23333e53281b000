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
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def select(self, rows: IntArray | BoolArray | slice | Sequence[int]) -> Self:
        """The rows of a mask, of row indices or of a slice."""
        index: Any = rows if isinstance(rows, slice) else np.asarray(rows, dtype=None if len(rows) else np.int64)
        chosen: Self = object.__new__(type(self))  # rows of a validated table: nothing to check again
        for name in self.__dataclass_fields__:
            column = getattr(self, name)
            if isinstance(column, Columns):
                column = column.select(index)
            elif isinstance(column, np.ndarray):  # anything else belongs to the whole table
                column = column[index]
            vars(chosen)[name] = column
        return chosen

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
    return first.concatenate(columns) if isinstance(first, Columns) else np.concatenate(columns)
