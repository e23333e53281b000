"""Smoothed states, boxes, and the memory that they take. Lifespans, state tables and the batch over a recording."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import Robust
from saga_fg.estimators import Gaussian, RecordingSmoother, kalman_predict, kalman_update, rts_smooth, smoother
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.motion import NodeType
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.numerics.arrays import IntArray
from saga_fg.smoothing import (
    Evidence,
    Lifespans,
    OfflineClass,
    SmoothedEdges,
    StateTable,
    StationaryStates,
    batch_states,
    constant_sizes,
    gather_evidence,
    lifespans_of,
    quality_of,
    robust_weights,
    scalar_readings,
    smooth_states,
    smooth_walks,
)
from saga_fg.smoothing.batch_states import UNKNOWN_POSITION, ObjectMotion
from saga_fg.smoothing.boxes import weighted_medians
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

SIGMA = 0.5
SENSORS = {"default": Sensor({"default": NoiseModel(position=SIGMA)})}
CLASSES = {"default": OfflineClass(acceleration_noise=0.4)}


def evidence_of(times: list[float], positions: list[list[list[float]]]) -> Evidence:
    """Cars measured at `times` at `positions` (T, m, 2)."""
    frames = [
        Frame(t, "lidar", Detections(Boxes.of(["car"] * len(p), [[*xy, 0.0] for xy in p]), np.full(len(p), 0.999)))
        for t, p in zip(times, positions, strict=True)
    ]
    near = {"default": ClassSettings(nms_distance=0.0)}
    return gather_evidence(frames, np.array(times), SENSORS, near)


def test_an_object_alone_is_smoothed_as_by_the_textbook():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.1, 0.9, 12))
    path = np.stack([3.0 * times, np.sin(times)], axis=-1) + rng.normal(0, SIGMA, (12, 2))
    evidence = evidence_of(times.tolist(), path[:, None].tolist())
    lifespans = lifespans_of(np.zeros(12, dtype=np.int64), evidence.boxes.label, evidence.moment)
    V = 25 * np.eye(2)
    states = smooth_states(evidence, np.zeros(12, dtype=np.int64), lifespans, ObjectMotion(V[None], CLASSES))

    prior = Gaussian(
        np.concatenate([evidence.boxes.position[0, :2], [0, 0]]), np.diag([UNKNOWN_POSITION**2] * 2 + [25.0] * 2)
    )
    H, node_type = np.eye(4)[:2], NodeType("object", CLASSES["default"].motion)
    x, filtered, predicted, F = prior, [], [], []
    for k in range(12):
        if k:
            move = discretise(SceneGraph.of([0], node_type), float(times[k] - times[k - 1]))
            F.append(move.F_matrix.toarray())
            x = kalman_predict(x, F[-1], move.b, move.Q_matrix.toarray())
            predicted.append(x)
        x, _ = kalman_update(x, path[k] - evidence.origin, H, evidence.R[k, :2, :2])
        filtered.append(x)
    expected = rts_smooth(filtered, predicted, F)
    assert np.allclose(states.mean, [g.mean for g in expected], atol=1e-6)
    assert np.allclose(states.covariance, [g.covariance for g in expected], rtol=1e-5, atol=1e-9)


def test_a_long_recording_is_smoothed_in_windows_and_comes_to_the_same(monkeypatch):
    rng = np.random.default_rng(1)
    times = 0.5 * np.arange(260)
    path = np.stack([3.0 * times, 10 * np.sin(times / 9)], axis=-1) + rng.normal(0, SIGMA, (260, 2))
    evidence = evidence_of(times.tolist(), np.stack([path, path + 5], axis=1).tolist())
    owner = np.tile([0, 1], 260)
    owner[100:110] = -1  # both are hidden for a while
    lifespans = lifespans_of(owner, evidence.boxes.label, evidence.moment)
    V = np.tile(25 * np.eye(2), (2, 1, 1))
    windows = []
    final = RecordingSmoother.final
    monkeypatch.setattr(RecordingSmoother, "final", lambda self: windows.append(out := final(self)) or out)
    in_windows = smooth_states(evidence, owner, lifespans, ObjectMotion(V, CLASSES))
    assert sum(map(len, windows)) > 200
    monkeypatch.setattr(batch_states, "LONG_RECORDING", 1000.0)
    at_once = smooth_states(evidence, owner, lifespans, ObjectMotion(V, CLASSES))
    assert (in_windows.id == at_once.id).all()
    assert np.allclose(in_windows.mean, at_once.mean, rtol=0, atol=1e-3)
    assert np.allclose(in_windows.covariance, at_once.covariance, rtol=0, atol=1e-6)


def test_lifespans_reach_from_first_to_last_detection_and_further_where_wanted():
    lifespans = lifespans_of(np.array([4, -1, 2, 4]), np.array(["car", "bus", "bus", "car"]), np.array([1, 1, 2, 3]))
    assert lifespans.id.tolist() == [2, 4]
    assert lifespans.label.tolist() == ["bus", "car"]
    assert (lifespans.first.tolist(), lifespans.last.tolist()) == ([2, 1], [2, 3])
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    longer = lifespans.reaching(times, back=0.5, ahead=10.0)
    assert (longer.first.tolist(), longer.last.tolist()) == ([1, 0], [4, 4])


def test_states_are_found_by_object_and_moment():
    ids = [np.array([3, 1]), np.array([3])]
    table = StateTable.of_moments(
        [(k + 2, i, np.ones((len(i), 4)) * i[:, None], np.ones((len(i), 4, 4))) for k, i in enumerate(ids)]
    )
    assert table.id.tolist() == [1, 3, 3]
    assert table.rows_of(np.array([2, 3, 3, 2]), np.array([3, 3, 1, -1])).tolist() == [1, 2, -1, -1]
    assert [table.at(k) for k in (2, 3, 9)] == [slice(0, 2), slice(2, 3), slice(3, 3)]
    lifespans = Lifespans(np.array([3]), np.array(["car"]), np.array([3]), np.array([5]))
    assert table.within(lifespans).moment.tolist() == [3]


def test_a_pinned_object_stays_where_it_is():
    rng = np.random.default_rng(1)
    times = np.arange(20) * 0.5
    path = np.array([10.0, 5.0]) + rng.normal(0, SIGMA, (20, 2))
    evidence = evidence_of(times.tolist(), path[:, None].tolist())
    mine = np.zeros(20, dtype=np.int64)
    lifespans = lifespans_of(mine, evidence.boxes.label, evidence.moment)
    stands = StationaryStates(0.01, np.arange(20), mine)
    states = smooth_states(evidence, mine, lifespans, ObjectMotion(25 * np.eye(2)[None], CLASSES, stationary=stands))
    assert np.ptp(states.mean[:, :2], axis=0).max() < 0.1 * SIGMA
    assert np.allclose(states.mean[:, :2] + evidence.origin, path.mean(axis=0), atol=0.1 * SIGMA)


def test_a_pinned_object_wanders_by_the_drift_of_the_poses_whatever_the_rate():
    deviations = []
    for rate in (2, 20):
        times = np.arange(20 * rate + 1) / rate
        places: list[list[list[float]]] = [[] for _ in times]
        places[0] = [[10.0, 5.0]]
        evidence = evidence_of(times.tolist(), places)
        lifespans = Lifespans(np.array([0]), np.array(["car"]), np.array([0]), np.array([len(times) - 1]))
        stands = StationaryStates(0.2, np.arange(len(times)), np.zeros(len(times), dtype=np.int64))
        first = np.zeros(1, dtype=np.int64)
        motion = ObjectMotion(25 * np.eye(2)[None], CLASSES, stationary=stands)
        states = smooth_states(evidence, first, lifespans, motion)
        deviations.append(np.sqrt(states.covariance[-1, 0, 0] - states.covariance[0, 0, 0]))
    assert deviations == pytest.approx([0.2 * np.sqrt(20)] * 2, rel=0.3)


def test_an_outlier_counts_little_after_reweighting():
    times = np.arange(11) * 0.5
    path = np.zeros((11, 2))
    path[5] = [4.0, 0.0]
    evidence = evidence_of(times.tolist(), path[:, None].tolist())
    mine = np.zeros(11, dtype=np.int64)
    lifespans = lifespans_of(mine, evidence.boxes.label, evidence.moment)
    plain = smooth_states(evidence, mine, lifespans, ObjectMotion(25 * np.eye(2)[None], CLASSES))
    weight = robust_weights(evidence, mine, plain, Robust("cauchy", 2.0))
    robust = smooth_states(evidence, mine, lifespans, ObjectMotion(25 * np.eye(2)[None], CLASSES), weight)
    middle = [abs(s.mean[5, 0] + evidence.origin[0]) for s in (plain, robust)]
    assert weight.argmin() == 5
    assert middle[1] < 0.5 * middle[0]


def test_a_stationary_object_of_a_recording_of_one_moment():
    evidence, mine = evidence_of([0.0], [[[3.0, 4.0]]]), np.zeros(1, dtype=np.int64)
    stands = StationaryStates(0.03, mine, mine)
    lifespans = lifespans_of(mine, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, mine, lifespans, ObjectMotion(25 * np.eye(2)[None], CLASSES, stationary=stands))
    assert np.allclose(states.mean[0, :2] + evidence.origin, [3.0, 4.0])
    assert np.allclose(states.mean[0, 2:], 0.0)
    assert (np.sqrt(np.diag(states.covariance[0])[2:]) <= stands.position_drift).all()


# Sizes, headings, heights and scores of smoothed objects


def chain(moments: int, objects: int = 1) -> StateTable:
    """States of objects that live at all moments."""
    ids = np.arange(objects)
    return StateTable.of_moments(
        [(k, ids, np.zeros((objects, 4)), np.tile(np.eye(4), (objects, 1, 1))) for k in range(moments)]
    )


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=9))
def test_with_equal_weights_the_weighted_median_is_the_median(values):
    array = np.array(values)
    median = weighted_medians(np.zeros(len(array), dtype=np.int64), 1, array, np.ones(len(array)))
    assert median[0] == pytest.approx(np.median(array))


def test_sizes_follow_the_weight_and_objects_do_not_mix():
    size = np.array([[4.0, 2.0, 1.5], [4.2, 2.0, 1.5], [9.0, 3.0, 2.0], [np.nan] * 3])
    owner, probability = np.array([0, 0, 0, 2]), np.array([0.9, 0.9, 0.1, 0.9])
    found = constant_sizes(owner, 3, size, probability)
    assert 4.0 <= found[0, 0] <= 4.2
    assert np.isnan(found[1:]).all()
    seen_from_above = constant_sizes(owner, 3, size * [1.0, 1.0, np.nan], probability)
    assert np.array_equal(seen_from_above[:, :2], found[:, :2], equal_nan=True)
    assert np.isnan(seen_from_above[:, 2]).all()
    states = chain(2, objects=2)
    assert states.previous.tolist() == [-1, -1, 0, 1]
    readings = scalar_readings(np.array([0, 0, 3]), np.array([1.0, 3.0, 9.0]), np.ones(3))
    mean, _ = smooth_walks(states, np.zeros(4), readings)
    assert mean.tolist() == [2.0, 9.0, 2.0, 9.0]
    P = np.array([0.01, 0.01, 0.25, 4.0])[:, None, None] * np.eye(2)
    assert quality_of(np.array([0.9, 0.3, 0.9, 0.9]), P).tolist() == ["high", "medium", "medium", "low"]


def test_walks_are_smoothed_as_by_the_textbook_from_the_first_reading_on():
    states = chain(5)
    rows, value, variance = np.arange(5), np.array([1.0, 2.0, 0.0, 4.0, 1.5]), np.array([1.0, 2.0, 0.5, 1.0, 4.0])
    mean, var = smooth_walks(states, np.zeros(5), scalar_readings(rows, value, variance))
    assert np.allclose(mean, np.average(value, weights=1 / variance))
    assert np.allclose(var, 1 / np.sum(1 / variance))
    rng = np.random.default_rng(3)
    n, growth = 7, 0.3
    value, variance = rng.normal(0, 1, n), rng.uniform(0.5, 2, n)
    states = chain(n)
    mean, var = smooth_walks(states, np.full(n, growth), scalar_readings(np.arange(n), value, variance))
    D = np.diff(np.eye(n), axis=0)
    information = np.diag(1 / variance) + D.T @ D / growth
    assert np.allclose(mean, np.linalg.solve(information, value / variance))
    assert np.allclose(var, np.diag(np.linalg.inv(information)))
    mean, var = smooth_walks(
        chain(4), np.full(4, 0.5), scalar_readings(np.array([2]), np.array([7.0]), np.array([1.0]))
    )
    assert mean.tolist() == [7.0] * 4
    assert var.tolist() == [2.0, 1.5, 1.0, 1.5]


def test_readings_modulo_half_a_turn_ignore_flips():
    truth = np.linspace(3.0, 3.4, 9)
    flipped = truth + np.pi * np.array([0, 1, 0, 0, -1, 1, 0, 1, 0])
    mean, _ = smooth_walks(chain(9), np.full(9, 0.05), scalar_readings(np.arange(9), flipped, np.full(9, 0.01)), np.pi)
    assert np.allclose(mean, truth, atol=0.05)


# Memory of smoothing grows with what is there at a time, not with the number of all tracks ever

MOMENTS, CARS = 60, 20  # a queue of cars, 10 m apart
MEMORY_CLASSES = {"default": OfflineClass(acceleration_noise=0.5)}
FEW, MANY = MOMENTS, 3  # moments that a track lasts: 20 tracks ever, or 400


def queue(moments: int) -> Evidence:
    """All cars, seen at every moment."""
    times = 0.5 * np.arange(moments)
    place = np.column_stack([10.0 * np.arange(CARS), np.zeros((CARS, 2))])
    frames = [
        Frame(
            time,
            "lidar",
            Detections(Boxes.of(["car"] * CARS, place + np.array([5.0 * time, 0, 0])), np.full(CARS, 0.9)),
        )
        for time in times.tolist()
    ]
    sensors = {"default": Sensor({"default": NoiseModel(position=0.1)})}
    return gather_evidence(frames, times, sensors, {"default": ClassSettings(nms_distance=0.0)})


def tracks(evidence: Evidence, length: int) -> tuple[IntArray, Lifespans]:
    """The track of each detection, where a car gets another one every `length` moments."""
    moments = len(evidence.times)
    object_of = np.tile(np.arange(CARS), moments) * moments + evidence.moment // length
    return object_of, lifespans_of(object_of, evidence.boxes.label, evidence.moment)


def states(evidence: Evidence, length: int, tied: bool = False) -> StateTable:
    object_of, lifespans = tracks(evidence, length)
    V = np.tile(25.0 * np.eye(2), (len(lifespans), 1, 1))
    alone = smooth_states(evidence, object_of, lifespans, ObjectMotion(V, MEMORY_CLASSES))
    if not tied:
        return alone
    rules = (Following(interaction=SharedVelocity()),)
    size = np.zeros(len(lifespans)), np.full(len(lifespans), 4.5)
    edges = SmoothedEdges(rules, float(evidence.times[0]), lifespans, alone, *size)
    return smooth_states(evidence, object_of, lifespans, ObjectMotion(V, MEMORY_CLASSES, edges))


def peak(run: Callable[[], object]) -> int:
    """Largest number of bytes allocated at once."""
    run()  # what is loaded, and kept, once
    tracemalloc.start()
    run()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


@pytest.mark.parametrize(("kept", "tied"), [("all", False), ("in stretches", True), ("in windows", True)])
def test_states_take_no_more_memory_for_twenty_times_as_many_tracks(tied, kept, monkeypatch):
    if kept == "in stretches":
        monkeypatch.setattr(smoother, "MOST_KEPT", 300_000)
    if kept == "in windows":
        monkeypatch.setattr(batch_states, "LONG_RECORDING", 5.0)
    evidence = queue(MOMENTS)
    few, many = (peak(lambda length=length: states(evidence, length, tied)) for length in (FEW, MANY))
    assert many < 1.6 * few


def test_in_windows_a_longer_recording_adds_its_rows_alone(monkeypatch):
    monkeypatch.setattr(batch_states, "LONG_RECORDING", 5.0)
    short, long = queue(MOMENTS), queue(3 * MOMENTS)
    more = peak(lambda: states(long, MANY, tied=True)) - peak(lambda: states(short, MANY, tied=True))
    assert more < 1000 * 2 * MOMENTS * CARS  # bytes for each state: its mean, its covariance, and copies of these
