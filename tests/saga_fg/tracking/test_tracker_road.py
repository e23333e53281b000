"""Maps in the tracker, and the speeds of traffic as a prior."""

import pickle
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Detection, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.errors import InputError
from saga_fg.model.edge_rules import Attached, Following, Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.map_rules import ConeLine, GreenLight, InLane, RedLight
from saga_fg.model.motion import ConstantVelocity, RandomWalk
from saga_fg.model.nonlinear_interactions import SmoothDriver
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.prediction import node_table
from saga_fg.tracking.traffic import SPREAD, Passages, SpeedPriorSettings, Traffic, TrafficSettings, speed_prior
from saga_fg.types.road_map import COLOURS, Lane, RoadMap, StopLine, TrafficLight, colours
from saga_fg.types.track import known_velocities
from tests.saga_fg.traffic_frames import assert_same, frame

MAP = RoadMap(
    (TrafficLight("light", (12.0, 0.0)),),
    (StopLine("line", (0.0, 1.75), (0.0, -1.75), "light"),),
    (Lane("lane", ((-200.0, 0.0), (50.0, 0.0))),),
)
FOLLOW = Following(interaction=SharedVelocity(), rate=1.0, max_gap=40)
EDGES = (RedLight(), GreenLight(), InLane(), ConeLine(), Attached(), replace(FOLLOW, cones=True))
SETTINGS = TrackerSettings(
    classes={
        "default": ClassSettings(motion=ConstantVelocity(acceleration_noise=0.5), max_deviation=np.inf),
        "traffic_cone": ClassSettings(motion=RandomWalk()),
    },
    edges=EDGES,
    max_step=0.25,
)
SENSORS = {"default": Sensor(colour_accuracy=0.9)}


def queue_frames(colour="red", duration=3.0, known=True, seed=0, accuracy=1.0):
    """Two cars at 9 m/s, the first 50 m before the line at the start; the light shows a colour, at times another."""
    rng = np.random.default_rng(seed)
    for time in np.arange(0, duration, 0.1):
        cars = [Detection("car", (x + 9 * time + rng.normal(0, 0.05), rng.normal(0, 0.05), 0.8), (4.5, 1.8, 1.5), 0.0)
                for x in (-55.0, -70.0)]  # fmt: skip
        shown = colour if rng.random() < accuracy else str(rng.choice(["red", "amber", "green"]))
        cars.append(Detection(f"traffic_light_{shown}", (12.0, rng.normal(0, 0.1), 5.0)))
        yield Frame(float(time), "camera", Detections.of(cars), road_map=MAP if known else None)


def tracked(frames, settings=SETTINGS):
    tracker = Tracker(settings, SENSORS)
    for each in frames:
        tracker.step(each)
    return tracker


def speeds_at(tracker, timestamp):
    later = tracker.tracks(timestamp)
    return dict(zip(later.id.tolist(), later.boxes.velocity[:, 0].tolist(), strict=True))


def test_cars_are_expected_to_brake_for_a_red_light_one_after_the_other():
    """They have not begun to: all that is known of it comes from the light."""
    red, green = (speeds_at(tracked(queue_frames(colour)), 4.9) for colour in ("red", "green"))
    assert green[1] == pytest.approx(9.0, abs=0.5)
    assert red[1] < green[1] - 2.0
    assert red[1] < red[2] < green[2] - 0.3


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_drivers_without_corners_brake_for_a_red_light_one_after_the_other(estimator):
    edges = RedLight(), replace(FOLLOW, interaction=SmoothDriver(), lateral_scale=3.0)
    settings = replace(SETTINGS, edges=edges, estimator=estimator, max_coasting=20.0)
    red, green = (tracked(queue_frames(colour, duration=2.0), settings) for colour in ("red", "green"))
    assert speeds_at(red, 4.9)[1] < speeds_at(green, 4.9)[1] - 2.0
    assert speeds_at(red, 4.9)[2] < speeds_at(green, 4.9)[2] - 1.0
    stopped = red.tracks(9.9)
    assert stopped.boxes.position[:, 0].max() < 0.0
    assert np.abs(stopped.boxes.velocity).max() < 2.0  # the second one still closes up


