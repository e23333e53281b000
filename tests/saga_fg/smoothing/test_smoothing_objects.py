"""Objects of a recording, and providers of factors on them."""

import tracemalloc
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from factors import ResidualFactors, prior_factor
from saga_fg.graph import LANDMARK, OBJECT, Additions, FactorProvider, GraphError, GraphView, NewVariable
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.motion import NodeType
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing import (
    Evidence,
    Lifespans,
    ObjectMotion,
    OfflineClass,
    SmoothedEdges,
    StateTable,
    StationaryStates,
    assign_free_detections,
    evidence_scores,
    frame_rate,
    gather_evidence,
    lifespans_of,
    smooth_headings,
    smooth_states,
    stationary_states,
    stitch_tracklets,
)
from saga_fg.smoothing.boxes import row_votes
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame
from tests.saga_fg.smoothing.test_smoothing_states import CLASSES as PROVIDERS_CLASSES
from tests.saga_fg.smoothing.test_smoothing_states import SENSORS as PROVIDERS_SENSORS

SENSORS = {"default": Sensor({"default": NoiseModel(position=0.1)})}
CLASSES = {"default": OfflineClass(acceleration_noise=0.5)}
TIMES = np.arange(20) * 0.5


def gathered(paths: dict[int, FloatArray], times: FloatArray = TIMES, score: float = 0.9) -> tuple[Evidence, IntArray]:
    """Cars by number, positions (T, 2) with NaN where one is not detected; and the number of each detection."""
    frames, numbers = [], []
    for k, time in enumerate(times.tolist()):
        there = [number for number, path in paths.items() if np.isfinite(path[k]).all()]
        position = np.array([[*paths[number][k], 0.0] for number in there]).reshape(-1, 3)
        boxes = Boxes.of(["car"] * len(there), position, yaw=np.zeros(len(there)))
        frames.append(Frame(time, "lidar", Detections(boxes, np.full(len(there), score))))
        numbers += there
    near = {"default": ClassSettings(nms_distance=0.0)}
    return gather_evidence(frames, times, SENSORS, near), np.array(numbers, dtype=np.int64)


def line(first: int, last: int, start: tuple[float, float], velocity: tuple[float, float]) -> FloatArray:
    """A straight path, seen from moment `first` to `last`."""
    path = np.array(start) + TIMES[:, None] * np.array(velocity)
    path[(np.arange(len(TIMES)) < first) | (np.arange(len(TIMES)) > last)] = np.nan
    return path


def joined(paths: dict[int, FloatArray], max_gap: float = 3.0) -> dict[int, int]:
    evidence, numbers = gathered(paths)
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    prior = np.tile(25.0 * np.eye(2), (len(lifespans), 1, 1))
    longer = lifespans.reaching(evidence.times, 1.0, max_gap)
    states = smooth_states(evidence, numbers, longer, ObjectMotion(prior, CLASSES))
    return dict(
        zip(lifespans.id.tolist(), stitch_tracklets(lifespans, states, prior, evidence, max_gap).tolist(), strict=True)
    )


def test_motions_over_gaps_are_one_object_and_other_motions_new_ones():
    paths = {4: line(0, 5, (0, 0), (5, 0)), 7: line(9, 12, (0, 0), (5, 0)), 2: line(15, 19, (0, 0), (5, 0))}
    assert joined(paths) == {4: 4, 7: 4, 2: 4}
    paths = {
        0: line(0, 6, (0, 0), (5, 0)), 1: line(0, 6, (23, -23), (0, 5)),
        2: line(11, 19, (0, 0), (5, 0)), 3: line(11, 19, (23, -23), (0, 5)),
    }  # fmt: skip
    assert joined(paths) == {0: 0, 1: 1, 2: 0, 3: 1}
    paths = {0: line(0, 6, (0, 0), (5, 0)), 1: line(9, 19, (0, 30), (5, 0))}
    assert joined(paths) == {0: 0, 1: 1}
    paths = {0: line(0, 6, (0, 0), (5, 0)), 1: line(12, 19, (0, 0), (5, 0))}
    assert joined(paths, max_gap=1.0) == {0: 0, 1: 1}


def test_an_object_claims_detections_before_its_initiation_but_not_those_of_others():
    evidence, numbers = gathered({0: line(0, 19, (0, 0), (5, 0)), 1: line(0, 19, (0, 20), (5, 0))})
    tracked = np.where(evidence.moment < 2, -1, numbers)
    lifespans = lifespans_of(tracked, evidence.boxes.label, evidence.moment)
    prior = np.tile(25.0 * np.eye(2), (2, 1, 1))
    longer = lifespans.reaching(evidence.times, 1.5, 0.0)
    states = smooth_states(evidence, tracked, longer, ObjectMotion(prior, CLASSES))
    assert assign_free_detections(evidence, tracked, lifespans, states, 0.99, 3.0).tolist() == numbers.tolist()
    assert assign_free_detections(evidence, tracked, lifespans, states, 0.0, 3.0).tolist() == tracked.tolist()


