"""What sensors, detectors and annotators see of a world, and the lights in it.

Noise is Gaussian along the line of sight and across it, with standard deviations base + slope * range, and
independent from frame to frame. A camera's range may also drift, by a relative error for each object. A radar adds the
range rate: the velocity over ground along the line of sight; that of false detections is around 0, as of a static
object. Classes are confused independently from frame to frame. The logit of a score is, for a true detection,

    true_logit + 2 (visible share - 1) - range / 40 m + noise,          for a false one    clutter_logit + noise.

Traffic lights: positions and colours, their map, and their detections by a camera.

Stop lines that close together share one signal, whose light hangs beyond the first line. A red phase begins with amber.
A light is visible to vehicles that approach it; its colour may be misclassified.

Ground-truth annotations of a simulated scene.

An object within the annotation range is annotated while a sensor sees enough of it and for `memory` s afterwards. It
counts as visible only in views of some duration; a shorter view does not reveal its motion.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.road import KINDS, Lanes
from data_tools.simulator.scene_layout import ClosingLine
from data_tools.simulator.settings import CLEAR_SHARE, HIDDEN_SHARE, SensorSettings, SimulatorSettings
from data_tools.simulator.traffic import BODY, SimulatedTrajectories
from saga_fg.numerics import BoolArray, FloatArray, StrArray, transform_points, wrap_angle, yaw_of
from saga_fg.tracking import visible_share
from saga_fg.types import COLOURS, Annotations, Boxes, Detections, RoadMap, road_map

CLUTTER = (("pedestrian", BODY), *((kind.label, kind.size) for kind in KINDS))
CLUTTER_SHARES = (0.4, 0.4, 0.1, 0.07, 0.03)
DRIFT_TIME = 2.0  # correlation time of the drift of a range, s
OUTAGE_DURATION = (1.0, 3.0)  # of an outage, in which no frame comes, s
FADING = 6.0  # width of the fall of the probability of detection around the reach, m


def sensor_position(sensor: SensorSettings, world_T_ego: FloatArray) -> FloatArray:
    """Position (3,) of the sensor in the world, m."""
    return np.asarray(transform_points(world_T_ego, np.array([sensor.position]))[0])


def in_view(sensor: SensorSettings, world_T_ego: FloatArray, points: FloatArray) -> BoolArray:
    """Mask (N,) of the points (N, 3), world coordinates, within the sensor's field of view and range."""
    offset = (points - sensor_position(sensor, world_T_ego))[:, :2]
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - yaw_of(world_T_ego))
    near = np.linalg.norm(offset, axis=1) <= sensor.max_range
    return np.asarray(near & (np.abs(bearing) <= sensor.field_of_view / 2))


def detection_probability(sensor: SensorSettings, origin: FloatArray, boxes: Boxes, share: FloatArray) -> FloatArray:
    """Detection probability (N,) of `boxes` seen from `origin` (3,), of which a `share` (N,) is visible."""
    ramp = np.clip((share - HIDDEN_SHARE) / (CLEAR_SHARE - HIDDEN_SHARE), 0.0, 1.0)
    if sensor.resolution is not None:
        n = points_on(sensor.resolution, origin, boxes, share)
        return np.asarray(sensor.detection_probability * ramp * n**2 / (n**2 + sensor.enough_points**2))
    distance = np.linalg.norm((boxes.position - origin)[:, :2], axis=1)
    return np.asarray(sensor.detection_probability * ramp / (1 + np.exp((distance - sensor.reach) / FADING)))


def points_on(resolution: tuple[float, float], origin: FloatArray, boxes: Boxes, share: FloatArray) -> FloatArray:
    """Number (N,) of points or pixels on the visible share (N,) of the silhouettes of boxes seen from `origin` (3,)."""
    offset = (boxes.position - origin)[:, :2]
    aspect = boxes.yaw - np.arctan2(offset[:, 1], offset[:, 0])
    width = np.abs(boxes.size[:, 0] * np.sin(aspect)) + np.abs(boxes.size[:, 1] * np.cos(aspect))
    solid_angle = width * boxes.size[:, 2] / np.maximum((offset**2).sum(axis=1), 1.0)
    return np.asarray(share * solid_angle / (resolution[0] * resolution[1]))


