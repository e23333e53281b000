"""Variables of the running graph: kind, id, time and manifold, their keys, values and errors.

A variable x of dimension d moves by increments, x = retract(base, delta), delta = local(base, x) in R^d. Its base is
where it was first put; while it is in the graph the base stays. For a vector the increment is the difference.

The derivative of the increment counted from the present point by that counted from the base,

    D = d local(x, retract(base, delta)) / d delta     (d, d),    the identity for vectors and at the base itself,

takes Jacobians from one to the other (for poses, by central differences).

Keys of variables: kind, id and epoch in one number.

    64 bits  =  letter of the kind (8)  |  id (28)  |  epoch (28)

An epoch is a moment of the graph, numbered from 0. What does not move has one variable for all time: its epoch is None,
stored as all ones. GTSAM prints such a key as a symbol; a graph that holds the variable names it as people do:
"car 12 at 3.40 s".

Linearisation points of factors: the value of every variable, and its increment from the base.

A factor linearised at x says || J delta' + r || of the increment delta' from x. Counted from the base, with delta_0 the
increment of x and D its derivative,

    delta' = D (delta - delta_0),      || (J D) delta - (J D delta_0 - r) ||

so that factors linearised at different points speak of the same unknowns: exact for vectors, and for poses exact at x,
with the gradient and the covariance that factors linearised there have in GTSAM's own coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import FactorError, ImuBias, OrientedPlane, PlanarPose, SingularSystemError, SpatialPose, Variable, Vector
from factors.gaussian import native_factor
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray


class GraphError(InputError):
    """A variable or factor that the graph does not take; the graph is as it was before."""


class ProviderError(GraphError):
    """A provider of a user's raised, or gave what the graph does not take."""


class UndeterminedError(GraphError, SingularSystemError):
    """The factors leave variables undetermined; `keys` are these variables, as far as they could be found."""


_BITS = 28
_FOR_ALL_TIME = (1 << _BITS) - 1
LARGEST = _FOR_ALL_TIME - 1  # id or epoch


@dataclass(frozen=True)
class VariableKind:
    """A kind of variable: its name, and the letter (A-Z, a-z) by which keys tell it from other kinds."""

    name: str
    letter: str

    def __post_init__(self) -> None:
        if len(self.letter) != 1 or not (self.letter.isascii() and self.letter.isalpha()):
            raise GraphError(f"kind {self.name!r}: expected one letter from A to Z or a to z, got {self.letter!r}")


OBJECT = VariableKind("object", "o")
EGO_POSE = VariableKind("ego pose", "x")
EGO_VELOCITY = VariableKind("ego velocity", "v")
EGO_BIAS = VariableKind("ego bias", "b")  # of accelerometers and gyroscopes
EGO_ERROR = VariableKind("ego error", "e")  # slow errors of the odometry
LANDMARK = VariableKind("landmark", "l")
MAP_NODE = VariableKind("map node", "m")
KINDS = (OBJECT, EGO_POSE, EGO_VELOCITY, EGO_BIAS, EGO_ERROR, LANDMARK, MAP_NODE)


def key_of(kind: VariableKind, id: int, epoch: int | None) -> int:  # noqa: A002 -- GTSAM and the tables call it id
    """Return the key. Raises `GraphError` for an id or epoch that is no whole number from 0 to `LARGEST`."""
    if type(id) is int and type(epoch) is int and 0 <= id <= LARGEST and 0 <= epoch <= LARGEST:
        return ord(kind.letter) << 2 * _BITS | id << _BITS | epoch
    for name, number in (("id", id), ("epoch", 0 if epoch is None else epoch)):
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or not 0 <= number <= LARGEST:
            raise GraphError(f"{kind.name}: expected {name} to be a whole number from 0 to {LARGEST}, got {number!r}")
    when = _FOR_ALL_TIME if epoch is None else int(epoch)
    return ord(kind.letter) << 2 * _BITS | int(id) << _BITS | when


