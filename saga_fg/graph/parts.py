"""What a running graph is made of: variables to add, groups of factors with their providers, and factors in words."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.graph.factor_groups import FactorGroup, PriorGroup
from saga_fg.graph.keys import Kind
from saga_fg.graph.variables import GraphVariable
from saga_fg.numerics.arrays import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class NewVariable:
    """A variable to add: state: where it is to begin with; static: one for all time; label: a word for it, by default
    the kind's; type: of the state, by default a vector, pose or plane as the state is.
    """

    kind: Kind
    id: int
    state: Any
    static: bool = False
    label: str = ""
    type: Any = None


@dataclass(frozen=True)
class FactorEntry:
    """A factor of the graph in words: who gave it, its kind, and its variables."""

    provider: str
    kind: str
    variables: tuple[GraphVariable, ...]

    def __str__(self) -> str:
        return f"{self.kind} on {', '.join(map(str, self.variables))} (provider {self.provider})"


@dataclass(frozen=True, eq=False)
class HeldGroup:
    """Factors in the graph: who gave them, under which name if any, and which rows (n,) are still there."""

    provider: str
    name: Hashable
    factors: FactorGroup
    active: BoolArray

    @property
    def rows(self) -> IntArray:
        """The rows that are there."""
        return np.flatnonzero(self.active)

    @property
    def sharpness(self) -> tuple[bool, int]:
        """Where to put the group among others: what is likely to have the least noise first.

        Householder's QR loses what rows of small numbers say where rows of large ones come after them: with intervals
        of a millisecond, whose interactions have next to no noise, three to five digits.
        """
        return isinstance(self.factors, PriorGroup), -max(map(len, self.factors.rows))