def range_drifts(sensor: SensorSettings, time: FloatArray, objects: int, rng: np.random.Generator) -> FloatArray:
    """Relative errors (K, N) of the range of N objects at `time` (K,), s: a Gauss-Markov process for each."""
    drift = sensor.range_drift * rng.standard_normal((len(time), objects))
    kept = np.exp(-np.diff(time) / DRIFT_TIME)
    for k, share in enumerate(kept, start=1):
        drift[k] = share * drift[k - 1] + math.sqrt(1 - share**2) * drift[k]
    return drift


def outside_outages(sensor: SensorSettings, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The times of the frames that come, of all at `time` (K,), s."""
    if sensor.outage_interval == math.inf or len(time) == 0:
        return time
    working, end = np.ones(len(time), dtype=np.bool_), time[0]
    while end <= time[-1]:
        begin = end + rng.exponential(sensor.outage_interval)
        end = begin + rng.uniform(*OUTAGE_DURATION)
        working &= (time < begin) | (time >= end)
    return time[working]


def detect(
    sensor: SensorSettings,
    world_T_ego: FloatArray,
    boxes: Boxes,
    share: FloatArray,
    rng: np.random.Generator,
    drift: FloatArray | None = None,
) -> Detections:
    """Detections of `boxes`, of which a `share` (N,) is visible, and false detections; in world coordinates.

    drift (N,): relative errors of the range, see `range_drifts`; None: no drift
    """
    origin = sensor_position(sensor, world_T_ego)
    offset = (boxes.position - origin)[:, :2]
    distance = np.linalg.norm(offset, axis=1)
    chance = detection_probability(sensor, origin, boxes, share) * in_view(sensor, world_T_ego, boxes.position)
    seen = np.flatnonzero(rng.random(len(boxes)) < chance)
    n = len(seen)
    error, line_of_sight = position_errors(sensor, offset[seen], distance[seen], rng)
    position = boxes.position[seen].copy()
    position[:, :2] += error
    if drift is not None:
        position[:, :2] += drift[seen, None] * offset[seen]
    position[:, 2] += sensor.height_noise * rng.standard_normal(n)
    velocity = np.full((n, 2), np.nan)
    if sensor.velocity_noise is not None:
        velocity = boxes.velocity[seen] + sensor.velocity_noise * rng.standard_normal((n, 2))
    logit = (
        sensor.true_logit + 2 * (share[seen] - 1) - distance[seen] / 40 + sensor.logit_noise * rng.standard_normal(n)
    )
    true = Boxes(
        _reported_classes(sensor, boxes.label[seen], rng),
        position,
        boxes.size[seen] * np.exp(sensor.size_noise * rng.standard_normal((n, 3))),
        boxes.yaw[seen] + sensor.yaw_noise * rng.standard_normal(n),
        velocity,
    )
    rate = np.sum(boxes.velocity[seen] * line_of_sight, axis=1)
    false, false_logit = _clutter(sensor, world_T_ego, rng)
    order = rng.permutation(n + len(false))
    logits = np.concatenate([logit, false_logit])
    reported = Boxes.concatenate([true, false])
    if not sensor.boxes:
        reported = replace(reported, size=np.full_like(reported.size, np.nan), yaw=np.full(len(reported), np.nan))
    rates = np.full(len(reported), np.nan)
    if sensor.range_rate_noise is not None:
        rates = np.concatenate([rate, np.zeros(len(false))])
        rates = rates + sensor.range_rate_noise * rng.standard_normal(len(rates))
    return Detections(reported, 1 / (1 + np.exp(-logits)), rates).select(order)


def position_errors(
    sensor: SensorSettings, offset: FloatArray, distance: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random position errors (n, 2), m, and lines of sight (n, 2), at `offset` (n, 2) and `distance` (n,) from here."""
    line_of_sight = offset / np.maximum(distance, 0.1)[:, None]
    across = np.stack([-line_of_sight[:, 1], line_of_sight[:, 0]], axis=1)
    along_error = (sensor.range_noise[0] + sensor.range_noise[1] * distance) * rng.standard_normal(len(distance))
    across_error = (sensor.bearing_noise[0] + sensor.bearing_noise[1] * distance) * rng.standard_normal(len(distance))
    return along_error[:, None] * line_of_sight + across_error[:, None] * across, line_of_sight


def _reported_classes(sensor: SensorSettings, label: StrArray, rng: np.random.Generator) -> StrArray:
    """Reported classes (n,) of objects of classes `label` (n,): vehicles are confused with one another."""
    if sensor.class_accuracy == 1:
        return label
    kinds = np.array(sorted({kind.label for kind in KINDS}))
    k = np.searchsorted(kinds, label)
    known = kinds[np.minimum(k, len(kinds) - 1)] == label
    wrong = known & (rng.random(len(label)) > sensor.class_accuracy)
    other = kinds[(k + rng.integers(1, len(kinds), len(label))) % len(kinds)]
    return np.where(wrong, other, label)


def _clutter(sensor: SensorSettings, world_T_ego: FloatArray, rng: np.random.Generator) -> tuple[Boxes, FloatArray]:
    """False detections, Poisson in number and uniform over the area in view, and the logits of their scores."""
    n = int(rng.poisson(sensor.clutter_rate))
    bearing = yaw_of(world_T_ego) + sensor.field_of_view * (rng.random(n) - 0.5)
    distance = sensor.max_range * np.sqrt(rng.random(n))
    kind = rng.choice(len(CLUTTER), size=n, p=CLUTTER_SHARES)
    size = np.array([size for _, size in CLUTTER])[kind] * np.exp(0.1 * rng.standard_normal((n, 3)))
    origin = sensor_position(sensor, world_T_ego)
    position = np.column_stack(
        [
            origin[0] + distance * np.cos(bearing),
            origin[1] + distance * np.sin(bearing),
            size[:, 2] / 2 + sensor.height_noise * rng.standard_normal(n),
        ]
    )
    velocity = np.full((n, 2), np.nan)
    if sensor.velocity_noise is not None:
        velocity = sensor.velocity_noise * rng.standard_normal((n, 2))
    label = np.array([label for label, _ in CLUTTER])[kind]
    boxes = Boxes(label, position, size, rng.uniform(-np.pi, np.pi, n), velocity)
    return boxes, sensor.clutter_logit + sensor.logit_noise * rng.standard_normal(n)


BEYOND = 12.0  # m from a stop line to its light
HEIGHT = 5.0  # m of a light over the ground
HOUSING = (0.3, 0.4, 1.0)  # m
MAPPED = (-200.0, 150.0)  # m along the road from the focus: extent of the map
SPACING = 8.0  # m between the points of a mapped lane
AMBER_DURATION = 3.0  # duration of amber, the first part of the red phase, s
MAP_NOISE = 0.2  # standard deviation of positions in the map, m
OCCLUDER_MARGIN = 20.0  # m, half the length of the largest occluder and more
VISIBLE_RANGE = 80.0  # largest distance at which the colour of a light is visible, m


@dataclass(frozen=True, eq=False)
class Signal:
    """One light: position (2,), m, heading of approaching vehicles, rad, and red phases (K, 2), s, amber included."""

    name: str
    position: FloatArray
    heading: float
    red: FloatArray
    amber_duration: float

    def colour(self, time: float) -> str:
        """The colour shown at `time`."""
        now = np.flatnonzero((self.red[:, 0] <= time) & (time < self.red[:, 1]))
        if len(now) == 0:
            return "green"
        return "amber" if time < self.red[now[0], 0] + self.amber_duration else "red"


def signals_of(lanes: Lanes, lines: tuple[ClosingLine, ...]) -> tuple[Signal, ...]:
    """The lights of the stop lines."""
    signals: list[Signal] = []
    done: set[int] = set()
    for line in lines:
        if len(line.lanes) == 0 or id(line.red) in done:
            continue
        done.add(id(line.red))
        lane = line.lanes[:1]
        middle = np.array([lanes.offset[line.lanes].mean()])
        position, heading = lanes.pose(lane, np.array([line.s + BEYOND]), middle, np.zeros(1))
        signals.append(Signal(f"light-{len(signals)}", position[0], float(heading[0]), line.red, AMBER_DURATION))
    return tuple(signals)


def sample_map(
    lanes: Lanes,
    focus: float,
    lines: tuple[ClosingLine, ...],
    signals: tuple[Signal, ...],
    rng: np.random.Generator,
) -> road_map.RoadMap:
    """Map of the lights, stop lines and lanes around `focus` (m along the road), with random errors."""

    def point(position: FloatArray) -> road_map.Point:
        return float(position[0]), float(position[1])

    def error() -> FloatArray:
        return np.asarray(MAP_NOISE * rng.standard_normal(2))

    lights = tuple(road_map.TrafficLight(signal.name, point(signal.position + error())) for signal in signals)
    half = abs(lanes.offset[1] - lanes.offset[0]) / 2
    mapped = []
    for number, line in enumerate(lines):
        if len(line.lanes) == 0:
            continue
        name = next(signal.name for signal in signals if signal.red is line.red)
        sign = lanes.direction[line.lanes[0]]
        borders = lanes.offset[line.lanes].max() + half, lanes.offset[line.lanes].min() - half
        ends, _ = lanes.pose(np.repeat(line.lanes[:1], 2), np.full(2, line.s), np.array(borders[::sign]), np.zeros(2))
        left, right = ends + error()
        mapped.append(road_map.StopLine(f"line-{number}", point(left), point(right), name))
    without_cones = replace(lanes, taper=0.0)  # the map does not contain cones
    found = []
    for lane in range(len(lanes.offset)):
        along = np.arange(focus + MAPPED[0], focus + MAPPED[1], SPACING)
        s = along if lanes.direction[lane] > 0 else lanes.road.length - along[::-1]
        same = np.full(len(s), lane)
        d, slope = without_cones.lateral(same, s)
        centre, _ = lanes.pose(same, s, d, slope)
        moved = centre + error()
        found.append(road_map.Lane(f"lane-{lane}", tuple(map(point, moved)), 2 * float(half)))
    return road_map.RoadMap(lights, tuple(mapped), tuple(found), max(MAP_NOISE, 1e-3))


def detect_lights(
    sensor: SensorSettings,
    world_T_ego: FloatArray,
    signals: tuple[Signal, ...],
    time: float,
    rng: np.random.Generator,
) -> Detections:
    """Detections of the lights, in world coordinates, by a sensor that classifies colours."""
    if sensor.colour_accuracy is None or len(signals) == 0:
        return Detections.empty()
    true_position = np.array([signal.position for signal in signals])
    offset = true_position - sensor_position(sensor, world_T_ego)[:2]
    distance, bearing = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    faces = np.cos(bearing - np.array([signal.heading for signal in signals])) > 0.5
    within = (distance <= VISIBLE_RANGE) & (
        np.abs(wrap_angle(bearing - yaw_of(world_T_ego))) <= sensor.field_of_view / 2
    )
    seen = np.flatnonzero(faces & within & (rng.random(len(signals)) < sensor.detection_probability))
    if len(seen) == 0:
        return Detections.empty()
    labels = []
    for row in seen.tolist():
        true = signals[row].colour(time)
        wrong = [colour for colour in COLOURS if colour != true]
        right = rng.random() < sensor.colour_accuracy
        labels.append(f"traffic_light_{true if right else wrong[int(rng.integers(2))]}")
    n = len(seen)
    error, _ = position_errors(sensor, offset[seen], distance[seen], rng)
    position = np.column_stack([true_position[seen] + error, np.full(n, HEIGHT)])
    logit = sensor.true_logit + sensor.logit_noise * rng.standard_normal(n)
    size, nothing = np.tile(np.array(HOUSING), (n, 1)), np.full((n, 2), np.nan)
    boxes = Boxes(np.array(labels), position, size, np.full(n, np.nan), nothing)
    return Detections(boxes, 1 / (1 + np.exp(-logit)))


@dataclass(frozen=True, eq=False)
class SensedWorld:
    """The ground truth of one scene, and a vehicle with sensors in it.

    objects    objects that can be detected and annotated
    occluders  objects that only hide others
    ego_pose   world_T_ego (4, 4) at a time, s, on the ground z = 0
    signals    traffic lights
    road_map   map of lights, stop lines and lanes given with the frames, or None
    """

    objects: SimulatedTrajectories
    occluders: Boxes
    ego_pose: Callable[[float], FloatArray]
    signals: tuple[Signal, ...]
    road_map: RoadMap | None

    @property
    def start(self) -> float:
        """Time of the first state, s."""
        return float(self.objects.time[0])

    def visible_from(self, point: FloatArray, time: float, reach: float) -> tuple[Boxes, BoolArray, FloatArray]:
        """Objects as seen from a point (3,) at `time`, behind one another and behind occluders.

        Returns all N objects, a mask (N,) of those within `reach`, m, and the visible share of each of these.
        """
        away = np.linalg.norm(self.occluders.position[:, :2] - point[:2], axis=1)
        boxes, present = self.objects.at(time)
        near = present & (np.linalg.norm(boxes.position[:, :2] - point[:2], axis=1) <= reach)
        around = Boxes.concatenate([boxes.select(near), self.occluders.select(away <= reach + OCCLUDER_MARGIN)])
        return boxes, near, visible_share(point, around, np.arange(int(near.sum())))


VISIBLE_SHARE = 0.25  # least share of an object that a sensor must see for it to count as visible


def annotate(
    world: SensedWorld, time: FloatArray, world_T_ego: FloatArray, settings: SimulatorSettings
) -> tuple[Annotations, ...]:
    """Ground truth at the keyframes `time` (K,), s, with the poses of the vehicle (K, 4, 4)."""
    boxes_at, present = zip(*(world.objects.at(t) for t in time), strict=True)
    near, visible = np.zeros((2, len(time), len(world.objects)), dtype=np.bool_)
    for k, (t, pose, boxes) in enumerate(zip(time, world_T_ego, boxes_at, strict=True)):
        distance = np.linalg.norm(boxes.position[:, :2] - pose[:2, 3], axis=1)
        near[k] = present[k] & (distance <= settings.annotation_range)
        for sensor in settings.sensors.values():
            _, reached, share = world.visible_from(sensor_position(sensor, pose), t, sensor.max_range)
            seen = np.zeros(len(boxes), dtype=np.bool_)
            seen[reached] = share >= VISIBLE_SHARE
            visible[k] |= seen & in_view(sensor, pose, boxes.position)
    visible &= near
    annotated = near & recently_visible(time, visible, settings.memory)
    visible = without_short_runs(visible, round(settings.shortest_view * settings.keyframe_rate))
    return tuple(
        Annotations(world.objects.id[rows], boxes.select(rows), visible[k, rows])
        for k, (boxes, rows) in enumerate(zip(boxes_at, annotated, strict=True))
    )


def without_short_runs(visible: BoolArray, shortest: int) -> BoolArray:
    """`visible` (K, N) without runs along the first axis shorter than `shortest` keyframes."""
    from scipy import ndimage  # a tenth of a second, which every help of the command would pay

    return np.asarray(ndimage.binary_opening(visible, np.ones((max(shortest, 1), 1))))


def recently_visible(time: FloatArray, visible: BoolArray, memory: float) -> BoolArray:
    """Mask (K, N) of the objects that are visible or were so at most `memory` s ago; time (K,), s."""
    seen = np.where(visible, time[:, None], -np.inf)
    return np.asarray(time[:, None] - np.maximum.accumulate(seen, axis=0) <= memory + 1e-9)
