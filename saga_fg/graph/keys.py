"""Keys of variables: kind, id and epoch in one number.

    64 bits  =  letter of the kind (8)  |  id (28)  |  epoch (28)

An epoch is a moment of the graph, numbered from 0. What does not move has one variable for all time: its epoch is None,
stored as all ones. GTSAM prints such a key as a symbol; `key_id` reads it back, and a graph that holds the variable
names it as people do: "car 12 at 3.40 s".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.graph.errors import GraphError

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
EGO_CALIBRATION = VariableKind("calibration", "c")  # of the vehicle's sensors, for all time
LANDMARK = VariableKind("landmark", "l")
MAP_NODE = VariableKind("map node", "m")
KINDS = (OBJECT, EGO_POSE, EGO_VELOCITY, EGO_BIAS, EGO_ERROR, EGO_CALIBRATION, LANDMARK, MAP_NODE)


@dataclass(frozen=True)
class KeyId:
    """The parts of a key; epoch: None for what has one variable for all time."""

    letter: str
    id: int
    epoch: int | None


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


def key_id(key: int) -> KeyId:
    """Return the parts of a key. Raises `GraphError` for one of another scheme."""
    letter = chr(int(key) >> 2 * _BITS)
    if not (letter.isascii() and letter.isalpha()):
        raise GraphError(f"{key}: expected a key made by key_of")
    when = int(key) & _FOR_ALL_TIME
    return KeyId(letter, int(key) >> _BITS & _FOR_ALL_TIME, None if when == _FOR_ALL_TIME else when)


def described(key: int) -> str:
    """Describe a key whose variable is not known."""
    try:
        parts = key_id(key)
    except GraphError:
        return f"variable {key}"
    names = {kind.letter: kind.name for kind in KINDS}
    name = f"{names.get(parts.letter, f'variable {parts.letter}')} {parts.id}"
    return name if parts.epoch is None else f"{name} of epoch {parts.epoch}"
