r"""Detection of residuals whose angles are not wrapped.

An angle has a branch cut: while a pose turns once round, a component that is one jumps by 2 pi somewhere (in degrees,
by 360). Where the jump goes from pi to -pi, the residual wraps the angle itself, or the measured angle is 0; elsewhere
a small deviation is taken for a full turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from factors.errors import FactorError
from factors.nonlinear import ResidualFactor
from factors.validation import FloatArray
from factors.variables import PlanarPose, SpatialPose

_STEPS = 16  # of a full turn
_HALVINGS = 24  # of a step, which leave 2e-8 rad
_FULL = np.array([2 * np.pi, 360.0])
_SAME = 1e-4  # of a full turn


def unwrapped_angles(factor: ResidualFactor, states: Sequence[Any]) -> tuple[int, ...]:
    """Components of the residual that are angles, unwrapped, and are not named in `angles`.

    states: of the factor's variables. Poses among them are turned about their vertical, one at a time; without poses
    nothing is found.
    """
    found: set[int] = set()
    for place, variable in enumerate(factor.variables):
        if isinstance(variable, PlanarPose | SpatialPose):
            try:
                found |= _jumps(factor, states, place)
            except FactorError:  # a pose that turned too far, to where the factor is undefined
                continue
    return tuple(sorted(found - set(factor.angles)))


def _jumps(factor: ResidualFactor, states: Sequence[Any], place: int) -> set[int]:
    """Components that jump by a full turn, not from half of one to minus half, while one pose turns."""
    turns = np.linspace(0.0, 2 * np.pi, _STEPS + 1)
    residuals = [_turned(factor, states, place, turn) for turn in turns]
    found = set()
    for step, (before, after) in enumerate(pairwise(residuals)):
        for component in np.flatnonzero(np.abs(after - before) > np.pi).tolist():
            low, high = turns[step], turns[step + 1]
            ends = before[component], after[component]
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                at = _turned(factor, states, place, middle)[component]
                if abs(at - ends[0]) > abs(ends[1] - at):
                    high, ends = middle, (ends[0], at)
                else:
                    low, ends = middle, (at, ends[1])
            jump = abs(ends[1] - ends[0])
            whole = (np.abs(jump / _FULL - 1) < _SAME).any()
            if whole and abs(abs(ends[0]) / jump - 0.5) > _SAME:
                found.add(component)
    return found


def _turned(factor: ResidualFactor, states: Sequence[Any], place: int, turn: float) -> FloatArray:
    delta = np.zeros(factor.variables[place].dim)
    delta[2] = turn  # about the vertical, in the plane and in space
    moved = list(states)
    moved[place] = factor.variables[place].retract(states[place], delta)
    return factor.residual_at(moved)
