r"""A closed stop line brings the first vehicle to a halt, and through it the queue.

    dv_i/dt += rate tau u ( -v^2 / (2 g) ),    v = u.v_i,    g = u.(p_j - p_i) + bend - length_i / 2 - margin

is the constant deceleration that ends at the line: v the speed along the lane, g the remaining way from the front of
the vehicle to `margin` before the line, `bend` the extra length of the way along the lane over the straight one.
Linearised at the estimate (v0, g0):

    -v^2 / (2 g) ~ -v0^2 / (2 g0) - (v0 / g0) (v - v0) + v0^2 / (2 g0^2) (g - g0)

The rule: of the vehicles that come to a line, the first of each lane that can still stop, at

    rate = rate  closed_j  ramp( v^2 / (2 g) from `reaction_deceleration` to `full_deceleration` )

since drivers do not brake for a line far away; a vehicle that would have to brake harder than `max_deceleration` goes
on. A slow one near the line comes to rest where it is: dv_i/dt += -rate tau v / stop_time. Those behind follow by other
interactions. Alternatively the line is a stationary leader of the Intelligent Driver Model
(`saga_fg.model.intelligent_driver`): the vehicle brakes later and harder, and a slow one creeps up to the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.edge_rules import VEHICLES, Pairs
from saga_fg.model.intelligent_driver import LEAST_GAP, IntelligentDriver, Linearised, accelerated, speed_along
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples
from saga_fg.model.nonlinear_interactions import Accelerations, smooth_acceleration
from saga_fg.model.road.stop_lines import ComingVehicles, approach, coming_vehicles
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group
from saga_fg.types.road_map import LIGHT, STOP_LINE

HALTING_SPEED = 2.0  # m/s; slower vehicles near a closed line come to rest where they are
HALTING_GAP = 10.0  # m from the front of the vehicle to the line
MAX_DECELERATION = 4.5  # drivers who would have to brake harder do not stop, m/s^2


@dataclass(frozen=True)
class Stopping(Settings):
    """Even deceleration to a halt before a line; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    time_constant: Positive = setting(1.0, "tau: an edge of rate 1 / tau decelerates as much as is needed, s")
    margin: NonNegative = setting(
        3.0, "distance left between the front of a stopped vehicle and the line, m; usual 1 to 5"
    )
    hardest: Positive = setting(
        4.5, "limit of the deceleration, m/s^2; usual 3 to 6; higher: harder braking is predicted"
    )
    stop_time: Positive = setting(
        1.0, "time constant with which the last of the speed fades, s; usual 0.5 to 2; higher: slower stops"
    )

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """g (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2 - self.margin, LEAST_GAP)

    def law(self, v: FloatArray, g: FloatArray) -> Linearised:
        """The deceleration (E,) at speeds and remaining ways g (E,)."""
        g = np.maximum(g, v**2 / (2 * self.hardest))
        none = np.zeros_like(v)
        even = Linearised(-(v**2) / (2 * g), -v / g, v**2 / (2 * g**2), none)
        return Linearised(-v / self.stop_time, none - 1 / self.stop_time, none, none).where(
            halting(v, g + self.margin), even
        )

    def acceleration(self, v: FloatArray, g: FloatArray) -> FloatArray:
        """Accelerations (E,), m/s^2, at speeds and remaining ways g (E,)."""
        return self.law(v, g).value

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        ways = approach(nodes, target, source)
        v = speed_along(nodes, target, ways.direction)
        law = self.law(v, self.gap(nodes, target, ways.way))
        return accelerated(nodes, target, source, ways.direction, v, law, self.time_constant)


@dataclass(frozen=True)
class DriverStopping:
    """Coming to a line as to the end of a queue; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; its standstill gap is to the line"
    )

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """Gap (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2, LEAST_GAP)

    def acceleration(self, v: FloatArray, g: FloatArray) -> FloatArray:
        """Accelerations (E,), m/s^2, at speeds and gaps g (E,)."""
        return self.driver.stopping(v, g).value

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        ways = approach(nodes, target, source)
        v = speed_along(nodes, target, ways.direction)
        f = self.driver.stopping(v, self.gap(nodes, target, ways.way))
        return accelerated(nodes, target, source, ways.direction, v, f, self.driver.time_constant)


@dataclass(frozen=True)
class SmoothStopping:
    """Coming to a line as to the end of a queue, without corners in the law; the source is the line."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION)
    driver: IntelligentDriver = settings_group(
        IntelligentDriver, "parameters of the driver; `hidden_vehicle_gap` is not used"
    )

    @property
    def time_constant(self) -> float:
        return self.driver.time_constant

    @property
    def alone(self) -> FloatArray:
        return np.array([1.0, 0.0, 0.0])

    def gap(self, nodes: NodeTable, target: IntArray, way: FloatArray) -> FloatArray:
        """Gap (E,), m, for ways (E,) from the centres to the line."""
        return np.maximum(way - nodes.length[target] / 2, LEAST_GAP)

    def acceleration(self, v: FloatArray, g: FloatArray) -> FloatArray:
        """Accelerations (E,), m/s^2, at speeds and gaps g (E,)."""
        return smooth_acceleration(self.driver, v, g, np.zeros_like(v)).value

    def given(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """(E, 3) direction of the lane, and the gap less the distance to the line along it."""
        ways = approach(nodes, target, source)
        straight = np.einsum("ei,ei->e", nodes.position[source] - nodes.position[target], ways.direction)
        return np.column_stack([ways.direction, self.gap(nodes, target, ways.way) - straight])

    def accelerations(self, own: FloatArray, other: FloatArray, given: FloatArray) -> Accelerations:
        u = given[..., :2]
        v, s = (u * own[..., 2:]).sum(axis=-1), (u * (other - own)[..., :2]).sum(axis=-1) + given[..., 2]
        f = smooth_acceleration(self.driver, v, s, np.zeros_like(v))
        along = u[..., :, None] * u[..., None, :]
        by_gap = f.by_gap[..., None, None] * along
        by_own = np.concatenate([-by_gap, f.by_speed[..., None, None] * along], axis=-1)
        return Accelerations(f.value[..., None] * u, by_own, np.concatenate([by_gap, 0 * by_gap], axis=-1))


@dataclass(frozen=True)
class RedLight(Settings):
    """The first vehicle that comes to a closed stop line, and can stop, does."""

    map_classes: ClassVar[tuple[str, ...]] = (LIGHT, STOP_LINE)
    interaction: Stopping | DriverStopping | SmoothStopping = settings_group(
        Stopping, "interaction function of the edges"
    )
    rate: NonNegative = setting(
        1.0,
        "strength of an edge of a vehicle that brakes for a line that is surely closed, 1/s; usual 0.5 to "
        "2; higher: brakes more surely",
    )
    max_distance: NonNegative = setting(
        100.0, "no edge from a line further away, m; usual 50 to 150; higher: vehicles brake from afar"
    )
    reaction_deceleration: NonNegative = setting(
        0.3, "needed deceleration at which drivers begin to react, m/s^2; usual 0.2 to 1; higher: they react later"
    )
    full_deceleration: Positive = setting(
        1.0, "needed deceleration from which they brake fully, m/s^2; usual 0.8 to 2; higher: they brake later"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")

    def able(self, coming: ComingVehicles) -> ComingVehicles:
        """Coming vehicles that can stop before the line, or halt at it."""
        can = (coming.front > 0) & (coming.speed**2 <= 2 * MAX_DECELERATION * coming.front)
        return coming.select(can | halting(coming.speed, coming.front))

    def brakes(self, nodes: NodeTable, coming: ComingVehicles) -> tuple[FloatArray, FloatArray]:
        """The probability that each driver brakes for a closed line (E,), and the acceleration then (E,), m/s^2."""
        g = self.interaction.gap(nodes, coming.target, coming.approach.way)
        needed = coming.speed**2 / (2 * g) - self.reaction_deceleration
        ramp = np.clip(needed / max(self.full_deceleration - self.reaction_deceleration, 1e-9), 0.0, 1.0)
        ramp = np.where(halting(coming.speed, coming.front), 1.0, ramp)
        return ramp, self.interaction.acceleration(coming.speed, g)

    def pairs(self, nodes: NodeTable) -> Pairs:
        first = self.able(coming_vehicles(nodes, self.classes, self.max_distance)).first()
        weight = np.zeros(len(first.source)) if nodes.closed is None else nodes.closed[first.source]
        return Pairs(first.target, first.source, self.rate * weight * self.brakes(nodes, first)[0])


def halting(speed: FloatArray, front: FloatArray) -> BoolArray:
    """Mask of the vehicles that come to rest before the line, by their speeds, m/s, and distances from it, m."""
    return np.asarray((speed < HALTING_SPEED) & (front < HALTING_GAP))
