"""Speeds of new tracks from the traffic around them."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Tracker, TrackerSettings
from saga_fg.errors import InputError
from saga_fg.tracking.traffic import SPREAD, Passages, SpeedPriorSettings, Traffic, TrafficSettings, speed_prior
from saga_fg.types.track import known_velocities
from tests.saga_fg.traffic_frames import frame

ON = TrafficSettings(memory=5.0, speed_prior=SpeedPriorSettings(weight=5.0))


def passages(position, heading, speed, variance=0.1, time=0.0, ids=None, label="car", standing=0.0):
    n = len(position)
    return Passages(
        np.arange(n) if ids is None else np.array(ids),
        np.full(n, label),
        np.array(position, dtype=float),
        np.array(heading, dtype=float),
        np.array(speed, dtype=float),
        np.full(n, variance),
        np.broadcast_to(np.asarray(standing, dtype=float), n),
        np.full(n, time),
        np.broadcast_to(np.asarray(standing, dtype=float) < 0.5, n),
    )


def speed_at(traffic, position=(0.0, 0.0), heading=0.0, label="car", variance=25.0):
    return expected_at(traffic, 0.0, position, heading, label, variance)[1:]


def expected_at(traffic, standing, position=(0.0, 0.0), heading=0.0, label="car", variance=25.0):
    expected = speed_prior(
        traffic,
        np.array([label]),
        np.array([position]),
        np.array([heading]),
        np.array([variance], dtype=float),
        standing,
    )
    return tuple(column[0] for column in expected)


def remembering(*tables, settings=ON):
    traffic = Traffic(settings)
    for table in tables:
        traffic.update(table, float(table.time.max()))
    return traffic


def test_a_neighbour_in_the_same_place_gives_the_mean_and_variance_of_the_mixture():
    mean, variance = speed_at(remembering(passages([(0, 0)], [0.0], [12.0])))
    assert mean == pytest.approx(5 * 12 / 6)
    assert variance == pytest.approx((25 + 5 * (144 + 0.1 + SPREAD**2)) / 6 - mean**2)


def test_who_tells_nothing_of_the_speed_leaves_it_unknown(subtests):
    for other in [
        passages([(0, 0)], [np.pi], [12.0]),
        passages([(0, 12)], [0.0], [12.0]),
        passages([(0, 0)], [np.nan], [12.0]),
        passages([(0, 0)], [0.0], [12.0], variance=100.0),
        passages([(0, 0)], [0.0], [12.0], label="pedestrian"),
    ]:
        with subtests.test(other=other):
            assert speed_at(remembering(other)) == (pytest.approx(0.0, abs=1e-4), pytest.approx(25.0, abs=1e-3))


def test_a_speed_prior_needs_a_memory():
    with pytest.raises(InputError, match=r"speed_prior.weight: expected 0 with a memory of 0 s"):
        TrafficSettings(speed_prior=SpeedPriorSettings(weight=5.0))


@pytest.mark.parametrize("length", [20.0, 100_000.0], ids=["at one place", "along a road"])
def test_many_new_tracks_among_many_passages_take_little_memory(length):
    rng = np.random.default_rng(0)
    n, new, tracks = 20_000, 300, np.arange(20_000) % 200
    x = rng.uniform(0, length, n)
    place = np.stack([x, rng.normal(0, 1, n)], axis=-1)
    traffic = remembering(passages(place, np.zeros(n), 9 + x / length, ids=tracks))
    label, at, none = np.full(new, "car"), np.linspace(0, length, new), np.zeros(new)
    arguments = (label, np.stack([at, none], axis=-1), none, np.full(new, 25.0))
    tracemalloc.start()
    together = speed_prior(traffic, *arguments)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 32 * new * n  # bytes: a table of all pairs needs some ten columns of 8
    for k in range(0, new, 50):
        alone = speed_prior(traffic, *(each[k : k + 1] for each in arguments))
        assert [column[k] for column in together] == pytest.approx([column[0] for column in alone], rel=1e-12)


def test_neighbours_that_disagree_make_the_speed_uncertain():
    agreed = speed_at(remembering(passages([(5, 0), (-5, 0)], [0, 0], [12, 12])))
    split = speed_at(remembering(passages([(5, 0), (-5, 0)], [0, 0], [0, 24])))
    assert split[0] == pytest.approx(agreed[0])
    assert split[1] > agreed[1] + 50


def test_standing_neighbours_say_that_a_new_one_stands_and_nothing_of_its_speed_if_not():
    both = remembering(passages([(0, 0), (0, 0)], [0, 0], [12, 0.3], standing=[0.0, 1.0]))
    standing, mean, variance = expected_at(both, 0.4)
    assert standing == pytest.approx((0.4 + 5) / 11)
    assert mean == pytest.approx(5 * 12 / 5.6)
    assert variance == pytest.approx((0.6 * 25 + 5 * (144 + 0.1 + SPREAD**2)) / 5.6 - mean**2)
    assert expected_at(remembering(), 0.4) == pytest.approx((0.4, 0.0, 25.0))


def test_a_track_counts_once_however_often_it_was_seen():
    once = remembering(passages([(1, 0)], [0.0], [12.0]))
    often = remembering(*(passages([(1 + 5 * k, 0)], [0.0], [12.0 + k], time=-0.1 * k, ids=[0]) for k in (3, 2, 1, 0)))
    assert speed_at(often) == pytest.approx(speed_at(once))


def test_passages_are_forgotten():
    late = passages([(500, 0)], [0.0], [3.0], time=ON.memory + 0.1, ids=[7])
    assert speed_at(remembering(passages([(0, 0)], [0.0], [12.0]), late))[0] == pytest.approx(0.0, abs=1e-9)


@given(turn=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_the_world_may_be_turned_and_moved(turn, x, y):
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([(8.0, 1.0), (-3.0, 0.5)]) @ np.array([[c, s], [-s, c]]) + (x, y)
    here = speed_at(remembering(passages([(8, 1), (-3, 0.5)], [0.1, -0.2], [9, 14])))
    there = speed_at(remembering(passages(turned, [0.1 + turn, turn - 0.2], [9, 14])), (x, y), turn)
    assert there == pytest.approx(here, abs=1e-6)


def behind_a_leader(settings, newcomer=True):
    """A car at 12 m/s followed for 2 s; then another appears 15 m behind it. Tracks of the last frame."""
    tracker = Tracker(settings)
    for k in range(21):
        cars = [(12.0 * 0.1 * k, 0.0)] + [(12.0 * 2.0 - 15.0, 0.0)] * (newcomer and k == 20)
        tracks = tracker.step(frame(0.1 * k, cars))
    return tracks


def test_a_car_that_appears_behind_another_starts_at_its_speed_with_less_doubt():
    on = behind_a_leader(TrackerSettings(edges=(), traffic=ON))
    off = behind_a_leader(TrackerSettings(edges=()))
    assert off.boxes.velocity[1] == pytest.approx([0.0, 0.0])
    assert on.boxes.velocity[1] == pytest.approx([9.0, 0.0], abs=1.5)
    assert np.trace(on.velocity_covariance[1]) > 10, "it may be parked all the same"
    np.testing.assert_array_equal(on.boxes.position[0], off.boxes.position[0])


def test_a_track_is_reported_at_once_with_a_velocity_as_wide_as_it_is():
    newcomer = behind_a_leader(TrackerSettings(edges=()))
    assert newcomer.id.tolist() == [1, 2]
    known = np.isfinite(known_velocities(newcomer.boxes.velocity, newcomer.velocity_covariance))
    assert known.all(axis=1).tolist() == [True, False]


def test_a_snapshot_remembers_the_traffic():
    settings = TrackerSettings(edges=(), traffic=ON)
    tracker, fresh = Tracker(settings), Tracker(settings)
    for k in range(20):
        tracker.step(frame(0.1 * k, [(1.2 * k, 0.0)]))
    fresh.restore(tracker.snapshot())
    later = frame(2.0, [(24.0, 0.0), (9.0, 0.0)])
    expected = tracker.step(later).boxes.velocity
    assert expected[1, 0] > 5
    np.testing.assert_array_equal(fresh.step(later).boxes.velocity, expected)