def test_parked_and_waiting_cars_stand_and_creeping_ones_do_not():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.1, (20, 2))
    waits = np.where(TIMES[:, None] < 4, [[0.0, 20.0]], [[0.0, 20.0]] + 4.0 * (TIMES[:, None] - 4) * [[1.0, 0.0]])
    paths = {0: noise, 1: waits + noise, 2: line(0, 19, (0, 40), (0.3, 0)) + noise}
    evidence, numbers = gathered(paths)
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, numbers, lifespans, ObjectMotion(np.tile(25.0 * np.eye(2), (3, 1, 1)), CLASSES))
    standing = stationary_states(states, lifespans, evidence, numbers, 0.03, CLASSES)
    assert sorted(standing.moment[standing.id == 0].tolist()) == list(range(20))
    assert set(standing.moment[standing.id == 1].tolist()) <= set(range(9))
    assert (standing.id == 1).sum() >= 5
    assert (standing.id == 2).sum() == 0


def test_a_score_is_the_mean_over_all_opportunities_and_those_of_the_prior():
    evidence, numbers = gathered({0: line(0, 9, (0, 0), (1, 0)), 1: line(5, 5, (0, 9), (0, 0))}, score=0.8)
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, numbers, lifespans, ObjectMotion(np.tile(25.0 * np.eye(2), (2, 1, 1)), CLASSES))
    assert frame_rate(evidence) == pytest.approx(2.0)
    score = evidence_scores(evidence, numbers, lifespans, states, prior_opportunity_time=1.0)
    assert score.tolist() == pytest.approx([8.0 / 12.0, 0.8 / 3.0])


def test_the_front_is_where_an_object_drives_else_what_most_detections_say():
    evidence, numbers = gathered({0: line(0, 19, (0, 0), (-5, 0)), 1: line(0, 19, (0, 20), (0, 0))})
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, numbers, lifespans, ObjectMotion(np.tile(25.0 * np.eye(2), (2, 1, 1)), CLASSES))
    rows = np.arange(len(evidence))
    at = states.rows_of(evidence.moment, numbers)
    size = np.tile([4.5, 1.8, 1.5], (2, 1))
    found = smooth_headings(states, lifespans, evidence, rows, at, np.full(len(states), 0.01), np.full(2, 2.0), size)
    yaw, variance = found.yaw, found.variance
    assert np.allclose(np.cos(yaw[states.id == 0]), -1.0, atol=0.01)  # the detector says 0, the motion pi
    assert np.allclose(yaw[states.id == 1], 0.0, atol=1e-6)
    assert (variance > 0).all()


def test_who_stands_in_a_row_faces_as_the_others_there_do():
    place = np.array([[0.0, 0.0], [6.0, 0.5], [12.0, -0.5], [6.0, 8.0], [18.0, 0.0], [24.0, 0.0]])
    axis, path = np.array([0.1, 0.0, np.pi, 0.0, np.pi / 2, 0.0]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 50.0])
    votes, rows = np.array([-0.2, 8.0, -2.0, -9.0, -9.0, -9.0]), np.arange(6)
    found = row_votes(place, axis, path, votes, rows, np.ones(6, dtype=bool))
    assert (
        found[0] > 0.9
    )  # two of the others face along its axis; the next row, who stands across and who moves do not tell
    assert found[2] < -0.6
    assert (found[3:] == 0).all()
    assert (np.abs(found) <= 1).all()
    alone = row_votes(place, axis, path, votes, rows, rows == 0)
    assert (alone == 0).all()


def test_edges_follow_from_smoothed_states_and_strangers_move_on_their_own():
    lifespans = Lifespans(
        np.array([1, 2, 5]), np.array(["car"] * 3), np.zeros(3, dtype=np.int64), np.ones(3, dtype=np.int64)
    )
    mean = np.array([[0.0, 0.0, 10.0, 0.0], [20.0, 0.0, 10.0, 0.0]])
    states = StateTable.of_moments([(0, np.array([1, 2]), mean, np.tile(0.01 * np.eye(4), (2, 1, 1)))])
    rules = (Following(interaction=SharedVelocity()),)
    edges = SmoothedEdges(rules, 0.0, lifespans, states, np.zeros(3), np.full(3, 4.5))
    graph = edges(0, np.array([5, 2, 1]), (NodeType("object", CLASSES["default"].motion),) * 3)
    assert sorted(graph.nodes.tolist()) == [1, 2, 5]
    (group,) = graph.edges
    assert (graph.nodes[group.target].tolist(), graph.nodes[group.source].tolist()) == ([1], [2])


