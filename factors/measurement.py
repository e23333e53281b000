"""Measurement models h(x) on vector states: the role, and the Cartesian ones, which pick components of the state.

position                 z = p
position and velocity    z = (p, v)
box                      z = (p, size, yaw)        yaw is an angle: its difference is wrapped

h(x) = H x,    H = the rows of the identity that belong to the components
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factors.errors import FactorError
from factors.validation import FloatArray


class MeasurementModel(Protocol):
    """h, its Jacobian, and what the numbers are. Both functions take one state or many at once."""

    @property
    def name(self) -> str:
        """Name of the measured quantity, for messages."""

    @property
    def state_dim(self) -> int:
        """Dimension d of the state."""

    @property
    def dim(self) -> int:
        """Dimension m of the measurement."""

    @property
    def angles(self) -> Sequence[int]:
        """Components of the measurement that are angles in rad."""

    @property
    def linear(self) -> bool:
        """True where h(x) = H x, up to whole turns of the angles."""

    def predict(self, x: FloatArray) -> FloatArray:
        """Return h (..., m) at states (..., d)."""

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return dh/dx (..., m, d) at states (..., d)."""


@dataclass(frozen=True)
class Components:
    """The measurement of some components of a state, in the order given; `angles` counts among them."""

    state_dim: int
    components: tuple[int, ...]
    angles: tuple[int, ...] = ()
    name: str = "components"

    def __post_init__(self) -> None:
        checked_components(self.name, self.components, self.state_dim)
        checked_components("angles", self.angles, len(self.components), least=0)

    @property
    def dim(self) -> int:
        return len(self.components)

    @property
    def linear(self) -> bool:
        return True

    def predict(self, x: FloatArray) -> FloatArray:
        return x[..., list(self.components)]

    def jacobian(self, x: FloatArray) -> FloatArray:
        H = np.eye(self.state_dim)[list(self.components)]
        return np.broadcast_to(H, (*x.shape[:-1], *H.shape))


def position(state_dim: int, position: tuple[int, ...] = (0, 1)) -> Components:
    """Return the model of a measured position (m); `position`: where it sits in the state."""
    return Components(state_dim, tuple(position), name="position")


def position_velocity(
    state_dim: int, position: tuple[int, ...] = (0, 1), velocity: tuple[int, ...] = (2, 3)
) -> Components:
    """Return the model of a measured position (m) and velocity (m/s), z = (p, v)."""
    return Components(state_dim, (*position, *velocity), name="position and velocity")


def box(state_dim: int, position: tuple[int, ...], size: tuple[int, ...], yaw: int) -> Components:
    """Return the model of a measured box, z = (p, size, yaw); m and rad."""
    components = (*position, *size, yaw)
    return Components(state_dim, components, angles=(len(components) - 1,), name="box")


def checked_components(name: str, components: Sequence[int], dim: int, least: int = 1) -> None:
    """Raise `FactorError` unless `components` are at least `least` distinct indices below `dim`."""
    indices = list(components)
    valid = all(isinstance(i, int | np.integer) and not isinstance(i, bool) and 0 <= i < dim for i in indices)
    if not valid or len(set(indices)) != len(indices) or len(indices) < least:
        raise FactorError(f"{name}: expected distinct components from 0 to {dim - 1}, got {tuple(indices)}")
