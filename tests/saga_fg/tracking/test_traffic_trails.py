"""Paths along the trails of earlier traffic and lanes, and tracks that follow them unseen."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Curvilinear, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings, prediction
from saga_fg.tracking.prediction import typical_speed
from saga_fg.tracking.traffic import STEP, Passages, Traffic, TrafficSettings, paths
from saga_fg.types.road_map import Lane, RoadMap
from tests.saga_fg.traffic_frames import assert_same, frame

SETTINGS = TrafficSettings(memory=60.0)
SPEED, RADIUS, DT = 8.0, 20.0, 0.1
NOBODY = np.array([10**6])


def passing(position, heading, time=0.0, ids=None, speed=8.0):
    n = len(position)
    ids = np.zeros(n, dtype=np.int64) if ids is None else np.array(ids)
    headings, none = np.broadcast_to(heading, n).astype(float), np.zeros(n)
    where = np.array(position, dtype=float).reshape(-1, 2)
    times, moves = np.full(n, time), np.ones(n, dtype=bool)
    return Passages(ids, np.full(n, "car"), where, headings, np.full(n, speed), none, none, times, moves)


def along(place, heading, ids=0, settings=SETTINGS):
    """The trail of one track by its places (k, 2) and headings (k,)."""
    trails = Traffic(settings)
    for k, (p, h) in enumerate(zip(place, heading, strict=True)):
        trails.update(passing([p], h, 0.1 * k, [ids]), 0.1 * k)
    return trails


def known(trails):
    """All passages of tracks."""
    return trails.left.append(trails.latest)


def arc(length, radius=RADIUS):
    """Places and headings of a bend to the left that begins at (0, 0) towards x, after 20 m straight on."""
    angle = np.maximum(length, 0.0) / radius
    x = np.where(length < 0, length, radius * np.sin(angle))
    return np.stack([x, radius * (1 - np.cos(angle))], axis=-1), angle


def path(trails, position=(-10.0, 0.0), heading=0.0, curvature=0.0, steps=10, track=NOBODY, sharpest=(np.pi, np.pi)):
    place, course, bend, turns = (np.array([one]) for one in (position, heading, curvature, sharpest))
    return paths(trails, track, place, course, bend, turns, steps)


def test_a_trail_has_a_point_every_two_metres_and_a_place_once():
    trails = along(*arc(np.arange(-20, 20, 0.5)))
    apart = np.hypot(*np.diff(known(trails).position, axis=0).T)
    assert (apart >= 1.99).all()
    assert (apart < 2.6).all()


def test_points_are_forgotten_whether_somebody_moves_or_not():
    trails = along(*arc(np.arange(-20, 0, 2.0)))
    trails.update(passing([(100.0, 0.0)], 0.0, 60.5, [3]), 60.5)
    assert known(trails).time.min() >= 0.5
    trails = along(*arc(np.arange(-20, 0, 2.0)))
    trails.update(passing(np.empty((0, 2)), 0.0), 1000.0)
    assert len(known(trails)) == 0
    assert path(trails).weight.max() == 0.0
    assert len(along(*arc(np.arange(-20, 0, 2.0)), settings=TrafficSettings()).left) == 0


def test_a_path_goes_round_the_bend_of_earlier_traffic_or_beside_it():
    found = path(along(*arc(np.arange(-20, 40, 1.0))))
    expected, heading = arc(-10 + STEP * np.arange(11))
    assert found.position[0] == pytest.approx(expected, abs=0.6)
    assert found.heading[0] == pytest.approx(heading, abs=0.12)
    assert found.weight.min() > 0.4
    found = path(along(*arc(np.arange(-20, 40, 1.0))), position=(-10.0, 1.0))
    radius = np.hypot(*(found.position[0, 5:] - [0.0, RADIUS]).T)
    assert radius == pytest.approx(np.full(6, RADIUS - 1.0), abs=0.6)


def test_who_is_too_fast_for_the_bend_of_those_that_turn_off_leaves_them():
    trails = along(*arc(np.arange(-20, 40, 1.0)))
    slow, fast = (path(trails, sharpest=(0.02, turn)) for turn in (0.6, 0.04))
    assert slow.heading[0] == pytest.approx(path(trails).heading[0])
    assert np.abs(np.diff(fast.heading[0])).max() < 0.04 + 1e-9
    assert fast.heading[0, -1] < slow.heading[0, -1] / 2
    assert fast.weight[0, -1] < 0.1 < slow.weight[0, -1]
    askew = path(trails, heading=0.1, sharpest=(0.02, 0.6))
    assert askew.heading[0, 0] == pytest.approx(0.08), "at once it turns by so much"


@pytest.mark.parametrize(
    ("position", "heading"), [((-10.0, 0.0), np.pi), ((-10.0, 8.0), 0.0)], ids=["oncoming", "another lane"]
)
def test_other_traffic_leads_nobody(position, heading):
    found = path(along(*arc(np.arange(-20, 40, 1.0))), position, heading, steps=4)
    assert found.heading[0] == pytest.approx(np.full(5, heading), abs=1e-2)
    assert found.weight.max() < 0.05


def test_without_trails_a_path_keeps_its_own_bend_which_fades():
    straight, bent = path(Traffic(SETTINGS)), path(Traffic(SETTINGS), curvature=0.05)
    assert straight.heading[0] == pytest.approx(np.zeros(11))
    turns = np.diff(bent.heading[0])
    assert turns[0] == pytest.approx(0.05 * STEP, rel=0.1)
    assert (np.diff(turns) < 0).all()


def test_nobody_is_led_by_his_own_trail_or_oncoming_lanes():
    trails = along(*arc(np.arange(-20, 40, 1.0)), ids=5)
    assert path(trails, track=np.array([5])).weight.max() == 0.0
    found = path(of_map(BEND), heading=np.pi)
    assert found.heading[0] == pytest.approx(np.full(11, np.pi))


def test_a_path_knows_the_speed_of_earlier_traffic():
    trails = Traffic(SETTINGS)
    for x in np.arange(-20.0, 40.0, 2.0):
        trails.update(passing([(x, 0.0)], 0.0, 0.1 * (x + 20.0), [1], speed=10.0 - 0.1 * x), 0.1 * (x + 20.0))
    found = path(trails)
    assert found.speed[0] == pytest.approx(10.0 - 0.1 * found.position[0, :, 0], abs=0.2)
    assert path(Traffic(SETTINGS)).weight.max() == 0.0


@given(turn=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_the_world_may_be_turned_and_moved(turn, x, y):
    place, heading = arc(np.arange(-20, 20, 2.1))
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, s], [-s, c]])
    here = path(along(place, heading), steps=6)
    there = path(along(place @ R + (x, y), heading + turn), np.array([-10.0, 0.0]) @ R + (x, y), turn, steps=6)
    assert there.position[0] == pytest.approx(here.position[0] @ R + (x, y), abs=1e-6)
    assert there.heading[0] == pytest.approx(here.heading[0] + turn, abs=1e-6)


# lanes


def of_map(*lanes):
    """The memory of nobody but a map, of lanes by their places (k, 2)."""
    traffic = Traffic(TrafficSettings())
    named = tuple(Lane(f"lane-{k}", tuple(map(tuple, centre.tolist()))) for k, centre in enumerate(lanes))
    traffic.add_lanes(named)
    return traffic


BEND, STRAIGHT_ON = arc(np.arange(-20, 40, 5.0))[0], np.stack([np.arange(-20, 40, 5.0), np.zeros(12)], axis=-1)


def test_a_path_follows_a_lane_without_any_traffic_and_at_no_speed():
    found = path(of_map(BEND))
    expected, heading = arc(-10 + STEP * np.arange(11))
    assert found.position[0] == pytest.approx(expected, abs=0.8)
    assert found.heading[0] == pytest.approx(heading, abs=0.15)
    assert found.weight.max() == 0.0


def test_a_path_goes_on_along_the_next_lane_or_straight_on():
    whole, parted = path(of_map(BEND)), path(of_map(BEND[:6], BEND[5:]))
    assert parted.position[0] == pytest.approx(whole.position[0], abs=0.3)
    found = path(of_map(STRAIGHT_ON[:6]), steps=10)
    assert found.heading[0] == pytest.approx(np.zeros(11), abs=1e-9)
    assert found.position[0, -1] == pytest.approx([-10 + 10 * STEP, 0.0])


@pytest.mark.parametrize(("curvature", "bends"), [(0.0, False), (0.05, True)], ids=["straight on", "turning"])
def test_at_a_fork_a_path_takes_the_lane_that_it_turns_with(curvature, bends):
    found = path(of_map(BEND, STRAIGHT_ON), position=(2.0, 0.0), curvature=curvature, steps=7)
    assert (found.heading[0, -1] > 0.6) == bends
    assert (abs(found.heading[0, -1]) < 0.4) != bends


def test_lanes_are_known_once_and_replaced_by_their_names():
    traffic = of_map(BEND)
    known = traffic.lanes
    traffic.add_lanes(named_lane(BEND))
    assert traffic.lanes is known
    off = Traffic(TrafficSettings(reach=0.0))
    off.add_lanes(named_lane(BEND))
    assert len(off.lanes) == 0
    traffic, moved = of_map(STRAIGHT_ON, BEND + np.array([0.0, 30.0])), STRAIGHT_ON + np.array([0.0, 1.2])
    traffic.add_lanes(named_lane(moved))
    of_it = traffic.lanes.points.position[traffic.lanes.points.position[:, 1] < 10]
    assert (of_it[:, 1] == 1.2).all()
    assert len(np.unique(traffic.lanes.points.id)) == 2


def named_lane(centre):
    return (Lane("lane-0", tuple(map(tuple, np.asarray(centre).tolist()))),)


def test_lanes_are_indexed_once_and_what_finds_them_is_no_part_of_a_state():
    traffic = of_map(BEND)
    path(traffic)
    found, cells = traffic.lanes, traffic.lanes._cells
    assert cells is not None
    traffic.update(passing([(0.0, 0.0)], 0.0), 0.0)
    twin = traffic.copied()
    assert twin.lanes is traffic.lanes is found
    assert twin.lanes._cells is cells
    assert len(pickle.dumps(traffic.lanes)) == len(pickle.dumps(of_map(BEND).lanes))
    assert path(pickle.loads(pickle.dumps(twin))).position == pytest.approx(path(traffic).position, abs=0)


def test_trails_are_found_anew_after_an_update():
    traffic = along(*arc(np.arange(-20, 0, 2.1)))
    before = traffic.trails()
    assert traffic.trails() is before
    assert traffic.copied()._trails is None
    traffic.update(passing([(0.0, 0.0)], 0.0, 5.0, [3]), 5.0)
    assert len(traffic.trails()) > len(before)


# tracks

SENSORS = {"lidar": Sensor(noise={"default": NoiseModel(position=0.1, yaw=0.05)})}
CAR = ClassSettings(Curvilinear(course_time=0.7), max_deviation=np.inf)
ON = TrackerSettings({"default": CAR}, edges=(), traffic=SETTINGS)


def driven(settings, follower=3.0, hidden=2.0, gap=2.5, seed=0):
    """A car drives round a bend, another `follower` s behind is not detected from a place before the bend on.

    Trackers, and the errors of the hidden car at the end, m.
    """
    rng, trackers, start = np.random.default_rng(seed), [Tracker(each, SENSORS) for each in settings], follower + hidden
    for k in range(int((start + gap) / DT) + 1):
        t = k * DT
        times = [t, t - follower] if follower <= t <= start else [t]
        place, yaw = zip(*(arc(np.array(-20.0 + SPEED * each)) for each in times), strict=True)
        noisy = np.array(place) + 0.1 * rng.normal(size=(len(times), 2))
        seen = frame(t, noisy, yaw=np.array(yaw) + 0.05 * rng.normal(size=len(times)))
        reported = [tracker.step(seen) for tracker in trackers]
    truth = arc(np.array(-20.0 + SPEED * (hidden + gap)))[0]
    return trackers, [np.hypot(*(tracks.boxes.position[1, :2] - truth)) for tracks in reported]


def test_a_hidden_car_follows_the_path_and_heading_of_earlier_traffic():
    off = replace(ON, traffic=TrafficSettings(), classes={"default": replace(CAR, motion=Curvilinear())})
    with_trails, without = np.mean([driven((ON, off), seed=seed)[1] for seed in range(3)], axis=0)
    assert with_trails < 0.4 * without
    (tracker,), _ = driven((ON,))
    assert tracker.tracks(0.0).boxes.yaw[1] == pytest.approx(arc(np.array(-20.0 + SPEED * 4.5))[1], abs=0.2)


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_every_estimator_takes_the_same_paths(estimator, subtests):
    for edges in [(), TrackerSettings().edges]:
        with subtests.test(edges=edges):
            one = replace(ON, edges=edges, tolerance=0.0)
            trackers, _ = driven((one, replace(one, estimator=estimator)), gap=1.0)
            assert trackers[0].graph.motions[0].settling[1] > 0
            first, second = (tracker.tracks(6.3) for tracker in trackers)
            assert_same(first, second, 1e-7, 1e-6)


def test_where_trails_part_the_place_is_less_certain():
    """A car that is hidden at a fork of two trails may be on either."""
    trails = along(*arc(np.arange(-20, 40, 1.0)))
    before = path(trails)
    for p in np.arange(-20, 40, 1.0):
        trails.update(passing([(p, 0.0)], 0.0, 10.0, [1]), 10.0)
    at_the_fork = path(trails, *(each[0] for each in arc(np.array([6.0]))))
    assert before.certainty[0] > 0.7 > 0.0 == path(Traffic(SETTINGS)).certainty[0]
    assert before.disagreement == pytest.approx(0.0, abs=1e-9)
    assert at_the_fork.disagreement > 0.01
    assert at_the_fork.certainty < 0.9 * before.certainty


def test_where_nothing_is_known_of_earlier_traffic_its_speed_is_not_zero():
    """A trail of 8 m/s begins 13 m ahead: nothing is known before it, and 8 m/s wherever there is any weight."""
    trails = along(*arc(np.arange(3, 40, 1.0)))
    for way in np.arange(0.0, 30.0, 0.5):
        speed, weight = typical_speed(path(trails, heading=0.05), np.array([way]))
        assert weight[0] < 1e-6 or speed[0] == pytest.approx(8.0)


def test_a_hidden_car_takes_on_the_speed_of_earlier_traffic():
    """One car slows down from 10 to 5 m/s between 0 and 30 m, the other is hidden at 0 m and does the same."""
    x, speed, t = -30.0, 10.0, 0.0
    slow, fast = Tracker(ON, SENSORS), Tracker(replace(ON, traffic=TrafficSettings()), SENSORS)
    places = []
    while t < 9.0:
        places.append(x)
        x, speed, t = x + DT * speed, float(np.interp(x, [0.0, 30.0], [10.0, 5.0])), t + DT
    behind, gap = 30, 25  # frames
    hidden = behind + int(np.searchsorted(places, 0.0))
    for k in range(hidden + gap):
        seen = [places[k], *([places[k - behind]] if behind <= k < hidden else [])]
        for tracker in (slow, fast):
            tracker.step(frame(k * DT, [(p, 0.0) for p in seen], yaw=0.0))
    truth = places[hidden + gap - 1 - behind]
    off = [abs(tracker.tracks((hidden + gap - 1) * DT).boxes.position[1, 0] - truth) for tracker in (slow, fast)]
    assert off[0] < 0.92 * off[1], "from one vehicle alone"


def test_a_hidden_car_keeps_to_the_lane_of_the_map_round_a_bend():
    """Nobody went before it, and the map alone tells of the bend."""
    road = RoadMap(lanes=(Lane("bend", tuple(map(tuple, BEND.tolist()))),))
    trackers = [
        Tracker(replace(ON, traffic=TrafficSettings(reach=reach), road_map=road), SENSORS) for reach in (1.5, 0)
    ]
    for k in range(45):
        place, yaw = arc(np.array(-20.0 + SPEED * k * DT))
        seen = frame(k * DT, place[None] if k < 20 else np.empty((0, 2)), yaw=yaw)
        reported = [tracker.step(seen) for tracker in trackers]
    with_lane, without = (np.hypot(*(tracks.boxes.position[0, :2] - place)) for tracks in reported)
    assert with_lane < 1.0 < 3.0 < without


def test_where_nothing_tells_the_path_some_turn_off(monkeypatch):
    """The variance across grows by about that of those who turn, share a^2 t^4 / 4; fast cars turn at 2 m/s^2."""

    def across(speed):
        tracker = Tracker(replace(ON, classes={"default": replace(CAR, motion=Curvilinear(course_time=0.2))}), SENSORS)
        for k in range(20):
            tracker.step(frame(k * DT, np.array([[speed * k * DT, 0.0]]), yaw=0.0))
        return tracker.predict([2.0, 4.0]).position_covariance[:, 0, 1, 1]

    grown = [across(speed) for speed in (3.0, 15.0)]
    monkeypatch.setattr(prediction, "TURNING_OFF", 0.0)
    before = [across(speed) for speed in (3.0, 15.0)]
    share, hardest, time = 0.05, np.array([[0.3 * 3.0], [2.0]]), np.array([2.0, 4.0])
    ratio = np.subtract(grown, before) / (share * hardest**2 * time**4 / 4)
    assert (ratio > 0.5).all()
    assert (ratio < 1.2).all()
