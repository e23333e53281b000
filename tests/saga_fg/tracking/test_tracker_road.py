"""The tracker on scenes of more than cars: what nodes of other kinds are worth, and that they keep to the rules."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Detection, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.model.edge_rules import Following, Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.lanes import ConeLine, InLane
from saga_fg.model.motion import ConstantVelocity, RandomWalk
from saga_fg.model.nonlinear_interactions import SmoothDriver
from saga_fg.model.rigid_coupling import Attached
from saga_fg.model.stop_lines import GreenLight, RedLight
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.prediction import node_table
from saga_fg.types.road_map import COLOURS, Lane, RoadMap, StopLine, TrafficLight, colours

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
    for frame in frames:
        tracker.step(frame)
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


def test_two_vehicles_tell_more_than_one():
    one, two = (believed(light_frames(lambda time: 3.0, road_map=wide(width), width=width)) for width in (1, 2))
    assert two["red"] + two["amber"] > one["red"] + one["amber"]


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


def test_hidden_vehicles_tell_nothing():
    """A car that is no longer seen is expected to brake for what may be red; that is no evidence of red."""
    seen = believed(light_frames(lambda time: 45 - 8 * time, 1.0))
    hidden = believed(light_frames(lambda time: 45 - 8 * time, 3.0, hidden_from=1.0))
    later = SETTINGS.signals.predicted(np.array([[seen["red"], seen["amber"], 0.0, seen["green"]]]), 2.0)[0]
    assert hidden["red"] == pytest.approx(later[0], abs=0.05)


def test_colours_are_inferred_alike_by_every_estimator_and_after_a_restart():
    frames = list(light_frames(brakes, 2.0))
    exact = replace(SETTINGS, tolerance=0.0)
    one = tracked(frames, exact)
    for name in ("isam2", "fixed-lag"):
        other = tracked(frames, replace(exact, estimator=name))
        assert other.map_nodes.belief("light") == pytest.approx(one.map_nodes.belief("light"), abs=1e-6)
    first = tracked(frames[:10], exact)
    continued = pickle.loads(pickle.dumps(first))
    for frame in frames[10:]:
        continued.step(frame)
    assert continued.map_nodes.belief("light") == one.map_nodes.belief("light")


def test_elements_of_the_map_that_no_rule_reads_are_no_nodes():
    frames = list(queue_frames(duration=0.5))
    for edges, labels in (
        ((FOLLOW,), set()),
        ((RedLight(),), {"traffic_light", "stop_line"}),
        ((InLane(),), {"lane"}),
        ((OwnRule(),), {"traffic_light", "stop_line", "lane"}),
    ):
        tracker = Tracker(replace(SETTINGS, edges=()), SENSORS, rules=edges)
        for frame in frames:
            tracker.step(frame)
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
    one = tracked(frames, exact)
    other = tracked(frames, replace(exact, estimator=estimator))
    for horizon in (0.0, 1.0):
        a, b = one.tracks(1.4 + horizon), other.tracks(1.4 + horizon)
        assert a.id.tolist() == b.id.tolist()
        assert np.allclose(a.boxes.position, b.boxes.position, atol=1e-6)
        assert np.allclose(a.position_covariance, b.position_covariance, rtol=1e-6, atol=1e-9)


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


def test_a_map_may_be_of_lanes_alone():
    only = RoadMap(lanes=MAP.lanes)
    tracker = tracked([replace(frame, road_map=only) for frame in queue_frames(duration=1.0)])
    assert len(tracker.map_nodes) == 1
    assert {edges.interaction for edges in tracker.graph.edges} == {"KeepLane", "SharedVelocity"}


def test_without_edges_the_roadside_changes_nothing():
    plain = replace(SETTINGS, edges=(), max_step=np.inf)
    frames = list(queue_frames())
    alone = tracked([replace(frame, road_map=None) for frame in frames], plain)
    beside = tracked(frames, plain)
    assert np.array_equal(alone.tracks(4.0).boxes.position, beside.tracks(4.0).boxes.position)
