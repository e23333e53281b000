"""Errors pooled over scenes as values, from which medians follow as exactly as means."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import FloatArray, checked


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Errors `values` (N,) in one unit. Every statistic of an empty sample is NaN."""

    values: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", checked("values", self.values, (None,)))

    @classmethod
    def known(cls, values: FloatArray) -> Self:
        """The values that are finite."""
        return cls(values[np.isfinite(values)])

    @classmethod
    def pool(cls, samples: Iterable[ErrorSample]) -> Self:
        """All values of all samples together."""
        return cls(np.concatenate([np.empty(0), *(sample.values for sample in samples)]))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def rmse(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self.values**2))) if len(self) else float("nan")

    @property
    def mean(self) -> float:
        return float(np.mean(self.values)) if len(self) else float("nan")

    @property
    def median(self) -> float:
        return float(np.median(self.values)) if len(self) else float("nan")

    @property
    def square_sums(self) -> tuple[float, float]:
        """(sum of squares, number of values), the sums for a bootstrap of the RMSE."""
        return float(np.sum(self.values**2)), float(len(self))