def test_the_light_is_believed_by_noisy_reports():
    tracker = tracked(queue_frames("red", accuracy=0.85))
    assert tracker.map_nodes.belief("light")["red"] > 0.95
    far = tracker.snapshot()
    tracker.tracks(63.0)
    assert tracker.map_nodes.belief("light")["red"] > 0.95
    for timestamp in (60.0, 60.1):
        tracker.step(Frame(timestamp, "camera", Detections.empty()))
    assert tracker.map_nodes.belief("light")["red"] < 0.6
    tracker.restore(far)
    assert tracker.map_nodes.belief("light")["red"] > 0.95


def light_frames(move, duration=3.0, seed=0, road_map=MAP, hidden_from=np.inf, width=1):
    """Cars whose fronts are `move(time)` m before the line, side by side; nobody reports the light."""
    rng = np.random.default_rng(seed)
    for time in np.arange(0, duration, 0.1):
        places = [(-move(time) - 2.25 + rng.normal(0, 0.05), 3.5 * k + rng.normal(0, 0.05), 0.8) for k in range(width)]
        cars = [Detection("car", place, (4.5, 1.8, 1.5), 0.0) for place in places]
        yield Frame(float(time), "lidar", Detections.of(cars if time < hidden_from else []), road_map=road_map)


def brakes(time):
    return 40 - 10 * min(time, 3.0) + 5 * max(0, min(time, 3.0)) ** 2 / 3


def believed(frames, light="light", settings=SETTINGS):
    return tracked(frames, settings).map_nodes.belief(light)


def test_an_unreported_light_is_believed_by_who_stops_and_who_goes():
    before = dict(zip(COLOURS, colours(SETTINGS.signals.stationary), strict=True))
    halted = believed(light_frames(lambda time: 3.0))
    braking = believed(light_frames(lambda time: 30 - 10 * time + 2.0 * time**2 / 2, 2.5))
    passing = believed(light_frames(lambda time: 32 - 12 * time, 2.5))
    starting = believed(light_frames(lambda time: 3.0 - max(0, time - 2) ** 2, 4.0))
    assert halted["red"] > 0.7 > before["red"]
    assert braking["red"] > 0.7
    assert passing["green"] > before["green"] + 0.15
    assert starting["green"] > before["green"] + 0.15


def test_two_vehicles_tell_more_than_one_and_hidden_ones_nothing():
    one, two = (believed(light_frames(lambda time: 3.0, road_map=wide(width), width=width)) for width in (1, 2))
    assert two["red"] + two["amber"] > one["red"] + one["amber"]
    # A car that is no longer seen is expected to brake for what may be red; that is no evidence of red.
    seen = believed(light_frames(lambda time: 45 - 8 * time, 1.0))
    hidden = believed(light_frames(lambda time: 45 - 8 * time, 3.0, hidden_from=1.0))
    later = SETTINGS.signals.predicted(np.array([[seen["red"], seen["amber"], 0.0, seen["green"]]]), 2.0)[0]
    assert hidden["red"] == pytest.approx(later[0], abs=0.05)


def wide(lanes):
    line = StopLine("line", (0.0, 3.5 * lanes - 1.75), (0.0, -1.75), "light")
    return RoadMap(MAP.lights, (line,))


def test_all_lines_of_a_light_gain_and_those_of_others_do_not():
    lights = (*MAP.lights, TrafficLight("other", (40.0, 40.0)))
    lines = (
        *MAP.stop_lines,
        StopLine("across", (12.0, -1.75), (12.0, 1.75), "light"),
        StopLine("far", (80.0, 1.75), (80.0, -1.75), "other"),
    )
    tracker = tracked(light_frames(lambda time: 3.0, road_map=RoadMap(lights, lines)))
    closed = dict(
        zip(tracker.map_nodes.name, node_table(tracker._state).closed[-len(tracker.map_nodes) :], strict=True)
    )
    assert closed["line"] == closed["across"] > 0.75 > closed["far"]


def test_colours_are_inferred_alike_by_every_estimator_and_after_a_restart():
    frames = list(light_frames(brakes, 2.0))
    exact = replace(SETTINGS, tolerance=0.0)
    one = tracked(frames, exact)
    for name in ("isam2", "fixed-lag"):
        other = tracked(frames, replace(exact, estimator=name))
        assert other.map_nodes.belief("light") == pytest.approx(one.map_nodes.belief("light"), abs=1e-6)
    first = tracked(frames[:10], exact)
    continued = pickle.loads(pickle.dumps(first))
    for each in frames[10:]:
        continued.step(each)
    assert continued.map_nodes.belief("light") == one.map_nodes.belief("light")


