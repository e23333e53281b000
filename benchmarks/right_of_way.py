"""Who yields to whom, and who takes whose right of way, told by the tracker against a known rule.

Simulated vehicles go by the rule of a crossing or merge (`benchmarks.crossings`), which says at every moment
who waits for whom; a share `--takers` do not wait. The tracker is given detections alone. Two measures:

    pairs    of vehicles: a true one, of `SHORTEST` s or more, is found where the relation is told while it is true, and
             a told one, of `SHORTEST` s or more, is right where it is true meanwhile
    moments  of pairs

A tenth of the drivers turn to either side, and nobody signals it: a pair is told by the routes that they seem to take.
`of those that meet` is the precision of told pairs whose routes do meet.

`--fit` fits the weights of `saga_fg.tracking.right_of_way` to other scenes of the same kinds. There the judgement is
given true vehicles with errors like those of tracks, which takes a tenth of the time, and pairs are judged by
the logistic loss.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, cast, get_args

import numpy as np
import scipy.optimize
import scipy.special
import typer

from benchmarks.crossings import RATE, STEP, UNSEEN, CrossingWorld, Rule, build_crossing, crossing_scene
from benchmarks.runner import Row, Rows, chosen
from pipelines.cli.options import Config
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import one_thread
from saga_fg.model import NodeTable, Paths
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.tracking.edge_record import HaltingPlaces
from saga_fg.tracking.prediction import SHARPEST_TURN, STEPS
from saga_fg.tracking.right_of_way import INTERVAL, JOINS, PERSON, WALKS, RightOfWay
from saga_fg.tracking.track_filters import MOVING, Kinematics
from saga_fg.tracking.traffic import STEP as PATH_STEP
from saga_fg.tracking.traffic import Passages, Traffic, TrafficSettings, paths, straight_paths
from saga_fg.types import RELATIONS, Tracks

FITTED = 0  # first seed of scenes to which the weights are fitted
SETTLES = 20.0  # s, in which the tracker learns the ways of traffic: not judged
SHORTEST, OVERLAP = 0.5, 0.2  # s
NEAR = 2.0  # m from a vehicle to its track
FIT_DURATION, FIT_SETTLES, THINNED = 120.0, 5.0, 3  # s of a scene; s not used; one pair in so many is used
POSITION, SPEED, KEPT, YAW = 0.12, 0.15, 0.7, 0.03  # m, m/s, share of it that lasts, rad: errors of vehicles
UNITS, DECAY = 8, 1e-5  # hidden units; weight of the squares of all weights
JOINING_UNITS = 10, 2e-5  # of those that tell who takes the right of way
WALKING_UNITS = 4, 1e-4  # of those that tell who of a person and a vehicle yields

RULES = ",".join(get_args(Rule))

Pair = tuple[int, int, int]


@dataclass
class Told:
    """Seconds of pairs, by scene and vehicles, in which a relation is true, told, and both; and pairs whose routes
    meet."""

    true: dict[Pair, float] = field(default_factory=dict)
    told: dict[Pair, float] = field(default_factory=dict)
    both: dict[Pair, float] = field(default_factory=dict)
    meeting: set[Pair] = field(default_factory=set)

    def add(self, seed: int, true: set[tuple[int, int]], told: set[tuple[int, int]], seconds: float) -> None:
        """Add one moment of a scene."""
        for total, pairs in ((self.true, true), (self.told, told), (self.both, true & told)):
            for pair in pairs:
                total[seed, *pair] = total.get((seed, *pair), 0.0) + seconds

    def figures(self) -> Mapping[str, Any]:
        """Precision and recall of pairs and of moments."""
        true, told = ({p for p, s in each.items() if s >= SHORTEST} for each in (self.true, self.told))
        met = {p for p, s in self.both.items() if s >= OVERLAP}
        seconds = [sum(each.values()) for each in (self.both, self.told, self.true)]
        nan = float("nan")
        return {
            "true pairs": len(true),
            "told pairs": len(told),
            "precision": len(told & met) / len(told) if told else nan,
            "of those that meet": len(told & met) / len(told & self.meeting) if told & self.meeting else nan,
            "recall": len(true & met) / len(true) if true else nan,
            "precision of moments": seconds[0] / seconds[1] if seconds[1] else nan,
            "recall of moments": seconds[0] / seconds[2] if seconds[2] else nan,
        }


def right_of_way(
    *,
    rules: Annotated[str, typer.Option("--rules", help="Of crossings and merges, with commas.")] = RULES,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Of each rule.")] = 6,
    first: Annotated[int, typer.Option("--first", min=0, help="Seed of the first scene.")] = UNSEEN,
    takers: Annotated[float, typer.Option("--takers", min=0, max=1, help="Share of drivers who do not wait.")] = 0.3,
    fit: Annotated[bool, typer.Option("--fit", help="Fit the weights, and print them in place of figures.")] = False,
    config: Config = None,
) -> Rows:
    """Who yields to whom at crossings and merges: precision and recall, on scenes that no weight was fitted to.

    \b
    Examples:
      python -m benchmarks right-of-way --scenes 6
      python -m benchmarks right-of-way --fit --scenes 10
    """
    named = [cast(Rule, rule) for rule in chosen("--rules", rules, get_args(Rule))]
    if fit:
        yield from fitted_rows(named, range(FITTED, FITTED + scenes), takers)
        return
    base = load_config("traffic", config)
    for rule in named:
        told = {name: Told() for name in RELATIONS}
        for seed in range(first, first + scenes):
            judge_scene(rule, seed, takers, base, told)
        for name, one in told.items():
            yield "right of way", {"rule": rule, "scenes": scenes, "relation": name, **one.figures()}


def judge_scene(rule: Rule, seed: int, takers: float, base: TrackConfig, found: Mapping[str, Told]) -> None:
    """Track a scene and add what is told in it."""
    world = build_crossing(rule, seed, takers=takers)
    scene, tracker = crossing_scene(world, seed), base.new_tracker("saga")
    for one in found.values():
        one.meeting.update((seed, int(i), int(j)) for i, j in np.argwhere(world.meet))
    with one_thread():
        for frame in scene.frames:
            tracks, elapsed = tracker.step(frame), frame.timestamp - float(scene.timestamps[0])
            if elapsed < SETTLES:
                continue
            moment = min(round(elapsed / STEP), len(world.yields) - 1)
            vehicles = vehicles_of(tracks, world, moment)
            rows = [row for row in tracks.relations.rows() if row[0] in vehicles and row[1] in vehicles]
            for (name, one), here in zip(found.items(), (world.yields, world.takes), strict=True):
                true = {(int(i), int(j)) for i, j in np.argwhere(here[moment])}
                told = {(vehicles[i], vehicles[j]) for i, j, relation, _ in rows if relation == name}
                one.add(seed, true, told, 1 / RATE)


def vehicles_of(tracks: Tracks, world: CrossingWorld, moment: int) -> dict[int, int]:
    """The vehicle (row of the world) of each track, by its id; none for tracks farther than `NEAR` from all."""
    n = world.yields.shape[1]
    place = np.where(world.objects.present[moment, :n, None], world.objects.position[moment, :n], np.inf)
    away = np.linalg.norm(tracks.boxes.position[:, None, :2] - place, axis=2)
    nearest: IntArray = away.argmin(axis=1)
    near = away[np.arange(len(tracks)), nearest] < NEAR
    return dict(zip(tracks.id[near].tolist(), nearest[near].tolist(), strict=True))


def fitted_rows(rules: list[Rule], seeds: range, takers: float) -> Iterator[Row]:
    """The weights fitted to scenes: of hidden units a row for each piece of evidence and the constant, then their own.

    Each relation has units of its own, the second one those of `JOINING_UNITS`, fitted where ways come together; so
    have pairs of a person and a vehicle.
    """
    pieces = [piece for rule in rules for seed in seeds for piece in judged_pairs(rule, seed, takers)]
    evidence, answer = (np.concatenate(each) for each in zip(*pieces, strict=True))
    joins, person = evidence[:, JOINS] > 0, evidence[:, WALKS] != 0
    parts = {
        "YIELDING": (np.flatnonzero(~person)[::THINNED], 0, UNITS, DECAY),
        "TAKING": (np.flatnonzero(joins), 1, *JOINING_UNITS),
        "WALKING": (np.flatnonzero(person)[::THINNED], 0, *WALKING_UNITS),
    }
    for title, (rows, relation, units, decay) in parts.items():
        if len(rows):
            given = evidence[rows] if title == "WALKING" else np.delete(evidence[rows], WALKS, axis=1)
            for row in (*(found := fitted_weights(given, answer[rows, relation], units, decay))[0], found[1]):
                yield title, {f"{number}": round(float(value), 2) for number, value in enumerate(row)}


def judged_pairs(rule: Rule, seed: int, takers: float) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Evidence (E, F) of pairs, and whether each of `RELATIONS` is true (E, 2)."""
    world, rng = build_crossing(rule, seed, FIT_DURATION, takers=takers), np.random.default_rng(seed)
    objects, n = world.objects, world.yields.shape[1]
    traffic, halting, known = Traffic(TrafficSettings(memory=60.0)), HaltingPlaces(), RightOfWay()
    error, has_moved = np.zeros((n, 2)), np.zeros(n)
    for moment in range(0, round(FIT_DURATION / STEP), round(INTERVAL / STEP)):
        time, rows = moment * STEP, np.flatnonzero(objects.present[moment, :n])
        error = KEPT * error + rng.normal(0.0, SPEED, (n, 2))
        velocity = objects.velocity[moment, rows] + error[rows]
        position = objects.position[moment, rows] + rng.normal(0.0, POSITION, (len(rows), 2))
        yaw = objects.yaw[moment, rows] + rng.normal(0.0, YAW, len(rows))
        speed, label = np.hypot(*velocity.T), objects.label[rows]
        has_moved[rows] = np.maximum(has_moved[rows], speed > MOVING)
        covariance = np.tile(SPEED**2 * np.eye(2), (len(rows), 1, 1))
        now = Kinematics(position, velocity, covariance, covariance)
        traffic.update(Passages.from_tracks(rows, label, now, yaw, speed > MOVING, time), time)
        length, variance = objects.size[rows, 0], covariance[:, 0, 0]
        moved = has_moved[rows]
        nodes = NodeTable(rows, label, (), position, velocity, yaw, length, variance, has_moved=moved)
        halting = halting.later(nodes, np.ones(len(rows), dtype=np.bool_), time)
        lasting = np.maximum(speed, MOVING)[:, None]
        sharpest = SHARPEST_TURN / lasting * np.concatenate([0 * lasting + INTERVAL, PATH_STEP / lasting], axis=1)
        walks = label == PERSON
        ways = paths(traffic, rows, position, yaw, 0 * speed, sharpest, STEPS)
        people = straight_paths(rows, position, yaw, STEPS).select(np.flatnonzero(walks))
        ways = Paths.concatenate([ways.select(np.flatnonzero((moved > 0) & ~walks)), people])
        known, pairs, evidence = known.observed(nodes, ways, halting.lines, time)
        if pairs and time >= FIT_SETTLES:
            i, j = np.array(pairs).T
            yield evidence, np.column_stack([world.yields[moment, i, j], world.takes[moment, i, j]])


def fitted_weights(evidence: FloatArray, answer: BoolArray, units: int, decay: float) -> tuple[FloatArray, FloatArray]:
    """Weights (F + 1, units) of the hidden units and (units + 1,) of what they say, by least logistic loss."""
    given, count = np.column_stack([evidence, np.ones(len(evidence))]), len(evidence)
    split = given.shape[1] * units

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        first, second = weights[:split].reshape(-1, units), weights[split:]
        hidden = np.column_stack([np.tanh(given @ first), np.ones(count)])
        logits = hidden @ second
        slope = (scipy.special.expit(logits) - answer) / count
        back = slope[:, None] * second[:-1] * (1 - hidden[:, :-1] ** 2)
        value = (np.logaddexp(0.0, logits) - answer * logits).mean() + decay / 2 * (weights**2).sum()
        return float(value), np.concatenate([(given.T @ back).ravel(), hidden.T @ slope]) + decay * weights

    begin = np.random.default_rng(0).normal(0.0, 0.3, split + units + 1)
    found = scipy.optimize.minimize(loss, begin, jac=True, method="L-BFGS-B", options={"maxiter": 400}).x
    return found[:split].reshape(-1, units), found[split:]
