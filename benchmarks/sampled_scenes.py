"""Scenes sampled from the interaction model itself: groups that share their velocity, seen by a sensor with gaps.

The truth moves by the scene graph's own dynamics: edges between all members of a group, frozen for the interval, and
white noise accelerations of every object. Members are detected with noise, among false detections; now and then a whole
group, or an object alone, is hidden, as behind a lorry. The tracker knows neither the groups nor who is hidden.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.flocks import sample_step
from pipelines.config import TrackConfig
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable, SharedVelocity
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.tracking import AssociationSettings, ClassSettings, ExistenceSettings, TrackerSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

LABEL = "car"
SIZE = (4.5, 1.9, 1.6)
INTERVAL = 0.2  # s
SPEED = 6.0  # of a group at the start, m/s
APART = 45.0  # between groups at the start, m
SCORE = 0.8  # of every detection, true or false
CLUTTER_AREA = 1e4  # over which what is false is spread, m^2


@dataclass(frozen=True)
class SceneSettings:
    """Parameters of the scenes.

    coupling  total rate at which an object takes over the velocity of its group, 1/s
    noise     standard deviation of a detected position, m
    hidden    share of the time in which an object is hidden, half of it alone, half of it with its group
    spacing   between neighbours of a group at the start, m
    """

    coupling: float = 2.0
    noise: float = 0.3
    hidden: float = 0.2
    spacing: float = 4.0
    groups: int = 4
    members: int = 5
    acceleration_noise: float = 0.5
    hidden_for: float = 2.0
    detected: float = 0.95
    clutter: float = 1.0
    seconds: float = 20.0

    @property
    def rule(self) -> Neighbours:
        """The true interaction, as an edge rule: all in a group pull each other alike."""
        return Neighbours(
            SharedVelocity(),
            rate=self.coupling / max(self.members - 1, 1),
            distance_scale=20.0,
            heading_scale=1.0,
            speed_scale=2.0,
            max_distance=20.0,
            min_speed=1.0,
            max_degree=self.members - 1,
            classes=(LABEL,),
        )


def sampled_config(settings: SceneSettings, edges: tuple[Following | Neighbours, ...] | None = None) -> TrackConfig:
    """Settings of trackers that know the true parameters; the edges are the true ones if left out.

    Objects come from anywhere, are hidden for any time, and a miss says little: they may be hidden.
    """
    of_class = ClassSettings(
        motion=ConstantVelocity(settings.acceleration_noise),
        initial_speed_deviation=SPEED,
        initial_lateral_speed_deviation=SPEED,
        initiation_score=0.0,
        nms_distance=0.0,
        max_distance=30.0,
        max_deviation=math.inf,
    )
    tracker = TrackerSettings(
        classes={DEFAULT: of_class},
        edges=(settings.rule,) if edges is None else edges,
        association=AssociationSettings(clutter_area=CLUTTER_AREA, existence_weight=0.1, score_weight=1.0),
        existence=ExistenceSettings(report_above=0.9, confirm_above=0.95),
        max_coasting=4 * settings.hidden_for,
        report_coasting=2 * INTERVAL,
        max_out_of_view=4 * settings.hidden_for,
    )
    noise = {DEFAULT: NoiseModel(position=settings.noise)}
    return TrackConfig(tracker, sensors={DEFAULT: Sensor(noise=noise, detection_probability=settings.detected)})


def sample_scene(settings: SceneSettings, seed: int) -> Scene:
    """One scene with its ground truth."""
    rng = np.random.default_rng(seed)
    n = settings.groups * settings.members
    group = np.repeat(np.arange(settings.groups), settings.members)
    x = _start(settings, group, rng)
    steps = round(settings.seconds / INTERVAL)
    visible = ~_hidden(settings, group, steps, rng)
    car = NodeType(LABEL, ConstantVelocity(settings.acceleration_noise))
    names = np.array([f"object-{k:02d}" for k in range(n)])
    frames, truth = [], []
    for step in range(steps):
        if step:
            x = sample_step(_transition(x, car, settings), x, rng)
        boxes = _boxes(x[:, :2], x[:, 2:])
        truth.append(Annotations(names, boxes, visible[step]))
        frames.append(_frame(step * INTERVAL, x, visible[step], settings, rng))
    times = np.arange(steps, dtype=np.float64) * INTERVAL
    pose = np.tile(np.eye(4), (steps, 1, 1))
    return Scene(f"sampled-{seed:04d}", times, pose, ("",) * steps, tuple(frames), tuple(truth))


def _start(settings: SceneSettings, group: IntArray, rng: np.random.Generator) -> FloatArray:
    """(n, 4): groups in a row of clusters, each with a velocity of its own."""
    side = int(np.ceil(np.sqrt(settings.members)))
    member = np.arange(len(group)) % settings.members
    grid = np.stack([member % side, member // side], axis=-1) * settings.spacing
    heading = rng.uniform(-np.pi, np.pi, settings.groups)
    columns = int(np.ceil(np.sqrt(settings.groups)))
    centre = APART * np.stack([np.arange(settings.groups) % columns, np.arange(settings.groups) // columns], axis=-1)
    position = centre[group] + grid + 0.1 * settings.spacing * rng.normal(size=grid.shape)
    return np.concatenate([position, SPEED * np.stack([np.cos(heading), np.sin(heading)], axis=-1)[group]], axis=1)


def _transition(x: FloatArray, car: NodeType, settings: SceneSettings) -> Transition:
    """The dynamics of the next interval, by the rule at the true states."""
    n = len(x)
    heading = np.arctan2(x[:, 3], x[:, 2])
    nodes = NodeTable(
        np.arange(n), np.full(n, LABEL), (car,) * n, x[:, :2], x[:, 2:], heading, np.full(n, SIZE[0]), np.zeros(n)
    )
    return discretise(build_graph(nodes, (settings.rule,)), INTERVAL)


def _hidden(settings: SceneSettings, group: IntArray, steps: int, rng: np.random.Generator) -> BoolArray:
    """(steps, n) who is hidden."""
    length = round(settings.hidden_for / INTERVAL)
    begins = settings.hidden / 2 / length
    hidden = np.zeros((steps, len(group)), dtype=np.bool_)
    for step in np.arange(length, steps - length):
        for g in np.flatnonzero(rng.random(settings.groups) < begins):
            hidden[step : step + length, group == g] = True
        for k in np.flatnonzero(rng.random(len(group)) < begins):
            hidden[step : step + length, k] = True
    return hidden


def _frame(time: float, x: FloatArray, visible: BoolArray, settings: SceneSettings, rng: np.random.Generator) -> Frame:
    seen = visible & (rng.random(len(x)) < settings.detected)
    z = x[seen, :2] + settings.noise * rng.normal(size=(int(seen.sum()), 2))
    low, high = x[:, :2].min(axis=0) - 10.0, x[:, :2].max(axis=0) + 10.0
    false = rng.uniform(low, high, (rng.poisson(settings.clutter), 2))
    position = rng.permutation(np.concatenate([z, false]))
    boxes = _boxes(position, np.full_like(position, np.nan))
    return Frame(time, "lidar", Detections(boxes, np.full(len(position), SCORE)), np.eye(4))


def _boxes(position: FloatArray, velocity: FloatArray) -> Boxes:
    n = len(position)
    centre = np.concatenate([position, np.zeros((n, 1))], axis=1)
    return Boxes.of(np.full(n, LABEL), centre, np.tile(SIZE, (n, 1)), np.full(n, np.nan), velocity)
