"""Tables that are held by columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, IntArray


class Columns:
    """For dataclasses whose fields are arrays (n, ...), or other tables, row by row of the same n things."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def select(self, rows: IntArray | BoolArray | slice | Sequence[int]) -> Self:
        """The rows of a mask, of row indices or of a slice."""
        index: Any = rows if isinstance(rows, slice) else np.asarray(rows, dtype=None if len(rows) else np.int64)
        chosen: Self = object.__new__(type(self))  # rows of a validated table: nothing to check again
        for name in self.__dataclass_fields__:
            column = getattr(self, name)
            object.__setattr__(chosen, name, column.select(index) if isinstance(column, Columns) else column[index])
        return chosen

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, of which there is one at least, in order."""
        columns = ([getattr(part, name) for part in parts] for name in cls.__dataclass_fields__)
        return cls(*(c[0].concatenate(c) if isinstance(c[0], Columns) else np.concatenate(c) for c in columns))

    def extended(self, other: Self) -> Self:
        """With the rows of another at the end."""
        return self.concatenate([self, other])
