"""Probabilities of associations against all joint events, and pairs of tracks that exchange their objects."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from saga_fg import ConstantAcceleration, ConstantVelocity, RandomWalk, Tracker, TrackerSettings
from saga_fg.kernels.tracks import association_marginals
from saga_fg.model.edge_rules import Neighbours
from saga_fg.model.manoeuvres import Mixture
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.numerics.assignment import Matching
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.providers import Odometry, StartSettings
from saga_fg.tracking import ClassSettings, EgoNodeSettings
from saga_fg.tracking.association import LARGEST_EXACT, SWEEPS
from saga_fg.tracking.edge_record import EdgeRecord, Trials
from saga_fg.tracking.identities import Encounters
from saga_fg.tracking.map_nodes import FirstVehicles
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.tracking.track_filters import Kinematics
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.tracking.update import doubted, follow_encounters, update_range_rates, update_tracks
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, EgoMeasurements, Frame, OdometryIncrement


def enumerated(track, detection, log_weight):
    """Marginals (K,) by the sum over every joint event."""
    totals, weight = np.zeros(len(track)), np.exp(log_weight)

    def events(k, chosen, product):
        if k == len(track):
            totals[chosen] += product
            return product
        rest = events(k + 1, chosen, product)
        if not any(track[k] == track[j] or detection[k] == detection[j] for j in chosen):
            rest += events(k + 1, [*chosen, k], product * weight[k])
        return rest

    return totals / events(0, [], 1.0) if len(track) else totals


def random_problem(rng, least, most, density):
    """Candidates of tracks along a line, each with the detections near it."""
    n, m = rng.integers(least, most + 1, 2)
    there = rng.random((n, m)) < density
    i, j = there.nonzero()
    x, z = rng.uniform(0, 4, n), rng.uniform(0, 4, m)
    return i, j, 3.0 - 2 * (x[i] - z[j]) ** 2 + rng.normal(size=len(i))


def test_marginals_of_500_random_problems_against_all_joint_events():
    rng, apart = np.random.default_rng(0), []
    for _ in range(500):
        i, j, w = random_problem(rng, 1, 5, 0.55)
        expected = enumerated(i, j, w)
        np.testing.assert_allclose(association_marginals(i, j, w, LARGEST_EXACT, SWEEPS), expected, atol=1e-6)
        apart.append(np.abs(association_marginals(i, j, w, 0, SWEEPS) - expected).max(initial=0.0))
    print("loopy, up to 5 x 5, largest difference, median and 95 %:", *np.quantile(apart, [0.5, 0.95]))
    assert np.median(apart) <= 0.03


def test_marginals_of_large_clusters_by_belief_propagation():
    rng, apart = np.random.default_rng(1), []
    for _ in range(60):
        i, j, w = random_problem(rng, 9, 11, 0.4)
        exact, loopy = (association_marginals(i, j, w, largest, SWEEPS) for largest in (11, LARGEST_EXACT))
        apart.append(np.abs(exact - loopy).max())
        assert (np.bincount(i, loopy) <= 1 + 1e-9).all()
    print("loopy, 9 x 9 to 11 x 11, largest difference, median and 95 %:", *np.quantile(apart, [0.5, 0.95]))
    assert 0 < np.median(apart) <= 0.03


@pytest.mark.parametrize("largest", [0, LARGEST_EXACT])
def test_marginals_where_weights_are_beyond_what_an_exponential_holds(largest):
    i, j = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    p = association_marginals(i, j, np.array([900.0, 0.0, 0.0, -900.0]), largest, SWEEPS)
    np.testing.assert_allclose(p, [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(association_marginals(i[:0], j[:0], np.empty(0), largest, SWEEPS), [])


def test_a_doubted_measurement_moves_its_track_by_its_share():
    rng, w = np.random.default_rng(2), np.array([0.3])
    A, B = rng.normal(size=(2, 4, 4))
    R, P = (A @ A.T)[None], np.zeros((1, 4, 4))
    P[0, :2, :2], P[0, 2:, 2:] = (B @ B.T)[:2, :2], (B @ B.T)[2:, 2:]
    now = Kinematics(np.zeros((1, 2)), np.zeros((1, 2)), P[:, :2, :2], P[:, 2:, 2:])
    gain, usual = P @ np.linalg.inv(P + doubted(R, w, now)), P @ np.linalg.inv(P + R)
    np.testing.assert_allclose(gain, w * usual, atol=1e-12)


def log_likelihood(x, P, detections, noise, dt):
    """Of detections of one object, by a textbook filter."""
    F, G = np.eye(4) + dt * np.eye(4, k=2), np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    total = 0.0
    for k, (z, R) in enumerate(detections):
        if k:
            x, P = F @ x, F @ P @ F.T + noise * G
        S = P[:2, :2] + R
        K = P[:, :2] @ np.linalg.inv(S)
        total += multivariate_normal(x[:2], S).logpdf(z)
        x, P = x + K @ (z - x[:2]), P - K @ P[:2]
    return total


@pytest.mark.parametrize("swapped", [False, True])
def test_what_follows_tells_whether_two_tracks_exchanged_their_objects(swapped):
    rng, noise, dt, R = np.random.default_rng(3), 0.3, 0.4, 0.01 * np.eye(2)
    A, B = np.array([0.0, 0.1, 1.3, 0.2]), np.array([0.1, -0.1, -1.3, 0.1])
    P = np.diag([0.02, 0.02, 0.2, 0.2])
    found = [[x[:2] + k * dt * x[2:] + 0.1 * rng.normal(size=2) for x in (A, B)] for k in range(5)]
    given = [pair[::-1] for pair in found] if swapped else found
    known = Encounters.empty().begun(np.array([[4, 7]]), np.array([[A, B]]), np.array([[P, P]]), 0.0)
    seen, both = np.ones((1, 2), dtype=bool), np.tile(R, (1, 2, 1, 1))
    for k, pair in enumerate(given):
        known = known.followed(np.array([noise]), np.array([dt if k else 0.0]), np.array([pair]), both, seen)
    a, b = ([(pair[i], R) for pair in given] for i in range(2))
    kept, exchanged = (
        log_likelihood(A, P, one, noise, dt) + log_likelihood(B, P, other, noise, dt) for one, other in ((a, b), (b, a))
    )
    np.testing.assert_allclose(known.log_odds, exchanged - kept, rtol=1e-9)
    assert known.exchanges(np.array([4, 7])) == ([(4, 7, 0.0)] if swapped else [])
    assert known.exchanges(np.array([4])) == []
    assert [len(known.live(np.array(ids), 1.9)) for ids in ([4, 7], [4, 8])] == [swapped, 0]
    assert len(known.live(np.array([4, 7]), 2.1)) == len(known.without(2, 4)) == 0


def met(motion, observer=None, edges=(), estimator="kalman"):
    """A tracker of a car and a pedestrian that have passed each other, and the frame that comes next."""
    classes = {"car": ClassSettings(motion=motion), "pedestrian": ClassSettings(), "cone": ClassSettings(RandomWalk())}
    settings = TrackerSettings(estimator=estimator, classes=classes, edges=edges, traffic=TrafficSettings(memory=60.0))
    tracker = Tracker(settings, observer=observer)
    frames = []
    for k in range(7):
        place = np.array([(k + 0.1 * k**2, 0.04 * k**2, 0.9), (-k, 5.0, 0.9)])
        boxes = Boxes.of(
            ["car", "pedestrian"], place, np.array([(4.5, 1.9, 1.5), (0.6, 0.6, 1.7)]), np.array([0.2, 3.1])
        )
        frames.append(Frame(0.4 * k, "lidar", Detections(boxes, np.array([0.99, 0.9]))))
    for frame in frames[:-1]:
        tracker.step(frame)
    return tracker, frames[-1]


def all_known(state):
    """Of each track, by id: mean, covariance and modes, the row of the table without the id."""
    known = {}
    for row, track in enumerate(state.table.id.tolist()):
        of = np.array([track])
        tables = [t.select(t.ids == track) for t in state.joint._modes.values()]
        modes = [column for t in tables for column in (t.weight, t.mean, t.P, t.shift, t.spread)]
        table = replace(state.table.select(np.array([row])), id=of[:0])
        parts = (table, table.box, table.stationarity, table.turn, table.sensors)
        columns = [c for part in parts for c in vars(part).values() if isinstance(c, np.ndarray)]
        known[track] = [state.joint.estimator.mean(of), state.joint.estimator.covariance(of), *modes, *columns]
    return known


@pytest.mark.parametrize(
    ("motion", "estimator"),
    [(ConstantVelocity(), "kalman"), (ConstantAcceleration(), "isam2"), (Mixture(), "fixed-lag")],
)
def test_tracks_that_exchange_have_all_of_each_other_but_the_id(motion, estimator):
    tracker, frame = met(motion, estimator=estimator)
    state, (a, b) = tracker._state, tracker._state.table.id.tolist()
    before = all_known(state)
    if not isinstance(motion, ConstantVelocity):
        assert np.abs(before[a][0][0, 4:]).max() > 0.01  # more than position and velocity
    assert list(state.exchange(a, b, -np.inf)) == [1, 0]
    after = all_known(state)
    for one, other in ((a, b), (b, a)):
        assert len(after[one]) == len(before[other])
        for now, then in zip(after[one], before[other], strict=True):
            if now.dtype.kind in "fi":
                np.testing.assert_allclose(now, then, atol=1e-9)
            else:
                np.testing.assert_array_equal(now, then)
    assert tracker.assignment.id.tolist() == [b, a]
    assert (tracker.step(frame).id == [a, b]).all()
    assert (tracker.assignment.id.tolist(), tracker.assignment.detection.tolist()) == ([a, b], [1, 0])


def test_trails_stay_with_objects_and_what_edges_learn_of_the_tracks_begins_anew():
    tracker, frame = met(ConstantVelocity(), edges=(Neighbours(),))
    state, (a, b) = tracker._state, tracker._state.table.id.tolist()
    sums = {(0, 1, a, 9): (1.0, 2.0), (0, 1, 8, 9): (1.0, 2.0), (0, 0, a, b, -1): (1.0, 2.0), (0, 1): (1.0, 2.0)}
    pairs = ((0, 1, 8, a), (0, 1, 8, 9), (0, 0, a, b))
    u, variance = np.zeros((3, 2)), np.arange(3.0)
    trials = Trials(pairs, ((0, 0, 1, 1, -1),) * 3, np.array([8, 8, a]), u, variance, u, variance)
    state.edge_record = EdgeRecord(sums, 2.0, {a: np.zeros(2), 8: np.zeros(2)}, (trials,))
    stands = {a: 1.0, 8: 1.0}
    state.halting = replace(state.halting, since=stands, halted=frozenset({(a, 0), (8, 0)}))
    none = np.zeros((2, 4))
    state.map_nodes.drivers = FirstVehicles(
        np.array([b, 8]), np.array([-1, -1]), none[:, 0], none[:, 0], none[:, :2], none[:, 0], none, none[:, 0], none
    )
    state.exchange(a, b, 1.0)
    left, latest = state.traffic.left, state.traffic.latest
    for of in (left, latest):
        assert ((of.position[:, 1] > 3) == (of.id == np.where(of.time < 1.0, b, a))).all()
    assert left.time.min() < 1.0 < left.time.max()
    assert list(state.edge_record.sums) == [(0, 1, 8, 9), (0, 0, a, b, -1), (0, 1)]
    (kept,) = state.edge_record.trials
    assert (kept.pair, kept.target.tolist(), kept.rate.tolist()) == (((0, 1, 8, 9),), [8], [1.0])
    assert (list(state.edge_record.places), state.map_nodes.drivers.id.tolist()) == ([8], [8])
    assert (dict(state.halting.since), set(state.halting.halted)) == ({8: 1.0}, {(8, 0)})
    assert len(state.traffic.marked) == 0
    tracker.step(frame)
    assert tracker._state.traffic.marked.id.tolist() == [a, b]


def likely(state, log_odds=9.0):
    """An encounter of the two tracks."""
    x, P = state.joint.estimator.planar_marginals(state.table.id, state.joint.places(state.table.label))
    known = Encounters.empty().begun(state.table.id[None], x[None], P[None], state.time)
    return replace(known, log_odds=np.array([log_odds]))


def test_after_an_exchange_observers_see_which_track_has_which_detection():
    seen = {}

    class Watching:
        def after(self, stage, view):
            now = view()
            if now.matching is not None:
                seen[stage] = dict(zip(now.matching.detection.tolist(), now.table.id[now.matching.track], strict=True))

    tracker, frame = met(ConstantVelocity(), Watching())
    a, b = tracker._state.table.id.tolist()
    tracker._state.encounters = likely(tracker._state, 1e3)
    tracker.step(frame)
    assert seen["update"] == {0: a, 1: b}
    assert seen["delete"] == seen["report"] == {0: b, 1: a}
    assert len(tracker._state.encounters) == 0


def test_an_encounter_ends_where_a_track_has_no_velocity_any_longer():
    tracker, _ = met(ConstantVelocity())
    nothing = frame_measurements(Frame(2.0, "lidar", Detections.empty()), Sensor(), tracker.settings.classes)
    for label, left in (("pedestrian", 1), ("cone", 0)):
        state = tracker._state.copied()
        state.encounters = likely(state)
        ids, old, new = state.table.id[1:], state.table.label[1:], np.array([label])
        state.joint.reclassify(ids, old, new, np.ones(1))
        state.table.label = np.array(["car", label])
        follow_encounters(state, nothing, Matching.empty(), np.empty((0, 2), dtype=np.int64), 0.1)
        assert len(state.encounters) == left


def test_a_doubted_range_rate_moves_its_track_by_its_share():
    tracker, _ = met(ConstantVelocity())
    sensor = Sensor(noise={"default": NoiseModel(position=0.5, range_rate=0.1)})
    boxes = Boxes.of(["car"], [[7.5, 0.0, 0.9]])
    radar = Frame(2.0, "radar", Detections(boxes, np.ones(1), range_rate=np.array([5.5])), np.eye(4))
    measurements = frame_measurements(radar, sensor, tracker.settings.classes)
    moved = []
    for share in (1.0, 0.3):
        state = tracker._state.copied()
        before, first = state.joint.estimator.mean(state.table.id), np.array([0])
        given = first, state.table.id[:1], state.table.label[:1], np.array([share])
        update_range_rates(state, measurements, *given)
        moved.append(state.joint.estimator.mean(state.table.id) - before)
    assert np.abs(moved[0]).max() > 0.01
    np.testing.assert_allclose(moved[1], 0.3 * moved[0], atol=1e-12)


def test_a_doubted_position_seen_from_an_estimated_pose_moves_its_track_by_its_share():
    settings = TrackerSettings(estimator="isam2", ego=EgoNodeSettings(estimated=True, label="ego"))
    tracker = Tracker(settings, providers=[Odometry(StartSettings((0.0, 0.0, 0.3), 0.3, 0.03))])
    boxes = Boxes.of(["car"], [[12.0, 5.0, 0.9]], np.array([(4.5, 1.9, 1.5)]))
    for k in range(5):
        step = OdometryIncrement(
            yaw_transform(0.1, 0.0, 0.0, 0.01)[np.ix_([0, 1, 3], [0, 1, 3])], 0.1, 1e-4 * np.eye(3)
        )
        ego = EgoMeasurements(step) if k else EgoMeasurements()
        frame = Frame(0.1 * k, "lidar", Detections(boxes, np.ones(1)), None, "ego", ego=ego)
        tracker.step(frame)
    moved = []
    for share in (1.0, 0.3):
        state = tracker._state.copied()
        aside = replace(frame.detections, boxes=replace(boxes, position=boxes.position + np.array([0.3, 0.2, 0.0])))
        now = state.ego.located(replace(frame, detections=aside), state.world_T_ego)
        measurements = frame_measurements(now, Sensor(), settings.classes)
        measurements = measurements.with_context(0.0, state.ego.relative_positions(measurements, now))
        before, one = state.kinematics().position, np.zeros(1, dtype=np.int64)
        update_tracks(state, measurements, Matching(one, one, np.zeros(1), np.array([share])))
        moved.append(state.kinematics().position - before)
    assert np.hypot(*moved[0][0]) > 0.03
    np.testing.assert_allclose(moved[1], 0.3 * moved[0], rtol=0.05)
