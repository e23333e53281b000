"""Node types: the components of the state of a node, and the motion of a node on its own.

    dx/dt = A x + w,    E[w(t) w(s)^T] = Qc delta(t - s)

A nonlinear motion (`saga_fg.model.manoeuvres`) has a `flow` besides, its state dt seconds later without noise and
interactions; A is then what of it is linear everywhere, along which noise and interactions are discretised.

A type names its state components ("x", "vx", ...), so that sensors and interactions find what they need by name and
nodes of different types, with states of different size, live in one graph.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, checked
from saga_fg.parts import part_kind
from saga_fg.settings import Fraction, NonNegative, PositiveOrInf, Settings, setting

_LATERAL_FADING = 0.1  # s, with which an acceleration fades that is not along a vehicle's heading
_LATERAL_DEVIATION = 0.1  # m/s^2, so that what is left of it stays uncertain


@part_kind("motion model", "saga_fg.motions")
class Motion(Protocol):
    """Own motion of a node: named components, generator A (d, d) in 1/s, diffusion Qc (d, d) per s."""

    @property
    def components(self) -> tuple[str, ...]: ...

    @property
    def generator(self) -> FloatArray: ...

    @property
    def diffusion(self) -> FloatArray: ...


@runtime_checkable
class NonlinearMotion(Motion, Protocol):
    """Own motion x(t + dt) = flow(x(t), dt) + q; both functions take stacks of states (..., d).

    Any motion may also have an `initial_deviation` (d,), of unmeasured components of a new object, 1 by default.
    """

    def flow(self, x: FloatArray, dt: float) -> FloatArray: ...

    def flow_jacobian(self, x: FloatArray, dt: float) -> FloatArray: ...


def _planar(one_axis: ArrayLike) -> FloatArray:
    """The matrix of one axis, for x and y: components alternate x, y."""
    return np.asarray(np.kron(np.asarray(one_axis), np.eye(2)), dtype=np.float64)


def _fading(time_constant: float) -> FloatArray:
    """Generator (3, 3) of position, velocity and an acceleration that fades, along one axis."""
    return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / time_constant]])


@dataclass(frozen=True)
class ConstantVelocity(Settings):
    """White noise acceleration in the plane (Bar-Shalom, Li, Kirubarajan 2001, section 6.2.2)."""

    acceleration_noise: NonNegative = setting(
        1.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 3; higher: follows detections faster"
    )

    components: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    generator: ClassVar[FloatArray] = _planar([[0.0, 1.0], [0.0, 0.0]])

    @property
    def diffusion(self) -> FloatArray:
        return _planar(np.diag([0.0, self.acceleration_noise]))


@dataclass(frozen=True)
class ConstantAcceleration(Settings):
    """White noise jerk in the plane, acceleration fading with a time constant (Singer 1970).

    Without fading (`fading_time` infinite) this is the Wiener-process acceleration model of Bar-Shalom, Li,
    Kirubarajan 2001, section 6.2.3; fading keeps a long prediction from running away.
    """

    jerk_noise: NonNegative = setting(
        1.0, "spectral density of the jerk, m^2/s^5; higher: follows changes of acceleration faster"
    )
    fading_time: PositiveOrInf = setting(
        float("inf"), "time constant with which the acceleration fades, s; usual 1 to 10; .inf: never"
    )

    components: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy", "ax", "ay")

    @property
    def generator(self) -> FloatArray:
        return _planar(_fading(self.fading_time))

    @property
    def diffusion(self) -> FloatArray:
        return _planar(np.diag([0.0, 0.0, self.jerk_noise]))


@dataclass(frozen=True)
class Curvilinear(Settings):
    """Motion of a vehicle along a curved path: it accelerates along its heading, and turns as its headings do.

    The acceleration along the heading fades (Singer 1970), that across it is that of the turn. White noise
    acceleration, which differs along and across the heading, acts besides. The heading and the turn rate are known
    inputs of an interval (`saga_fg.model.manoeuvres`); where they are missing the motion is straight and its noise
    the same in all directions. Source of the split: Best and Norton, A new model and efficient tracker for a target
    with curvilinear motion, IEEE Transactions on Aerospace and Electronic Systems 33(3), 1997.
    """

    acceleration_noise: NonNegative = setting(
        1.0,
        "spectral density of the white acceleration along the heading, m^2/s^3; usual 0.3 to 3; higher: follows "
        "detections faster",
    )
    lateral_acceleration_noise: NonNegative = setting(
        0.07,
        "spectral density of the white acceleration across the heading, m^2/s^3; usual 0.03 to 0.3; higher: follows "
        "lane changes faster",
    )
    jerk_noise: NonNegative = setting(
        0.03,
        "spectral density of the jerk along the heading, m^2/s^5; usual 0.01 to 2; higher: follows changes of "
        "acceleration faster",
    )
    fading_time: PositiveOrInf = setting(
        8.0, "time constant with which the acceleration fades, s; usual 1 to 10; .inf: never"
    )
    turn_time: NonNegative = setting(
        6.0,
        "time constant with which a turn seen in the headings fades, s; usual 1 to 8, 0: none; higher: longer curves",
    )
    course_time: NonNegative = setting(
        0.0,
        "time constant with which the velocity across the course of an undetected object fades, s; usual 0.5 to 2, "
        "0: never; lower: it keeps to its path, that of its heading and of earlier traffic",
    )
    turning_share: Fraction = setting(
        0.3, "share of objects that turn; usual 0.1 to 0.5; higher: small turn rates are believed sooner"
    )

    components: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy", "ax", "ay")

    @property
    def generator(self) -> FloatArray:
        return _planar(_fading(self.fading_time))

    @property
    def diffusion(self) -> FloatArray:
        white = (self.acceleration_noise + self.lateral_acceleration_noise) / 2
        return _planar(np.diag([0.0, white, self.jerk_noise / 2]))

    @property
    def along(self) -> tuple[FloatArray, FloatArray]:
        """Generator and diffusion (3, 3) of position, velocity and acceleration along the heading."""
        return _fading(self.fading_time), np.diag([0.0, self.acceleration_noise, self.jerk_noise])

    @property
    def across(self) -> tuple[FloatArray, FloatArray]:
        """Generator and diffusion (3, 3) across the heading, where an acceleration fades at once: turns are known."""
        jerk = 2 * _LATERAL_DEVIATION**2 / _LATERAL_FADING
        return _fading(_LATERAL_FADING), np.diag([0.0, self.lateral_acceleration_noise, jerk])


@dataclass(frozen=True)
class RandomWalk(Settings):
    """A position that drifts without a velocity; with drift 0 it stands still (a stop line, a pole)."""

    components: ClassVar[tuple[str, ...]] = ("x", "y")
    generator: ClassVar[FloatArray] = np.zeros((2, 2))
    drift: NonNegative = setting(0.0, "spectral density of the drift, unit^2/s; 0: never moves")

    @property
    def diffusion(self) -> FloatArray:
        return self.drift * np.eye(2)


@dataclass(frozen=True)
class NodeType:
    """A class of nodes: its name and its own motion.

    Raises `InputError` for repeated component names, matrices of the wrong shape, or a diffusion that is not symmetric
    positive semidefinite.
    """

    name: str
    motion: Motion

    def __post_init__(self) -> None:
        d = len(self.components)
        if d == 0 or len(set(self.components)) != d:
            raise InputError(f"node type {self.name}: expected distinct component names, got {self.components}")
        checked(f"node type {self.name}: generator", self.motion.generator, (d, d))
        Qc = checked(f"node type {self.name}: diffusion", self.motion.diffusion, (d, d))
        if not np.allclose(Qc, Qc.T) or np.linalg.eigvalsh(Qc)[0] < -1e-12 * max(1.0, float(np.abs(Qc).max())):
            raise InputError(f"node type {self.name}: diffusion: expected a symmetric positive semidefinite matrix")

    @cached_property
    def components(self) -> tuple[str, ...]:
        return self.motion.components

    @cached_property
    def dim(self) -> int:
        """Size d of the state."""
        return len(self.components)

    @cached_property
    def generator(self) -> FloatArray:
        """A (d, d), 1/s."""
        return checked("generator", self.motion.generator, (self.dim, self.dim))

    @cached_property
    def diffusion(self) -> FloatArray:
        """Qc (d, d), per s."""
        return checked("diffusion", self.motion.diffusion, (self.dim, self.dim))

    @cached_property
    def flow(self) -> NonlinearMotion | None:
        """The motion where it is nonlinear."""
        return self.motion if isinstance(self.motion, NonlinearMotion) else None

    @cached_property
    def initial_deviation(self) -> FloatArray:
        """(d,) of unmeasured components of a new object: 1 unless the motion defines it."""
        given = getattr(self.motion, "initial_deviation", np.ones(self.dim))
        return checked("initial_deviation", given, (self.dim,))

    @cached_property
    def planar(self) -> tuple[int, int, int, int]:
        """Indices of x, y, vx, vy in the state; -1, -1 for the velocity of a type that has none."""
        velocity = ("vx", "vy")
        x, y = self.index(("x", "y")).tolist()
        return (x, y, *self.index(velocity).tolist()) if self.has(velocity) else (x, y, -1, -1)

    @cached_property
    def nilpotency(self) -> int | None:
        """Smallest k with A^k = 0, so that exp(A s) is a polynomial in s of degree k - 1; None if there is none."""
        power = np.eye(self.dim)
        for k in range(self.dim + 1):
            if not power.any():
                return k
            power = power @ self.generator
        return None

    def has(self, names: Sequence[str]) -> bool:
        """True if the state has all these components."""
        return set(names) <= set(self.components)

    def index(self, names: Sequence[str]) -> IntArray:
        """Positions of the named components in the state; raises `InputError` for one it has not."""
        for name in names:
            if name not in self.components:
                raise InputError(
                    f"node type {self.name} has no component {name!r}; it has {', '.join(self.components)}"
                )
        return np.array([self.components.index(name) for name in names], dtype=np.int64)

    def selector(self, names: Sequence[str]) -> FloatArray:
        """H (k, d) that picks the named components: z = H x."""
        H = np.zeros((len(names), self.dim))
        H[np.arange(len(names)), self.index(names)] = 1.0
        return H


def distinct_types(types: Sequence[NodeType]) -> tuple[list[NodeType], IntArray]:
    """The distinct ones of n node types, in order of appearance, and the number (n,) of each among them."""
    ids = list(map(id, types))
    found = dict(zip(ids, types, strict=True))
    number = dict(zip(found, range(len(found)), strict=True))
    return list(found.values()), np.array(list(map(number.__getitem__, ids)), dtype=np.int64)
