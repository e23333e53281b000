"""Who yields to whom, from paths of earlier traffic, places of halts, order of arrival and what vehicles do."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, Tracker, TrackerSettings
from saga_fg.errors import InputError
from saga_fg.kernels.paths import path_meetings
from saga_fg.model import NodeTable, Paths
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.tracking.edge_record import Lines
from saga_fg.tracking.right_of_way import RightOfWay, free_time, probabilities
from saga_fg.tracking.table_tracking import dense_traffic_settings
from saga_fg.tracking.traffic import Passages, Traffic, TrafficSettings, paths, straight_paths
from saga_fg.types import RELATIONS, Lane, RoadMap, StopLine, TrafficLight

EAST, NORTH = 0.0, np.pi / 2
NOBODY_HALTS = Lines.none()
HALTS_IN_THE_SOUTH = Lines(np.array([[0.0, -8.0]]), np.array([NORTH]), np.array([8.0]), *np.zeros((2, 1)))


def memory(*lines):
    """Traffic that has passed every 2 m along lines (start, heading) of 60 m."""
    traffic = Traffic(TrafficSettings(memory=600.0))
    s = np.arange(0.0, 60.0, 2.0)
    parts = []
    for number, (start, heading) in enumerate(lines):
        u, n = np.array([np.cos(heading), np.sin(heading)]), len(s)
        zero = np.zeros(n)
        parts.append(
            Passages(
                id=np.full(n, 1000 + number),
                label=np.full(n, "car"),
                position=np.asarray(start) + s[:, None] * u,
                heading=np.full(n, heading),
                speed=zero + 8,
                variance=zero + 1,
                stationary=zero,
                time=s / 8,
                moves=np.ones(n, dtype=bool),
            )
        )
    traffic.left = Passages.concatenate([Passages.empty(), *parts])
    return traffic


CROSSING = memory(((-30, 0), EAST), ((0, -30), NORTH))


def judged(moments, traffic=CROSSING, lines=NOBODY_HALTS, people=()):
    """What is known after moments of (x, y, heading, speed) of vehicles 1, 2, ..., .2 s apart."""
    known = RightOfWay()
    for number, vehicles in enumerate(moments):
        x, y, heading, speed = np.array(vehicles, dtype=float).T
        k, place = len(x), np.column_stack([x, y])
        velocity = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        ids = np.arange(1, k + 1)
        walks = np.isin(ids, people)
        label = np.where(walks, "pedestrian", "car")
        nodes = NodeTable(ids, label, (), place, velocity, heading, np.where(walks, 0.5, 4.5), np.full(k, 0.04))
        ways = paths(traffic, ids, place, heading, np.zeros(k), np.full((k, 2), 0.5), 20).select(np.flatnonzero(~walks))
        ways = Paths.concatenate([ways, straight_paths(ids, place, heading, 20).select(np.flatnonzero(walks))])
        known = known.later(nodes, ways, lines, 0.2 * number)
    return known


def told(known, name=RELATIONS[0]):
    return {(a, b) for a, b, relation, _ in known.relations(np.arange(1, 10)).rows() if relation == name}


def waiting_in_the_south(other_x, speed, moments=15):
    """Vehicle 1 stands before the crossing, vehicle 2 comes from the west."""
    return [[(0, -8.0, NORTH, 0.0), (other_x + 0.2 * k * speed, 0, EAST, speed)] for k in range(moments)]


def test_a_car_that_brakes_for_a_person_yields_and_a_person_who_lets_one_pass():
    brakes = [[(-14 + k - 0.04 * k**2, 0, EAST, 5.0 - 0.4 * k), (0, -4.5 + 0.28 * k, NORTH, 1.4)] for k in range(10)]
    assert told(judged(brakes, people=[2])) == {(1, 2)}
    passes = [[(-24.0 + 2.0 * k, 0, EAST, 10.0), (0, -4.7, NORTH, 0.0)] for k in range(8)]
    known = judged(passes, people=[2]).probability
    assert known[2, 1][0] > 0.5
    assert known[1, 2][0] < 0.1
    assert known[1, 2][1] == known[2, 1][1] == 0.0


def test_people_are_told_nothing_of_one_another_nor_of_a_car_beside_which_they_walk():
    crowd = [[(-3 + 0.28 * k, 0, EAST, 1.4), (0, -3 + 0.28 * k, NORTH, 1.4)] for k in range(8)]
    assert judged(crowd, people=[1, 2]).probability == {}
    along = [[(-20 + 1.6 * k, 0, EAST, 8.0), (0.28 * k, 0.5, EAST, 1.4)] for k in range(8)]
    assert judged(along, people=[2]).probability == {}


def test_who_waits_where_traffic_halts_yields_to_who_comes():
    known = judged(waiting_in_the_south(-34.0, 8.0), lines=HALTS_IN_THE_SOUTH)
    assert told(known) == {(1, 2)}
    assert all(0.0 <= p <= 1.0 for each in known.probability.values() for p in each)


def test_nothing_is_kept_of_a_vehicle_that_is_someone_else():
    known = judged(waiting_in_the_south(-34.0, 8.0), lines=HALTS_IN_THE_SOUTH)
    left = known.without({1})
    assert any(1 in pair for pair in known.line)
    assert not any(1 in kept for kept in (left.motion, left.arrived, *left.line, *left.probability))


def test_nobody_yields_to_who_has_left():
    assert told(judged(waiting_in_the_south(20.0, 8.0), lines=HALTS_IN_THE_SOUTH)) == set()


def test_a_follower_does_not_yield_to_its_leader():
    line = [[(-20 + 1.6 * k, 0, EAST, 8.0), (-8 + 1.6 * k, 0, EAST, 8.0)] for k in range(10)]
    assert judged(line).probability == {}


def test_oncoming_vehicles_do_not_meet():
    traffic = memory(((-30, 0), EAST), ((30, 3.5), np.pi))
    moments = [[(-20 + 1.6 * k, 0, EAST, 8.0), (20 - 1.6 * k, 3.5, np.pi, 8.0)] for k in range(10)]
    assert judged(moments, traffic).probability == {}


def test_where_nobody_ever_stops_lines_tell_nothing():
    distance, halts, _ = NOBODY_HALTS.next_of(np.zeros((2, 2)), np.zeros(2))
    assert np.isinf(distance).all()
    assert (halts == 0).all()
    moments = [[(-40 + 1.6 * k, 0, EAST, 8.0), (0, -60 + 1.6 * k, NORTH, 8.0)] for k in range(10)]
    assert all(0.0 <= p <= 1.0 for each in judged(moments).probability.values() for p in each)


def test_the_next_line_is_that_of_ones_own_lane_and_direction():
    position, heading = np.array([[0.5, -20.0], [0.0, 8.0], [5.0, -20.0], [0.0, -20.0]]), [NORTH, NORTH, NORTH, EAST]
    distance, halts, _ = HALTS_IN_THE_SOUTH.next_of(position, np.array(heading))
    assert distance.tolist() == pytest.approx([12.0, np.inf, np.inf, np.inf])
    assert (halts > 0).tolist() == [True, False, False, False]


def test_order_of_vehicles_does_not_matter():
    moments = waiting_in_the_south(-34.0, 8.0)
    one = judged(moments, lines=HALTS_IN_THE_SOUTH).probability
    other = judged([vehicles[::-1] for vehicles in moments], lines=HALTS_IN_THE_SOUTH).probability
    assert other[2, 1] == pytest.approx(one[1, 2], abs=0.1)  # the meeting point is found to a step of the path


def test_what_is_known_of_a_vehicle_is_forgotten_with_it():
    known = judged(waiting_in_the_south(-34.0, 8.0)).without({1})
    assert known.motion.keys() == {2}
    assert known.probability == {}


def braking_of(known, x, y, heading, speed, free=1.0, node=1):
    """The expected acceleration of one vehicle, that of those that go on being `free`."""
    place, velocity = np.array([[x, y]], dtype=float), speed * np.array([[np.cos(heading), np.sin(heading)]])
    return known.accelerations(np.array([node]), place, np.array([heading]), velocity, np.array([free]))[0]


def test_who_yields_brakes_to_its_line_and_others_go_on():
    known = judged(waiting_in_the_south(-34.0, 8.0), lines=HALTS_IN_THE_SOUTH)
    p, _ = known.probability[1, 2]
    assert known.line[1, 2].tolist() == pytest.approx([0.0, -8.0])
    assert braking_of(known, 0, -18, NORTH, 5.0) == pytest.approx((1 - p) * 1.0 - p * 5.0**2 / 20)
    assert braking_of(known, 0, -8.1, NORTH, 0.0) == pytest.approx(1 - p), "it stands"
    assert braking_of(known, 0, -8.1, NORTH, -0.5) == pytest.approx(1 - p), "it stands, its velocity is noise"
    assert braking_of(known, 0, -8.1, NORTH, 9.0, free=0.0) == pytest.approx(-4.0 * p), "no harder than drivers brake"
    assert braking_of(known, 0, -5, NORTH, 5.0) == pytest.approx(1 - p), "it is beyond the line"
    assert braking_of(known, -10, 0, EAST, 8.0, node=2) == pytest.approx(1.0, abs=0.4), "it has the right of way"
    assert braking_of(known, 0, -18, NORTH, 5.0, node=7) == 1.0, "nothing is known of it"
    joining = replace(known, probability={**known.probability, (2, 7): (0.99, 0.0)})
    assert braking_of(joining, -10, 0, EAST, 8.0, node=2) == braking_of(known, -10, 0, EAST, 8.0, node=2), "no line"


def test_where_ways_come_together_nobody_halts_at_a_line():
    traffic = memory(((-60, 0), EAST), ((-46, -8), 0.3))
    moments = [[(-25 + 1.6 * k, 0, EAST, 8.0), (-28 + 1.6 * k, -3 + 0.1 * k, 0.06, 8.0)] for k in range(8)]
    assert judged(moments, traffic).line == {}


def test_paths_that_cross_a_hundred_times_meet_once():
    x = np.arange(0.0, 202.0, 0.5)
    wave = np.sin(np.pi * x / 2)
    points = np.stack([np.column_stack([x, wave]), np.column_stack([x, -wave])])
    pair, place = path_meetings(points, np.full(2, len(x)), 0.1, 2.0)
    assert pair.tolist() == [[0, 1]]
    assert place.tolist() == [[0, 0]]


def test_meetings_are_those_of_all_distances():
    rng = np.random.default_rng(3)
    points = np.cumsum(rng.uniform(-0.7, 0.7, (12, 40, 2)), axis=1) + rng.uniform(-5, 5, (12, 1, 2))
    reach = rng.integers(5, 40, 12)
    pair, place = path_meetings(points, reach, 0.5, 1.0)
    expected = {}
    for p in range(12):
        for q in range(p + 1, 12):
            away = np.linalg.norm(points[p, : reach[p], None] - points[q, : reach[q]], axis=-1)
            near = np.flatnonzero(away.min(axis=1) < 0.5)
            if len(near):
                expected[p, q] = [near[0], away[near[0]].argmin()]
    assert {tuple(each): list(at) for each, at in zip(pair.tolist(), place, strict=True)} == expected


def test_free_time_is_that_of_an_even_acceleration_up_to_the_cruising_speed():
    assert free_time(np.array([0.9, -3.0, 20.0]), np.array([0.0, 5.0, 10.0])).tolist() == pytest.approx([1.0, 0.0, 2.0])


def test_probabilities_are_finite_for_extreme_evidence():
    p = probabilities(np.vstack([np.full(27, 1e6), np.full(27, -1e6), np.zeros(27)]))
    assert ((p >= 0) & (p <= 1)).all()


def frames(count=12, **more):
    """Two vehicles come to a crossing, from the west and the south; a third one is parked beside the road."""
    for k in range(count):
        position = [[-20 + 0.8 * k, 0, 0.8], [0, -20 + 0.6 * k, 0.8], [-6, -4.5, 0.8]]
        size, velocity = [[4.5, 1.8, 1.6]] * 3, [[np.nan, np.nan]] * 3
        boxes = Boxes.of(["car"] * 3, position, size, [EAST, NORTH, EAST], velocity)
        yield Frame(0.1 * k, "lidar", Detections(boxes, np.array([0.9, 0.9, 0.9])), **more)


def test_without_edges_that_answer_for_themselves_nobody_is_told_to_yield():
    tracker = Tracker(TrackerSettings())
    assert all(len(tracker.step(frame).relations) == 0 for frame in frames())


def test_a_parked_car_takes_no_part():
    tracker = Tracker(dense_traffic_settings())
    for frame in frames(30):
        tracks = tracker.step(frame)
    parked = tracks.id[np.argmin(np.hypot(*(tracks.boxes.position[:, :2] - [-6, -4.5]).T))]
    pairs = tracker.snapshot().right_of_way.probability
    assert pairs
    assert not any(parked in pair for pair in pairs)


def cars_at(time, others):
    """Places (k, 2) of cars: three halt at a line in the south, three pass from the west meanwhile, and the fourth,
    which comes at 18 s, is hidden from 20 s on. With `others` one passes from the west then, too."""
    cars = [(0.0, -8.5 - 1.2 * max(4 - s, 0) ** 2 + 1.2 * max(s - 5, 0) ** 2) for s in time - 6.0 * np.arange(4)]
    cars[3:] = cars[3:] if 18 < time < 20 else []
    cars += [(8 * (time - 6 * n - 1.5) - 24, 0.0) for n in range(4 if others else 3)]
    return [car for car in cars if -30 < sum(car) < 30]


def ways_of_the_hidden_car(others):
    """Where the car in the south is predicted, m, every 0.1 s after it is hidden."""
    tracker, name, places = Tracker(dense_traffic_settings()), None, []
    for k in range(1, 240):
        cars = cars_at(0.1 * k, others)
        heading, n = [NORTH if x == 0.0 else EAST for x, _ in cars], len(cars)
        boxes = Boxes.of(["car"] * n, [(*car, 0.8) for car in cars], [[4.5, 1.8, 1.6]] * n, heading)
        tracks = tracker.step(Frame(0.1 * k, "lidar", Detections(boxes, np.full(n, 0.9))))
        if k == 199:
            name = tracks.id[np.argmin(np.hypot(*(tracks.boxes.position[:, :2] - [0.0, -13.5]).T))]
        places += tracks.boxes.position[tracks.id == name, 1].tolist() if name is not None else []
    return np.array(places)


def test_a_hidden_car_that_yields_stays_at_its_line():
    yields, goes = ways_of_the_hidden_car(True), ways_of_the_hidden_car(False)
    n = min(len(yields), len(goes))
    assert n > 15
    assert yields[n - 1] < goes[n - 1] - 3.0


def test_a_stop_line_across_no_lane_changes_nothing():
    alone = RoadMap(
        (TrafficLight("none", (52.0, 52.0)),), (StopLine("nowhere", (50.0, 50.0), (54.0, 50.0), "none"),), ()
    )
    plain, mapped = Tracker(dense_traffic_settings()), Tracker(dense_traffic_settings())
    for one, other in zip(frames(), frames(road_map=alone), strict=True):
        a, b = plain.step(one), mapped.step(other)
        assert np.array_equal(a.boxes.position, b.boxes.position)
        assert a.relations.rows() == b.relations.rows()


STOP = StopLine("stop", (-1.75, 0.0), (1.75, 0.0))
LAST = 30  # frames with detections


def alone_until_hidden(road_map, steps=60):
    """Places, m, of one car that comes from the south at 6 m/s, is hidden 12 m before the origin, and its tracker."""
    tracker, found = Tracker(dense_traffic_settings()), []
    for k in range(steps):
        place = [(0.0, 0.6 * k - 30.0, 0.8)] if k < LAST else []
        n = len(place)
        boxes = Boxes.of(["car"] * n, place, [[4.5, 1.8, 1.6]] * n, [NORTH] * n)
        tracks = tracker.step(Frame(0.1 * k, "lidar", Detections(boxes, np.full(n, 0.9)), road_map=road_map))
        found.append(tracks.boxes.position[:1, 1])
    return np.concatenate([np.empty(0), *found[LAST:]]), tracker


def test_a_hidden_car_halts_at_a_stop_line_of_the_map_and_at_a_crossing_only_for_somebody():
    free, stop, cross = (
        alone_until_hidden(road)[0]
        for road in (None, RoadMap(stop_lines=(STOP,)), RoadMap(stop_lines=(replace(STOP, sign="crossing"),)))
    )
    n = min(map(len, (free, stop, cross)))
    assert n > 15
    assert stop[n - 1] < free[n - 1] - 2.5
    assert cross[:n] == pytest.approx(free[:n])


def test_vehicles_tell_no_light_of_a_line_that_has_none():
    road = RoadMap((TrafficLight("light", (52.0, 52.0)),), (STOP, StopLine("far", (50, 50), (54, 50), "light")))
    _, tracker = alone_until_hidden(road, 20)
    assert tracker.map_nodes.beliefs.keys() == {"light"}


def test_each_lane_of_a_line_is_a_place_to_halt_and_maps_in_tiles_bring_it_once():
    road = RoadMap(stop_lines=(StopLine("both", (-1.75, 0.0), (5.25, 0.0)),))
    tracker = Tracker(dense_traffic_settings())
    for frame, tile in zip(frames(2), (road, replace(road, deviation=0.3)), strict=True):
        tracker.step(replace(frame, road_map=tile))
    snapshot = tracker.snapshot()
    assert (snapshot.halting.lines.position[:, 0] + snapshot.origin[0]).tolist() == pytest.approx([3.5, 0.0])
    assert snapshot.halting.lines.probability.tolist() == pytest.approx([0.9, 0.9])


def test_a_stop_line_without_light_across_no_lane_is_named_and_left_out(caplog):
    road = RoadMap(stop_lines=(STOP,), lanes=(Lane("east", ((-50.0, 5.0), (50.0, 5.0))),))
    _, tracker = alone_until_hidden(road, 3)
    assert caplog.messages == ["stop line stop: no lane of the map crosses it; vehicles are not expected to halt there"]
    assert len(tracker.snapshot().halting.lines) == 0


def test_modes_tell_who_waits_follows_or_goes_on_beside_the_same_mean():
    tracker = Tracker(dense_traffic_settings())
    for k in range(1, 196):
        cars = cars_at(0.1 * k, True)
        heading, n = [NORTH if x == 0.0 else EAST for x, _ in cars], len(cars)
        boxes = Boxes.of(["car"] * n, [(*car, 0.8) for car in cars], [[4.5, 1.8, 1.6]] * n, heading)
        tracks = tracker.step(Frame(0.1 * k, "lidar", Detections(boxes, np.full(n, 0.9))))
    plain, told = tracker.predict([1.0, 2.0]), tracker.predict([1.0, 2.0], hypotheses=True)
    assert [mode.name for mode in told.modes] == ["waits", "follows", "goes on", "stationary"]
    assert sum(mode.probability for mode in told.modes) == pytest.approx(np.ones((2, len(told))))
    assert np.array_equal(told.position, plain.position)
    assert np.array_equal(told.position_covariance, plain.position_covariance)
    south = np.argmin(np.abs(tracks.boxes.position[:, 0]))
    row = told.id.tolist().index(tracks.id[south])
    waits, _, goes, _ = told.modes
    assert waits.probability[0, row] > 0.3
    assert waits.position[1, row, 1] < goes.position[1, row, 1] - 1.0
    with pytest.raises(InputError, match="joint or hypotheses"):
        tracker.predict([1.0], joint=True, hypotheses=True)


def test_modes_know_rules_by_their_numbers_where_leaders_are_left_out():
    """Neighbours are judged by how well they predicted, whether they are the first rule or the last."""
    going = []
    for edges in ((Following(), Neighbours()), (Neighbours(), Following())):
        tracker = Tracker(replace(dense_traffic_settings(), edges=edges, edge_prior=0.5))
        for k in range(60):
            places = [(1.0 * k, 0.0, 0.8), (1.0 * k + 20.0 + 4.0 * np.sin(0.15 * k), 0.0, 0.8)]
            boxes = Boxes.of(["car"] * 2, places, [[4.5, 1.8, 1.6]] * 2, [EAST] * 2)
            tracker.step(Frame(0.1 * k, "lidar", Detections(boxes, np.full(2, 0.9))))
        going.append(next(mode for mode in tracker.predict([2.0], hypotheses=True).modes if mode.name == "goes on"))
    np.testing.assert_allclose(going[0].position, going[1].position, atol=1e-9)


def test_who_yields_goes_with_the_tracks_and_through_a_snapshot():
    tracker = Tracker(dense_traffic_settings())
    telling = [tracks for tracks in map(tracker.step, frames(20)) if len(tracks.relations)]
    assert telling
    for tracks in telling:
        assert np.isin([tracks.relations.source, tracks.relations.target], tracks.id).all()
        assert len(tracks.select(tracks.id == tracks.id[0]).relations) == 0
    other = Tracker(dense_traffic_settings())
    other.restore(tracker.snapshot())
    assert other.snapshot().right_of_way.probability == tracker.snapshot().right_of_way.probability
