"""The rates and widths of edge rules as parameters: their logarithms, within bounds that keep them sensible.

What a rule has switched off, by an infinite width, stays off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.numerics.arrays import FloatArray

Rule = Following | Neighbours

BOUNDS: Mapping[str, tuple[float, float]] = {
    "rate": (1e-3, 5.0),
    "distance_scale": (0.5, 100.0),
    "gap_scale": (3.0, 100.0),
    "lateral_scale": (0.3, 5.0),
    "heading_scale": (0.05, 3.0),
    "speed_scale": (0.1, 10.0),
}


@dataclass(frozen=True, eq=False)
class RuleParameters:
    """n parameters of some rules: `names` tell rule and setting of each, `start` (n,) logarithms, `bounds` of these."""

    rules: tuple[Rule, ...]
    names: tuple[tuple[int, str], ...]
    start: FloatArray
    bounds: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, rules: Sequence[Rule]) -> Self:
        """All rates and widths that are finite, clipped to their bounds."""
        names = tuple(
            (k, name) for k, rule in enumerate(rules) for name in BOUNDS if math.isfinite(getattr(rule, name, math.inf))
        )
        bounds = tuple((math.log(BOUNDS[name][0]), math.log(BOUNDS[name][1])) for _, name in names)
        values = [math.log(max(getattr(rules[k], name), 1e-9)) for k, name in names]
        return cls(tuple(rules), names, np.clip(values, *np.array(bounds).reshape(-1, 2).T), bounds)

    def valued(self, x: FloatArray) -> list[Rule]:
        """The rules with parameters x (n,)."""
        values: list[dict[str, Any]] = [{} for _ in self.rules]
        for (k, name), value in zip(self.names, np.exp(x), strict=True):
            values[k][name] = float(value)
        return [replace(rule, **changes) for rule, changes in zip(self.rules, values, strict=True)]
