"""Variables of the running graph: kind, id, time, and the manifold they live on.

A variable x of dimension d moves by increments, x = retract(base, delta), delta = local(base, x) in R^d. Its base is
where it was first put; while it is in the graph the base stays. For a vector the increment is the difference.

The derivative of the increment counted from the present point by that counted from the base,

    D = d local(x, retract(base, delta)) / d delta     (d, d),    the identity for vectors and at the base itself,

takes Jacobians from one to the other (for poses, by central differences).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import FactorError, ImuBias, OrientedPlane, PlanarPose, SpatialPose, Variable, Vector
from saga_fg.graph.errors import GraphError
from saga_fg.graph.keys import VariableKind
from saga_fg.numerics.arrays import FloatArray

_STEP = 1e-6


@dataclass(frozen=True)
class GraphVariable:
    """key; kind; id; epoch and time (s), None for what has one variable for all time; type; label: a word for it."""

    key: int
    kind: VariableKind
    id: int
    epoch: int | None
    time: float | None
    type: Variable
    label: str

    @property
    def dim(self) -> int:
        return self.type.dim

    def __str__(self) -> str:
        name = f"{self.label} {self.id}"
        return name if self.time is None else f"{name} at {self.time:.2f} s"


@dataclass(frozen=True, eq=False)
class NewVariable:
    """A variable to add to the graph.

    state: its first value; static: one for all time; label: a word for it, by default the kind's; type: of the state,
    by default the vector, pose or plane that the state is
    """

    kind: VariableKind
    id: int
    state: Any
    static: bool = False
    label: str = ""
    type: Any = None


def variable_type(name: str, state: Any) -> Variable:
    """Return the type of a state: a vector, a pose, a plane or a bias; raises `GraphError` for anything else."""
    if isinstance(state, gtsam.Pose2):
        return PlanarPose()
    if isinstance(state, gtsam.Pose3):
        return SpatialPose()
    if isinstance(state, gtsam.OrientedPlane3):
        return OrientedPlane()
    if isinstance(state, gtsam.imuBias.ConstantBias):
        return ImuBias()
    if isinstance(state, np.ndarray) and state.ndim == 1 and len(state) > 0:
        return Vector(len(state))
    got = f"shape {state.shape}" if isinstance(state, np.ndarray) else type(state).__name__
    raise GraphError(f"{name}: expected a vector, a pose, a plane or a bias as its state, got {got}")


def insert_state(values: gtsam.Values, variable: GraphVariable, state: Any) -> None:
    """Put a state into `values`. Raises `GraphError` for one that is not of the variable's type, or not finite."""
    if isinstance(variable.type, Vector):
        try:
            state = np.array(state, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise GraphError(f"{variable}: expected numbers as its state, got {state!r}") from error
        if state.shape == (variable.dim,) and np.isfinite(state).all():
            values.insert(variable.key, state)
            return
    alone = gtsam.Values()
    try:
        numbers = variable.type.array(state)
        alone.insert(variable.key, state)
        variable.type.read(alone, variable.key)
    except (AttributeError, TypeError, RuntimeError, FactorError) as error:
        raise GraphError(f"{variable}: expected a state of type {variable.type}, got {type(state).__name__}") from error
    if not np.isfinite(numbers).all():
        raise GraphError(f"{variable}: expected a state of finite numbers, got {np.asarray(numbers).tolist()}")
    values.insert(alone)


def transport(variable: Variable, base: Any, delta: FloatArray) -> FloatArray | None:
    """Return D (d, d) at the point retract(base, delta); None where it is the identity."""
    if isinstance(variable, Vector | ImuBias) or not delta.any():
        return None
    here = variable.retract(base, delta)
    columns = [
        variable.local(here, variable.retract(base, delta + step))
        - variable.local(here, variable.retract(base, delta - step))
        for step in _STEP * np.eye(variable.dim)
    ]
    return np.stack(columns, axis=1) / (2 * _STEP)
