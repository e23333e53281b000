"""What stands for variables that are marginalised, where a linear prior would not do.

A prior is linear on increments from where the variables were, and true near there alone. A submap that moves by metres,
as a whole, when a loop closes, needs factors that move along.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam

from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.linearisation_point import LinearisationPoint


class Condensation(Protocol):
    """Makes factors of what marginalised variables leave; `name` stands for their provider, and for the factors."""

    @property
    def name(self) -> str: ...

    @property
    def anchor(self) -> int:
        """A variable that leaves with the others, but is in the marginal. What a condensation of this name gave for it
        earlier is handed over apart."""

    def factors(
        self,
        marginal: Sequence[gtsam.JacobianFactor],
        earlier: Sequence[gtsam.JacobianFactor],
        point: LinearisationPoint,
    ) -> Sequence[Factor]:
        """Return factors in place of both, which are on increments from the base, linearised at `point`."""
