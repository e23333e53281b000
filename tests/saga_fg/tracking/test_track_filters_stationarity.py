"""The belief that an object stands, and what follows from it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Sensor, Tracker, TrackerSettings
from saga_fg.tracking.track_filters import DRIFT, START_RATE, STOP_RATE, Kinematics, Stationarity
from tests.saga_fg.traffic_frames import columns, frame, run, seen, straight

SETTINGS = TrackerSettings(edges=(), stationary_share=0.5)
OFF = replace(SETTINGS, stationary_share=0.0)
TIMES = np.arange(60) * 0.1


def kinematics(position=(0.0, 0.0), velocity=(0.0, 0.0), P=0.04, P_velocity=4.0):
    return Kinematics(np.array([position]), np.array([velocity]), P * np.eye(2)[None], P_velocity * np.eye(2)[None])


def probabilities(frames, settings=SETTINGS):
    """Stationarity of a single track after every frame."""
    tracker, found = Tracker(settings), []
    for f in frames:
        tracker.step(f)
        stationarity = tracker.snapshot().table.stationarity
        found.append(stationarity.probability.item())
    return found


def test_the_belief_is_that_of_bayes():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.3]))
    z, R = np.array([[0.5, 0.0, 0.0, 0.0]]), 0.01 * np.eye(4)[None]
    moving = kinematics(position=(0.6, 0.0), P=0.09)
    stationarity.update(np.array([0]), z, R, moving, np.array([False]))

    def density(distance, variance):
        return np.exp(-(distance**2) / (2 * variance)) / variance

    expected = 0.3 * density(0.5, 0.05) / (0.3 * density(0.5, 0.05) + 0.7 * density(0.1, 0.10))
    assert stationarity.probability.item() == pytest.approx(expected)
    assert stationarity.position[0] == pytest.approx([0.5 * 0.04 / 0.05, 0.0])
    assert stationarity.P[0] == pytest.approx((0.04 - 0.04**2 / 0.05) * np.eye(2))


def test_a_measured_velocity_is_evidence_of_its_own():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.5]))
    still = np.zeros((1, 4))
    stationarity.update(np.array([0]), still, np.eye(4)[None] * 0.04, kinematics(P=0.04), np.array([True]))
    assert stationarity.probability.item() == pytest.approx(1 / (1 + 0.04 / 4.04)), "the positions say nothing"


@given(s=st.floats(0, 1), dt=st.floats(0.01, 5), share=st.floats(0.1, 0.9))
def test_what_time_does_does_not_depend_on_how_often_one_looks(s, dt, share):
    at_once, in_two = (Stationarity.initiated(kinematics(), np.array([s])) for _ in range(2))
    at_once.predict(dt, kinematics())
    in_two.predict(share * dt, kinematics())
    in_two.predict((1 - share) * dt, kinematics())
    assert in_two.probability.item() == pytest.approx(at_once.probability.item())
    at_once.predict(1e6, kinematics())
    halting = STOP_RATE / (1 + 4.0)  # velocities of variance 4 about 0 are slow with the chance 1 / 5
    assert at_once.probability.item() == pytest.approx(halting / (START_RATE + halting)), (
        "the balance of starts and stops"
    )


def test_fast_objects_do_not_halt():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.0]))
    stationarity.predict(2.0, kinematics(velocity=(14.0, 0.0), P_velocity=1.0))
    assert stationarity.probability.item() < 1e-12


def test_one_that_has_just_stoped_is_where_the_joint_filter_has_it():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.0]))
    stationarity.predict(0.1, kinematics(position=(30.0, 4.0)))
    assert stationarity.position[0] == pytest.approx([30.0, 4.0], abs=1e-3)
    assert stationarity.P[0] == pytest.approx((0.04 + 0.1 * DRIFT**2) * np.eye(2))


def test_what_stands_and_what_moves_is_reported_apart_and_so_are_departures():
    rng = np.random.default_rng(4)
    parked = probabilities(seen(rng, straight((5.0, 0.0), (0.0, 0.0)), TIMES, noise=0.1))
    driven = probabilities(seen(rng, straight((5.0, 0.0), (6.0, 0.0)), TIMES, noise=0.1))
    assert min(parked[20:]) > 0.95
    assert max(driven[10:]) < 0.01

    def leaves(t):
        return np.array([(5.0 + 1.5 * max(t - 3.0, 0.0) ** 2, 0.0)])

    departing = probabilities(seen(rng, leaves, TIMES, noise=0.1))
    assert departing[29] > 0.9
    assert departing[-1] < 0.01


def test_velocities_of_parked_cars_are_better_and_those_of_moving_ones_as_good():
    """Of 40 cars far apart."""
    errors, start = {}, np.stack([np.full(40, 5.0), 200.0 * np.arange(40)], axis=-1)
    for speed in (0.0, 8.0):
        for settings in (SETTINGS, OFF):
            truth = straight(start, (speed, 0.0))
            tracks = run(Tracker(settings), seen(np.random.default_rng(1), truth, TIMES[:30], noise=0.2))
            assert len(tracks[-1]) == 40
            sums = np.sum((tracks[-1].boxes.velocity - (speed, 0.0)) ** 2, axis=-1)
            errors[speed, settings is SETTINGS] = np.sqrt(np.mean(sums))
    assert errors[0.0, True] < 0.5 * errors[0.0, False]
    assert errors[8.0, True] < 1.05 * errors[8.0, False]


def test_what_is_reported_is_the_mean_and_the_covariance_of_the_mixture():
    stationarity = Stationarity(np.zeros((1, 2)), np.eye(2)[None], np.array([0.25]))
    moving = kinematics(position=(8.0, 0.0), velocity=(4.0, 0.0), P=2.0, P_velocity=1.0)
    detected, unseen = (stationarity.reported(moving, np.array([coasting])) for coasting in (False, True))
    assert detected.position[0] == pytest.approx([8.0, 0.0])
    assert detected.P[0] == pytest.approx(2.0 * np.eye(2))
    assert unseen.position[0] == pytest.approx([6.0, 0.0])
    assert unseen.P[0] == pytest.approx(np.diag([0.75 * 2 + 0.25 + 0.25 * 0.75 * 64, 0.75 * 2 + 0.25]))
    reported = detected
    assert reported.velocity[0] == pytest.approx([3.0, 0.0])
    assert reported.P_velocity[0] == pytest.approx(np.diag([0.75 + 0.25 * 0.75 * 16, 0.75]))


def test_frames_seen_late_count_like_others():
    rng = np.random.default_rng(2)
    frames = seen(rng, straight((5.0, 0.0), (0.0, 0.0)), TIMES[:30])
    late = [frames[k] for k in (*range(20), 21, 20, *range(22, 30))]
    assert probabilities(late)[-1] == pytest.approx(probabilities(frames)[-1], abs=0.02)


def test_snapshots_and_looking_ahead_keep_the_belief():
    rng = np.random.default_rng(3)
    frames = seen(rng, straight([(5.0, 0.0), (5.0, 20.0)], [(0.0, 0.0), (5.0, 0.0)]), TIMES)
    tracker, other = Tracker(SETTINGS), Tracker(SETTINGS)
    run(tracker, frames[:30])
    other.restore(tracker.snapshot())
    tracker.tracks(10.0)
    for f in frames[30:]:
        assert columns(tracker.step(f)) == columns(other.step(f))


def test_a_measured_velocity_of_a_new_track_is_believed():
    fast = frame(0.0, [(0.0, 0.0)], velocity=(12.0, 0.0))
    tracks = Tracker(SETTINGS, {"default": Sensor()}).step(fast)
    assert tracks.boxes.velocity[0] == pytest.approx([12.0, 0.0], abs=0.05)
