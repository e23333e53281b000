"""Factors of users' own in offline smoothing: they act, are named when they fail, and without any nothing changes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from factors import ResidualFactors, prior_factor
from saga_fg.graph import LANDMARK, OBJECT, Additions, FactorProvider, GraphError, GraphView, NewVariable
from saga_fg.model.edge_rules import Neighbours
from saga_fg.numerics.arrays import FloatArray
from saga_fg.smoothing import (
    ObjectMotion,
    SmoothedEdges,
    StateTable,
    StationaryStates,
    gather_evidence,
    lifespans_of,
    smooth_states,
)
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame
from tests.saga_fg.smoothing.test_smoothing_states import CLASSES, SENSORS

PLACE = np.array([4e5, -2e5])  # of the scene in the world
WALL = PLACE[1] + 4.0


class Quiet:
    name = "quiet"

    def __init__(self) -> None:
        self.asked: list[tuple[float, set[tuple[str, int]]]] = []

    def factors(self, view: GraphView) -> Additions:
        self.asked.append((view.time, {(one.label, one.id) for one in view.now(OBJECT).values()}))
        return Additions()


class Wall:
    """Pedestrians keep half a metre away from it."""

    name = "wall"

    def factors(self, view: GraphView) -> Additions:
        rows = [[one.key] for one in view.now(OBJECT).values() if one.label == "pedestrian"]
        keeps_off = partial(crowded, view.origin)
        return Additions(factors=[ResidualFactors(rows, (4,), keeps_off, 0.01 * np.eye(1), name="keeps off the wall")])


def crowded(origin: FloatArray, x: FloatArray) -> FloatArray:
    return np.logaddexp(0.0, (x[:, 1:2] + origin[1] - (WALL - 0.5)) / 0.1)


class Post:
    """One variable for all time, at which whoever is first looks."""

    name = "post"

    def factors(self, view: GraphView) -> Additions:
        key = view.key(LANDMARK, 0, static=True)
        new = NewVariable(LANDMARK, 0, np.zeros(2), static=True)
        rows = [[one.key, key] for one in list(view.now(OBJECT).values())[:1]]
        beside = ResidualFactors(rows, (4, 2), lambda x, p: x[:, :2] - p, np.eye(2))
        first = not view.static(LANDMARK)
        return Additions([new] * first, [prior_factor(key, np.zeros(2), np.eye(2)), beside] if first else [beside])


def states(providers: Sequence[FactorProvider] = ()) -> StateTable:
    """Two pedestrians who walk towards a wall, a parked car, one who comes late and goes early; seen in the world."""
    rng, frames, owner = np.random.default_rng(1), [], []
    for k in range(16):
        seen = [(0, "pedestrian", (0.4 * k, 2.0 + 0.1 * k)), (1, "pedestrian", (0.4 * k, 1.0 + 0.15 * k))]
        seen += [(2, "car", (20.0, 0.0))] + [(3, "pedestrian", (9.0 - 0.4 * k, 0.0))] * (4 < k < 12)
        position = [[*(PLACE + at + rng.normal(0, 0.1, 2)), 0.0] for _, _, at in seen]
        boxes = Boxes.of([label for _, label, _ in seen], position)
        frames.append(Frame(0.5 * k + 1.7e9, "lidar", Detections(boxes, np.full(len(seen), 0.9))))
        owner += [i for i, _, _ in seen]
    near = {"default": ClassSettings(nms_distance=0.0)}
    evidence = gather_evidence(frames, np.array([1.7e9 + 7.25]), SENSORS, near)
    object_of = np.array(owner)
    lifespans = lifespans_of(object_of, evidence.boxes.label, evidence.moment)
    V, n = np.tile(25 * np.eye(2), (4, 1, 1)), len(lifespans)
    alone = smooth_states(evidence, object_of, lifespans, ObjectMotion(V, CLASSES))
    rules = (Neighbours(min_speed=0.2, classes=("pedestrian",)),)
    edges = SmoothedEdges(rules, 0.0, lifespans, alone, np.full(n, np.nan), np.full(n, 0.5))
    moments = np.arange(len(evidence.times))
    stands = StationaryStates(0.03, moments, np.full(len(moments), 2))
    weight = np.where(object_of == 1, 0.5, 1.0)
    return smooth_states(evidence, object_of, lifespans, ObjectMotion(V, CLASSES, edges, stands), weight, providers)


def test_the_graph_is_the_problem_that_is_solved_without_providers() -> None:
    plain, quiet = states(), Quiet()
    asked = states([quiet])
    assert asked.id.tolist() == plain.id.tolist()
    sigma = np.sqrt(np.diagonal(plain.covariance, axis1=1, axis2=2))
    assert np.abs((asked.mean - plain.mean) / sigma).max() < 1e-7
    np.testing.assert_allclose(asked.covariance, plain.covariance, rtol=1e-7, atol=1e-10)
    assert len(quiet.asked) == 17
    assert quiet.asked[0] == (1.7e9, {("pedestrian", 0), ("pedestrian", 1), ("car", 2)})
    assert quiet.asked[5][1] == {("pedestrian", 0), ("pedestrian", 1), ("car", 2), ("pedestrian", 3)}


def test_a_wall_keeps_pedestrians_away() -> None:
    plain, walled = states(), states([Wall()])
    near = (plain.id == 0) & (plain.moment > 12)
    assert (walled.mean[near, 1] < plain.mean[near, 1] - 0.02).all()
    assert (walled.covariance[near, 1, 1] < plain.covariance[near, 1, 1]).all()
    np.testing.assert_allclose(walled.mean[plain.id == 2], plain.mean[plain.id == 2], atol=1e-6)


def test_a_provider_may_bring_variables_of_its_own() -> None:
    assert np.abs(states([Post()]).mean - states().mean).max() > 0.01


class Wrong:
    name = "wrong"

    def factors(self, view: GraphView) -> Additions:
        rows = [[one.key] for one in view.now(OBJECT).values()]
        return Additions(factors=[ResidualFactors(rows, (6,), lambda x: x[:, :1], np.eye(1), name="too wide")])


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(GraphError, match=r"provider wrong: too wide on pedestrian 0 at .* s: expected variables"):
        states([Wrong()])