def test_elements_of_the_map_that_no_rule_reads_are_no_nodes():
    frames = list(queue_frames(duration=0.5))
    for edges, labels in (
        ((FOLLOW,), set()),
        ((RedLight(),), {"traffic_light", "stop_line"}),
        ((InLane(),), {"lane"}),
        ((OwnRule(),), {"traffic_light", "stop_line", "lane"}),
    ):
        tracker = Tracker(replace(SETTINGS, edges=edges), SENSORS)
        for each in frames:
            tracker.step(each)
        assert set(tracker.map_nodes.label.tolist()) == labels


class OwnRule:
    interaction = SharedVelocity()

    def pairs(self, nodes):
        return Pairs(np.empty(0, dtype=int), np.empty(0, dtype=int), np.empty(0))


def test_colours_are_no_tracks_and_without_a_map_no_nodes():
    for known in (True, False):
        tracker = tracked(queue_frames(known=known))
        assert sorted(set(tracker.tracks(0).boxes.label.tolist())) == ["car"]
        assert len(tracker.map_nodes) == (3 if known else 0)


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_every_estimator_tracks_the_road_alike(estimator):
    """All estimators give equal tracks of equal frames, map nodes and cones included; no frame is late."""
    frames = [
        replace(f, detections=Detections.concatenate([f.detections, cones()])) for f in queue_frames(duration=1.5)
    ]
    exact = replace(SETTINGS, tolerance=0.0)
    one, other = (tracked(frames, replace(exact, estimator=name)) for name in ("kalman", estimator))
    for time in (1.4, 2.4):
        assert_same(one.tracks(time), other.tracks(time), 1e-6)


def cones():
    places = [(-30.0 + 4 * k, -3.0 + 0.5 * k) for k in range(6)]
    return Detections.of([Detection("traffic_cone", (*place, 0.4), (0.4, 0.4, 0.8), 0.0) for place in places])


def test_the_map_is_corrected_by_what_is_seen():
    """The map has the light half a metre off; what the camera sees of it moves its node."""
    wrong = replace(MAP, lights=(TrafficLight("light", (12.0, 0.5)),), deviation=0.5)
    frames = [replace(frame, road_map=wrong) for frame in queue_frames()]
    tracker = tracked(frames)
    light = tracker.map_nodes.id[tracker.map_nodes.label == "traffic_light"]
    position, _, P, _ = tracker._state.joint.kinematics_of(light, np.array(["traffic_light"]))
    assert position[0, 1] + tracker._state.origin[1] == pytest.approx(0.0, abs=0.15)
    assert P[0, 1, 1] < 0.1


def test_cones_stand_still_and_push():
    rng = np.random.default_rng(1)
    tracker = Tracker(SETTINGS, SENSORS)
    for time in np.arange(0, 3, 0.1):
        car = Detection("car", (-60 + 10 * time, rng.normal(0, 0.05), 0.8), (4.5, 1.8, 1.5), 0.0)
        tracker.step(Frame(float(time), "lidar", Detections.concatenate([Detections.of([car]), cones()])))
    tracks = tracker.tracks(4.5)
    standing = tracks.select(tracks.boxes.label == "traffic_cone")
    assert np.array_equal(standing.boxes.velocity, np.zeros((6, 2)))
    car = tracks.select(tracks.boxes.label == "car")
    assert car.boxes.position[0, 1] > 0.3  # type: ignore[attr-defined]
    assert car.boxes.velocity[0, 1] > 0.3  # type: ignore[attr-defined]


def test_a_hidden_trailer_brakes_with_its_truck():
    def error(edges):
        tracker = Tracker(replace(SETTINGS, edges=edges), SENSORS)
        x, speed = 0.0, 15.0
        for k in range(50):
            speed -= 0.3 if k >= 40 else 0.0
            x += speed * 0.1
            seen = [Detection("truck", (x, 0, 1.5), (7.0, 2.5, 3.0), 0.0)]
            if k < 40:
                seen.append(Detection("trailer", (x - 8.0, 0, 1.5), (8.0, 2.5, 3.0), 0.0))
            tracks = tracker.step(Frame(k / 10, "lidar", Detections.of(seen)))
        return abs(float(tracks.boxes.position[tracks.boxes.label == "trailer", 0][0]) - (x - 8.0))

    assert error((Attached(),)) < 0.4 * error(())


