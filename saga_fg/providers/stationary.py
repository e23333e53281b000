"""Stationary objects: v ~ N(0, deviation^2 / dt), robust, so that it lets an object go that drives off.

The variance shrinks with the length of the interval, so that a second has the same weight at any rate of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors import ResidualFactors, Robust
from saga_fg.graph.keys import OBJECT
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Positive, Settings, setting

_SURELY_MOVING = 4.0  # residual from which the loss lets a moving object go, standard deviations


@dataclass(frozen=True)
class StationaryObjects(Settings):
    """Holds objects of some classes near velocity zero."""

    classes: tuple[str, ...] = setting(("traffic_cone", "barrier"), "classes of stationary objects")
    deviation: Positive = setting(0.1, "standard deviation of the velocity left after one second, m/s; lower: stronger")
    name = "stationary"

    def factors(self, view: GraphView) -> Additions:
        dims: dict[int, list[list[int]]] = {}
        for one in view.now(OBJECT).values():
            if one.label in self.classes and one.dim >= 4:  # (x, y, vx, vy, ...)
                dims.setdefault(one.dim, []).append([one.key])
        if view.dt == 0:
            return Additions()
        R, robust = self.deviation**2 / view.dt * np.eye(2), Robust("geman-mcclure", _SURELY_MOVING)
        return Additions(
            factors=[
                ResidualFactors(
                    np.array(rows, dtype=np.uint64),
                    (dim,),
                    _velocity,
                    R,
                    _by_velocity,
                    robust,
                    name="stationary object",
                )
                for dim, rows in dims.items()
            ]
        )


def _velocity(x: FloatArray) -> FloatArray:
    return x[:, 2:4]


def _by_velocity(x: FloatArray) -> list[FloatArray]:
    return [np.tile(np.eye(2, x.shape[1], 2), (len(x), 1, 1))]
