"""Condensation: nonlinear factors in place of the linear prior that marginalised variables leave.

The prior is linear in increments from the linearisation point, and valid near it only. A closed submap moves by metres
as a whole when a loop closes; its factors have to move with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam

from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.linearisation_point import LinearisationPoint


class Condensation(Protocol):
    """Makes factors of the marginal that eliminated variables leave; `name` is their provider's, and theirs."""

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