def test_a_map_may_come_in_the_settings_or_bit_by_bit():
    settings = replace(SETTINGS, road_map=MAP)
    frames = list(queue_frames(known=False))
    in_settings, in_frames = tracked(frames, settings), tracked(queue_frames())
    assert np.allclose(in_settings.tracks(3.5).boxes.position, in_frames.tracks(3.5).boxes.position)
    more = RoadMap(lanes=(Lane("other", ((0.0, 3.5), (50.0, 3.5))),))
    in_settings.step(Frame(3.1, "camera", Detections.empty(), road_map=more))
    assert len(in_settings.map_nodes) == 4


def test_maps_may_be_partial_and_change_nothing_without_edges():
    only = RoadMap(lanes=MAP.lanes)
    tracker = tracked([replace(frame, road_map=only) for frame in queue_frames(duration=1.0)])
    assert len(tracker.map_nodes) == 1
    assert {edges.interaction for edges in tracker.graph.edges} == {"KeepLane", "SharedVelocity"}
    plain = replace(SETTINGS, edges=(), max_step=np.inf)
    frames = list(queue_frames())
    alone = tracked([replace(frame, road_map=None) for frame in frames], plain)
    beside = tracked(frames, plain)
    assert np.array_equal(alone.tracks(4.0).boxes.position, beside.tracks(4.0).boxes.position)


# Speeds of new tracks from the traffic around them

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


def test_neighbours_give_the_mean_and_the_doubt_of_their_mixture():
    mean, variance = speed_at(remembering(passages([(0, 0)], [0.0], [12.0])))
    assert mean == pytest.approx(5 * 12 / 6)
    assert variance == pytest.approx((25 + 5 * (144 + 0.1 + SPREAD**2)) / 6 - mean**2)
    agreed = speed_at(remembering(passages([(5, 0), (-5, 0)], [0, 0], [12, 12])))
    split = speed_at(remembering(passages([(5, 0), (-5, 0)], [0, 0], [0, 24])))
    assert split[0] == pytest.approx(agreed[0])
    assert split[1] > agreed[1] + 50


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


def test_standing_neighbours_say_that_a_new_one_stands_and_nothing_of_its_speed_if_not():
    both = remembering(passages([(0, 0), (0, 0)], [0, 0], [12, 0.3], standing=[0.0, 1.0]))
    standing, mean, variance = expected_at(both, 0.4)
    assert standing == pytest.approx((0.4 + 5) / 11)
    assert mean == pytest.approx(5 * 12 / 5.6)
    assert variance == pytest.approx((0.6 * 25 + 5 * (144 + 0.1 + SPREAD**2)) / 5.6 - mean**2)
    assert expected_at(remembering(), 0.4) == pytest.approx((0.4, 0.0, 25.0))


def test_a_track_counts_once_and_is_forgotten_after_a_while():
    once = remembering(passages([(1, 0)], [0.0], [12.0]))
    often = remembering(*(passages([(1 + 5 * k, 0)], [0.0], [12.0 + k], time=-0.1 * k, ids=[0]) for k in (3, 2, 1, 0)))
    assert speed_at(often) == pytest.approx(speed_at(once))
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


def test_newcomers_start_at_the_speed_of_their_leader_and_in_doubt():
    on = behind_a_leader(TrackerSettings(edges=(), traffic=ON))
    off = behind_a_leader(TrackerSettings(edges=()))
    assert off.boxes.velocity[1] == pytest.approx([0.0, 0.0])
    assert on.boxes.velocity[1] == pytest.approx([9.0, 0.0], abs=1.5)
    assert np.trace(on.velocity_covariance[1]) > 10, "it may be parked all the same"
    np.testing.assert_array_equal(on.boxes.position[0], off.boxes.position[0])
    newcomer = behind_a_leader(TrackerSettings(edges=()))
    assert newcomer.id.tolist() == [1, 2]
    known = np.isfinite(known_velocities(newcomer.boxes.velocity, newcomer.velocity_covariance))
    assert known.all(axis=1).tolist() == [True, False]