def test_many_tracklets_are_stitched_without_an_array_of_all_pairs():
    count, rng = 1500, np.random.default_rng(0)
    seen = Lifespans(np.arange(count), np.full(count, "car"), *(np.sort(rng.integers(20, size=(2, count)), axis=0)))
    longer = seen.reaching(TIMES, 1.0, 3.0)
    moment, row = np.nonzero(
        (longer.first <= np.arange(20)[:, None]) & (np.arange(20)[:, None] <= longer.last)  # all moments of each
    )
    place = np.stack([row * 20.0, np.zeros(len(row))], axis=-1)
    place[row % 3 == 1] -= [20.0, 0.0]  # every second of three continues the first
    states = StateTable(
        moment, row, np.concatenate([place, np.zeros_like(place)], axis=1), np.tile(0.1 * np.eye(4), (len(row), 1, 1))
    )
    evidence, _ = gathered({0: line(0, 19, (0, 0), (0, 0))})
    prior = np.tile(25.0 * np.eye(2), (count, 1, 1))
    stitch_tracklets(seen, states, prior, evidence, 3.0)
    tracemalloc.start()
    found = stitch_tracklets(seen, states, prior, evidence, 3.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    begin, end = TIMES[seen.first], TIMES[seen.last]
    gap = np.maximum(begin[1::3] - end[::3], begin[::3] - end[1::3])
    joined = found[1::3] == found[::3]
    assert joined.sum() > 50
    assert (joined <= (gap > 0) & (gap <= 3.0)).all()
    assert (found[2::3] == np.arange(count)[2::3]).all()
    assert peak < count**2


# Factors of users' own in offline smoothing: they act, are named when they fail, and without any nothing changes

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
    evidence = gather_evidence(frames, np.array([1.7e9 + 7.25]), PROVIDERS_SENSORS, near)
    object_of = np.array(owner)
    lifespans = lifespans_of(object_of, evidence.boxes.label, evidence.moment)
    V, n = np.tile(25 * np.eye(2), (4, 1, 1)), len(lifespans)
    alone = smooth_states(evidence, object_of, lifespans, ObjectMotion(V, PROVIDERS_CLASSES))
    rules = (Neighbours(min_speed=0.2, classes=("pedestrian",)),)
    edges = SmoothedEdges(rules, 0.0, lifespans, alone, np.full(n, np.nan), np.full(n, 0.5))
    moments = np.arange(len(evidence.times))
    stands = StationaryStates(0.03, moments, np.full(len(moments), 2))
    weight = np.where(object_of == 1, 0.5, 1.0)
    return smooth_states(
        evidence, object_of, lifespans, ObjectMotion(V, PROVIDERS_CLASSES, edges, stands), weight, providers
    )


def test_the_graph_is_the_problem_that_is_solved_without_providers():
    plain, quiet = states(), Quiet()
    asked = states([quiet])
    assert asked.id.tolist() == plain.id.tolist()
    sigma = np.sqrt(np.diagonal(plain.covariance, axis1=1, axis2=2))
    assert np.abs((asked.mean - plain.mean) / sigma).max() < 1e-7
    np.testing.assert_allclose(asked.covariance, plain.covariance, rtol=1e-7, atol=1e-10)
    assert len(quiet.asked) == 17
    assert quiet.asked[0] == (1.7e9, {("pedestrian", 0), ("pedestrian", 1), ("car", 2)})
    assert quiet.asked[5][1] == {("pedestrian", 0), ("pedestrian", 1), ("car", 2), ("pedestrian", 3)}


def test_a_wall_keeps_pedestrians_away():
    plain, walled = states(), states([Wall()])
    near = (plain.id == 0) & (plain.moment > 12)
    assert (walled.mean[near, 1] < plain.mean[near, 1] - 0.02).all()
    assert (walled.covariance[near, 1, 1] < plain.covariance[near, 1, 1]).all()
    np.testing.assert_allclose(walled.mean[plain.id == 2], plain.mean[plain.id == 2], atol=1e-6)


def test_a_provider_may_bring_variables_of_its_own():
    assert np.abs(states([Post()]).mean - states().mean).max() > 0.01


class Wrong:
    name = "wrong"

    def factors(self, view: GraphView) -> Additions:
        rows = [[one.key] for one in view.now(OBJECT).values()]
        return Additions(factors=[ResidualFactors(rows, (6,), lambda x: x[:, :1], np.eye(1), name="too wide")])


def test_what_does_not_fit_is_named():
    with pytest.raises(GraphError, match=r"provider wrong: too wide on pedestrian 0 at .* s: expected variables"):
        states([Wrong()])
