"""The traffic lights of a scene: where they are, what colour they show, what a map and a camera say of them.

Stop lines that close together are one signal, whose light hangs beyond the line of the first. A red phase begins with
amber. A light is seen by those who come to it, with a colour that is wrong by chance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.disturbances import StopLine
from data_tools.simulator.lanes import Lanes
from data_tools.simulator.sensors import viewpoint
from data_tools.simulator.settings import LightSettings, SensorSettings
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import wrap_angle, yaw_of
from saga_fg.types import road_map
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections
from saga_fg.types.signal import COLOURS

BEYOND = 12.0  # m from a stop line to its light
HEIGHT = 5.0  # m of a light over the ground
HOUSING = (0.3, 0.4, 1.0)  # m
MAPPED = (-200.0, 150.0)  # m around the place where traffic is disturbed
SPACING = 8.0  # m between the points of a mapped lane


@dataclass(frozen=True, eq=False)
class Signal:
    """One light: place (2,), heading of those it is for, and the red phases (K, 2), s, that begin with amber."""

    name: str
    place: FloatArray
    heading: float
    red: FloatArray
    amber_duration: float

    def colour(self, time: float) -> str:
        """What it shows."""
        now = np.flatnonzero((self.red[:, 0] <= time) & (time < self.red[:, 1]))
        if len(now) == 0:
            return "green"
        return "amber" if time < self.red[now[0], 0] + self.amber_duration else "red"


def signals_of(lanes: Lanes, lines: tuple[StopLine, ...], settings: LightSettings) -> tuple[Signal, ...]:
    """The lights of some stop lines."""
    signals: list[Signal] = []
    done: set[int] = set()
    for line in lines:
        if len(line.lanes) == 0 or id(line.red) in done:
            continue
        done.add(id(line.red))
        lane = line.lanes[:1]
        middle = np.array([lanes.offset[line.lanes].mean()])
        place, heading = lanes.pose(lane, np.array([line.s + BEYOND]), middle, np.zeros(1))
        signals.append(Signal(f"light-{len(signals)}", place[0], float(heading[0]), line.red, settings.amber_duration))
    return tuple(signals)


def map_of(
    lanes: Lanes,
    focus: float,
    lines: tuple[StopLine, ...],
    signals: tuple[Signal, ...],
    settings: LightSettings,
    rng: np.random.Generator,
) -> road_map.RoadMap:
    """The map: lights, their stop lines and all lanes around `focus` (m along the road), each a little off."""

    def point(place: FloatArray) -> road_map.Point:
        return float(place[0]), float(place[1])

    def off() -> FloatArray:
        return np.asarray(settings.map_noise * rng.standard_normal(2))

    lights = tuple(road_map.TrafficLight(signal.name, point(signal.place + off())) for signal in signals)
    half = abs(lanes.offset[1] - lanes.offset[0]) / 2
    mapped = []
    for number, line in enumerate(lines):
        if len(line.lanes) == 0:
            continue
        name = next(signal.name for signal in signals if signal.red is line.red)
        sign = lanes.direction[line.lanes[0]]
        borders = lanes.offset[line.lanes].max() + half, lanes.offset[line.lanes].min() - half
        ends, _ = lanes.pose(np.repeat(line.lanes[:1], 2), np.full(2, line.s), np.array(borders[::sign]), np.zeros(2))
        left, right = ends + off()
        mapped.append(road_map.StopLine(f"line-{number}", point(left), point(right), name))
    before = replace(lanes, taper=0.0)  # no map knows of cones
    found = []
    for lane in range(len(lanes.offset)):
        along = np.arange(focus + MAPPED[0], focus + MAPPED[1], SPACING)
        s = along if lanes.direction[lane] > 0 else lanes.road.length - along[::-1]
        same = np.full(len(s), lane)
        d, slope = before.lateral(same, s)
        centre, _ = lanes.pose(same, s, d, slope)
        moved = centre + off()
        found.append(road_map.Lane(f"lane-{lane}", tuple(point(place) for place in moved), 2 * float(half)))
    return road_map.RoadMap(lights, tuple(mapped), tuple(found), max(settings.map_noise, 1e-3))


def see_lights(
    sensor: SensorSettings,
    world_T_ego: FloatArray,
    signals: tuple[Signal, ...],
    time: float,
    settings: LightSettings,
    rng: np.random.Generator,
) -> Detections:
    """What a sensor that sees colours reports of the lights, in world coordinates."""
    if sensor.colour_accuracy is None or len(signals) == 0:
        return Detections.empty()
    origin, yaw = viewpoint(sensor, world_T_ego)[:2], yaw_of(world_T_ego)
    place = np.array([signal.place for signal in signals])
    offset = place - origin
    distance, bearing = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    faces = np.cos(bearing - np.array([signal.heading for signal in signals])) > 0.5
    within = (distance <= settings.visible_range) & (np.abs(wrap_angle(bearing - yaw)) <= sensor.field_of_view / 2)
    seen = np.flatnonzero(faces & within & (rng.random(len(signals)) < sensor.detection_probability))
    if len(seen) == 0:
        return Detections.empty()
    labels = []
    for row in seen.tolist():
        true = signals[row].colour(time)
        wrong = [colour for colour in COLOURS if colour != true]
        right = rng.random() < sensor.colour_accuracy
        labels.append(f"traffic_light_{true if right else wrong[int(rng.integers(2))]}")
    n, r = len(seen), distance[seen, None]
    sight = offset[seen] / np.maximum(r, 0.1)
    across = np.stack([-sight[:, 1], sight[:, 0]], axis=1)
    error = (sensor.range_noise[0] + sensor.range_noise[1] * r) * rng.standard_normal((n, 1)) * sight
    error = error + (sensor.bearing_noise[0] + sensor.bearing_noise[1] * r) * rng.standard_normal((n, 1)) * across
    position = np.column_stack([place[seen] + error, np.full(n, HEIGHT)])
    logit = sensor.true_logit + sensor.logit_noise * rng.standard_normal(n)
    size, nothing = np.tile(np.array(HOUSING), (n, 1)), np.full((n, 2), np.nan)
    boxes = Boxes(np.array(labels), position, size, np.full(n, np.nan), nothing)
    return Detections(boxes, 1 / (1 + np.exp(-logit)))