def node_kind(node: int) -> tuple[VariableKind, int]:
    """Kind and id of a node of an estimator; those of a road map count down from -1."""
    return (OBJECT, node) if node >= 0 else (MAP_NODE, -node)


def node_key(node: int, epoch: int | None) -> int:
    """The key of a node of an estimator."""
    return key_of(*node_kind(node), epoch)


def described(key: int) -> str:
    """Describe a key whose variable is not known."""
    letter, name, epoch = chr(key >> 2 * _BITS), key >> _BITS & _FOR_ALL_TIME, key & _FOR_ALL_TIME
    if not (letter.isascii() and letter.isalpha()):
        return f"variable {key}"
    kind = {one.letter: one.name for one in KINDS}.get(letter, f"variable {letter}")
    return f"{kind} {name}" if epoch == _FOR_ALL_TIME else f"{kind} {name} of epoch {epoch}"


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


LARGEST_INCREMENT = 1e30  # of whitened numbers, whose squares numbers can hold


class LinearisationPoint:
    """values: where; base: of the variables of the graph. Both are read, never changed."""

    def __init__(self, variables: Mapping[int, GraphVariable], base: gtsam.Values, values: gtsam.Values) -> None:
        self.variables, self.base, self.values = variables, base, values
        self._vectors: dict[int, FloatArray] = {}
        self._transports: dict[int, FloatArray | None] = {}

    def base_vector(self, key: int) -> FloatArray:
        """The base (d,) of a vector."""
        if key not in self._vectors:
            self._vectors[key] = self.base.atVector(key)
        return self._vectors[key]

    def increment(self, key: int) -> FloatArray:
        """The increment (d,) of a variable from its base."""
        kind = self.variables[key].type
        return kind.local(kind.read(self.base, key), kind.read(self.values, key))

    def transport(self, key: int) -> FloatArray | None:
        """D (d, d) of a variable, None for the identity."""
        if key not in self._transports:
            kind = self.variables[key].type
            base = None if isinstance(kind, Vector) else kind.read(self.base, key)
            self._transports[key] = None if base is None else transport(kind, base, self.increment(key))
        return self._transports[key]

    def transported(self, keys: Sequence[int], P: FloatArray) -> FloatArray:
        """A joint covariance of variables, counted from the base, in the coordinates of where they are."""
        P, start = P.copy(), 0
        for key in keys:
            span, D = slice(start, start + self.variables[key].dim), self.transport(key)
            if D is not None:
                P[span] = D @ P[span]
                P[:, span] = P[:, span] @ D.T
            start = span.stop
        return P

    def dims(self, keys: Sequence[int]) -> list[int]:
        """Dimensions of variables."""
        return [self.variables[key].dim for key in keys]

    def from_base(self, keys: Sequence[int], augmented: FloatArray) -> gtsam.JacobianFactor:
        """A factor [J | -r] (m, sum(d) + 1), whitened, on increments from the values, on those from the base.

        Raises `FactorError` for other columns than the variables have dimensions, and numbers that are not finite.
        """
        result = np.array(augmented, order="F")
        dims = self.dims(keys)
        if result.shape[1] != sum(dims) + 1:
            raise FactorError(f"expected Jacobians of {sum(dims)} columns together, got {result.shape[1] - 1}")
        if not (np.abs(result) <= LARGEST_INCREMENT).all():
            raise FactorError(
                "expected a residual and Jacobians of finite numbers, "
                f"at most {LARGEST_INCREMENT:g} standard deviations"
            )
        column = 0
        for key in keys:
            columns = slice(column, column + self.variables[key].dim)
            D = self.transport(key)
            if D is not None:
                result[:, columns] = result[:, columns] @ D
            result[:, -1] += result[:, columns] @ self.increment(key)
            column = columns.stop
        return native_factor(keys, dims, result)
