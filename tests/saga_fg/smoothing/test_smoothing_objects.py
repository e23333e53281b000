"""Tracklets joined, detections claimed, stands recognised, scores from all evidence."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from saga_fg.model.edge_rules import Following
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
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

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


def test_tracklets_of_one_motion_are_one_object_over_several_gaps() -> None:
    paths = {4: line(0, 5, (0, 0), (5, 0)), 7: line(9, 12, (0, 0), (5, 0)), 2: line(15, 19, (0, 0), (5, 0))}
    assert joined(paths) == {4: 4, 7: 4, 2: 4}


def test_crossing_objects_keep_to_their_own_motion() -> None:
    paths = {
        0: line(0, 6, (0, 0), (5, 0)), 1: line(0, 6, (23, -23), (0, 5)),
        2: line(11, 19, (0, 0), (5, 0)), 3: line(11, 19, (23, -23), (0, 5)),
    }  # fmt: skip
    assert joined(paths) == {0: 0, 1: 1, 2: 0, 3: 1}


def test_what_moves_otherwise_or_comes_too_late_is_new() -> None:
    paths = {0: line(0, 6, (0, 0), (5, 0)), 1: line(9, 19, (0, 30), (5, 0))}
    assert joined(paths) == {0: 0, 1: 1}
    paths = {0: line(0, 6, (0, 0), (5, 0)), 1: line(12, 19, (0, 0), (5, 0))}
    assert joined(paths, max_gap=1.0) == {0: 0, 1: 1}


def test_an_object_claims_detections_before_its_initiation_but_not_those_of_others() -> None:
    evidence, numbers = gathered({0: line(0, 19, (0, 0), (5, 0)), 1: line(0, 19, (0, 20), (5, 0))})
    tracked = np.where(evidence.moment < 2, -1, numbers)
    lifespans = lifespans_of(tracked, evidence.boxes.label, evidence.moment)
    prior = np.tile(25.0 * np.eye(2), (2, 1, 1))
    longer = lifespans.reaching(evidence.times, 1.5, 0.0)
    states = smooth_states(evidence, tracked, longer, ObjectMotion(prior, CLASSES))
    assert assign_free_detections(evidence, tracked, lifespans, states, 0.99, 3.0).tolist() == numbers.tolist()
    assert assign_free_detections(evidence, tracked, lifespans, states, 0.0, 3.0).tolist() == tracked.tolist()


def test_parked_and_waiting_cars_stand_and_creeping_ones_do_not() -> None:
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


def test_a_score_is_the_mean_over_all_opportunities_and_those_of_the_prior() -> None:
    evidence, numbers = gathered({0: line(0, 9, (0, 0), (1, 0)), 1: line(5, 5, (0, 9), (0, 0))}, score=0.8)
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, numbers, lifespans, ObjectMotion(np.tile(25.0 * np.eye(2), (2, 1, 1)), CLASSES))
    assert frame_rate(evidence) == pytest.approx(2.0)
    score = evidence_scores(evidence, numbers, lifespans, states, prior_opportunity_time=1.0)
    assert score.tolist() == pytest.approx([8.0 / 12.0, 0.8 / 3.0])


def test_the_front_is_where_an_object_drives_else_what_most_detections_say() -> None:
    evidence, numbers = gathered({0: line(0, 19, (0, 0), (-5, 0)), 1: line(0, 19, (0, 20), (0, 0))})
    lifespans = lifespans_of(numbers, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, numbers, lifespans, ObjectMotion(np.tile(25.0 * np.eye(2), (2, 1, 1)), CLASSES))
    rows = np.arange(len(evidence))
    at = states.rows_of(evidence.moment, numbers)
    found = smooth_headings(states, lifespans, evidence, rows, at, np.full(len(states), 0.01), np.full(2, 2.0))
    yaw, variance = found.yaw, found.variance
    assert np.allclose(np.cos(yaw[states.id == 0]), -1.0, atol=0.01)  # the detector says 0, the motion pi
    assert np.allclose(yaw[states.id == 1], 0.0, atol=1e-6)
    assert (variance > 0).all()


def test_edges_follow_from_smoothed_states_and_strangers_move_on_their_own() -> None:
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


def test_many_tracklets_are_stitched_without_an_array_of_all_pairs() -> None:
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
