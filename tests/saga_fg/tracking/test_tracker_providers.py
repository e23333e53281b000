"""Providers of factors in the tracker, nodes of the map by tiles, and predictions."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, Frame, InputError, Tracker, TrackerSettings
from saga_fg.estimators import GraphFilter, JointKalmanFilter
from saga_fg.estimators.reference import Gaussian, kalman_predict
from saga_fg.graph import EGO_POSE
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.map_rules import RedLight
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.map_nodes import Element, elements, in_known_names
from saga_fg.types.boxes import MAX_POSITION
from saga_fg.types.frame import Detection, Detections
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight, Wall
from tests.saga_fg.traffic_frames import frame, run, seen, straight


def test_providers_from_the_configuration():
    tracker = Tracker(TrackerSettings(estimator="isam2", providers=("saga_fg.providers:Odometry",)))
    tracker.step(frame(0.0, [(1, 0)]))
    assert EGO_POSE in {one.kind for one in tracker.running_graph.variables.values()}


def test_what_leads_to_no_provider_is_refused(subtests):
    with pytest.raises(
        InputError, match="providers: expected a factor provider with name, factors; it lacks name, factors, got int"
    ):
        Tracker(providers=[1])  # type: ignore[list-item]
    for name, message in [
        ("math:sqrt", "math:sqrt: cannot be made without arguments"),
        (
            "collections:Counter",
            "collections:Counter: expected a factor provider with name, factors; it lacks name, factors",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            Tracker(TrackerSettings(estimator="isam2", providers=(name,)))


# A road in several maps: elements that come again are known, others of a name that is taken get one of their own


def tile(x: float, prefix: str = "") -> RoadMap:
    """A crossing at x with the names that every tile uses."""
    return RoadMap(
        lights=(TrafficLight(f"{prefix}light", (x + 10.0, 0.0)),),
        stop_lines=(StopLine(f"{prefix}line", (x, 2.0), (x, -2.0), f"{prefix}light"),),
        lanes=(Lane(f"{prefix}lane", ((x - 50.0, 0.0), (x + 10.0, 0.0))),),
        walls=(Wall(f"{prefix}wall", ((x, 8.0), (x + 5.0, 8.0))),),
    )


def known(*maps: RoadMap) -> dict[str, Element]:
    return {each.name: each for road_map in maps for each in elements(road_map)}


def test_elements_are_known_by_place_and_class_and_others_get_names_of_their_own():
    named = in_known_names(tile(500.0), known(tile(0.0)))
    assert [each.name for each in elements(named)] == ["light (2)", "line (2)", "lane (2)", "wall (2)"]
    assert named.stop_lines[0].light == "light (2)"
    third = in_known_names(tile(1000.0), known(tile(0.0), named))
    assert third.lights[0].name == "light (3)"
    assert in_known_names(tile(500.4), known(tile(0.0), named)).lights[0].name == "light (2)"  # corrected
    first = tile(0.0, "west/")
    assert in_known_names(tile(0.0, "east/"), known(first)) == first
    twins = (TrafficLight("a", (0.0, 0.0)), TrafficLight("b", (0.0, 0.0)))  # two heads of one mast
    assert in_known_names(RoadMap(lights=twins), known(RoadMap(lights=twins))).lights == twins
    others = (TrafficLight("c", (0.0, 0.0)), TrafficLight("d", (0.0, 0.0)))
    assert in_known_names(RoadMap(lights=others), known(RoadMap(lights=twins))).lights == twins
    named = in_known_names(RoadMap(lanes=(Lane("light", ((9.0, 0.0), (11.0, 0.0))),)), known(tile(0.0)))
    assert named.lanes[0].name == "light (2)"


def test_lights_of_two_tiles_have_beliefs_of_their_own():
    """Red is reported at the second crossing, whose light has the name of the first one's."""
    settings = TrackerSettings(edges=(RedLight(),), road_map=tile(0.0))
    tracker = Tracker(settings, {"default": Sensor(colour_accuracy=0.9)})
    corrected = replace(tile(0.0), lights=(TrafficLight("light", (10.3, 0.0)),))
    for time, road_map in ((0.0, tile(300.0)), (0.1, corrected), (0.2, tile(0.0, "again/"))):
        red = Detections.of([Detection("traffic_light_red", (310.0, 0.0, 5.0))])
        tracker.step(Frame(time, "camera", red, road_map=road_map))
    nodes = tracker.map_nodes
    assert nodes.name == ("light", "line", "light (2)", "line (2)")
    assert nodes.light == ("light", "light", "light (2)", "light (2)")
    assert len(set(tracker.snapshot().traffic.lanes.points.id.tolist())) == 2  # that lead traffic, by the same names
    assert nodes.belief("light (2)")["red"] > 0.9 > 0.6 > nodes.belief("light")["red"]


# Predicting all tracks jointly: as stepping without detections, as the textbook, with edges that go on to act

HORIZONS = [0.5, 1.0, 2.0, 5.0]
LED = Following(interaction=SharedVelocity(along_heading=True), rate=1.0)
CLASSES = {
    "car": ClassSettings(motion=Curvilinear(turn_time=2.0), max_deviation=np.inf),
    "truck": ClassSettings(motion=ConstantAcceleration(0.5, fading_time=3.0), max_deviation=np.inf),
}


def braking(t):
    """A leader that brakes at 3 m/s^2 from 2 s on, a follower, and a car apart."""
    slowed = max(t - 2.0, 0.0)
    return np.array([[12 * t - 1.5 * slowed**2, 0.0], [12 * t - 14.0, 0.0], [5.0, 60.0]])


def followed(estimator="kalman", edges=(LED,), until=3.0, **values):
    """A tracker that has seen the traffic so far, boxes and headings included."""
    settings = TrackerSettings(CLASSES, edges=edges, estimator=estimator, **values)
    tracker = Tracker(settings, {"lidar": Sensor(noise={"default": NoiseModel(position=0.2)})})
    label = ["truck", "car", "car"]
    run(tracker, seen(np.random.default_rng(4), braking, np.arange(0, until, 0.1), label=label, yaw=0.02))
    return tracker


@pytest.mark.parametrize("stationary", [0.0, 0.5])
def test_a_prediction_is_what_frames_without_detections_would_lead_to(stationary):
    tracker = followed(stationary_share=stationary)
    now = tracker.step(frame(3.0, []))
    found = tracker.predict(HORIZONS)
    assert found.timestamp == 3.0
    assert found.times.tolist() == [found.timestamp + h for h in HORIZONS]
    assert (found.id.tolist(), found.label.tolist()) == (now.id.tolist(), now.boxes.label.tolist())
    expected = {h: tracker.step(frame(found.timestamp + h, [])) for h in np.arange(0.5, 5.1, 0.5)}
    for k, h in enumerate(HORIZONS):
        then = expected[h]
        assert found.position[k] == pytest.approx(then.boxes.position[:, :2], abs=1e-9)
        assert found.velocity[k] == pytest.approx(then.boxes.velocity, abs=1e-9)
        assert found.position_covariance[k] == pytest.approx(then.position_covariance, rel=1e-9)
        assert found.velocity_covariance[k] == pytest.approx(then.velocity_covariance, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "kind"), [("kalman", JointKalmanFilter), ("isam2", GraphFilter), ("fixed-lag", GraphFilter)]
)
def test_every_estimator_predicts_as_the_textbook(name, kind, monkeypatch):
    """With the recorded F, b and Q: means to 1e-9 standard deviations, the joint covariance to 1e-9 relative."""
    tracker, transitions = followed(name), []
    estimator, origin = tracker._state.joint.estimator, np.tile(tracker._state.origin, 3)
    x = Gaussian(estimator.joint_mean([1, 2, 3]), estimator.joint_covariance([1, 2, 3]))
    predict = kind.predict

    def recording(self, transition):
        transitions.append(transition)
        predict(self, transition)

    monkeypatch.setattr(kind, "predict", recording)
    found = tracker.predict(HORIZONS, joint=True)
    assert len(transitions) == 10
    places = np.array([0, 1, 6, 7, 12, 13])  # x, y of three states of six components
    for k, transition in enumerate(transitions):
        assert transition.nodes.tolist() == [1, 2, 3]
        x = kalman_predict(x, transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray())
        if (k + 1) / 2 in HORIZONS:
            row, P = HORIZONS.index((k + 1) / 2), x.covariance[np.ix_(places, places)]
            apart = found.position[row].ravel() - x.mean[places] - origin
            assert (np.abs(apart) / np.sqrt(np.diag(P))).max() < 1e-9
            assert np.linalg.norm(found.joint_covariance[row] - P) < 1e-9 * np.linalg.norm(P)


@pytest.mark.parametrize("stationary", [0.0, 0.5])
def test_joint_covariances_are_positive_definite_and_hold_those_of_each_track(stationary):
    tracker = followed(stationary_share=stationary)
    assert tracker.predict([1.0]).joint_covariance is None
    found = tracker.predict([0.0, *HORIZONS], joint=True)
    for P, own in zip(found.joint_covariance, found.position_covariance, strict=True):
        assert np.allclose(P, P.T, rtol=1e-12)
        assert np.linalg.eigvalsh(P).min() > 0
        for k in range(len(found)):
            assert P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] == pytest.approx(own[k])
    together = found.joint_covariance[-1]
    correlation = together[0, 2] / np.sqrt(together[0, 0] * together[2, 2])
    assert correlation > 0.3, "the follower does as its leader does"
    assert np.abs(together[:4, 4:]).max() < 1e-6, "the car apart is independent"


def test_edges_go_on_to_act_a_follower_slows_down_behind_a_braking_leader():
    alone, led = followed(edges=()).predict(HORIZONS), followed().predict(HORIZONS)
    assert alone.velocity[-1, 1, 0] > 10.5
    assert led.velocity[-1, 1, 0] < alone.velocity[-1, 1, 0] - 1.5
    assert led.position[-1, 1, 0] < alone.position[-1, 1, 0] - 5.0
    assert led.position_covariance[-1, 1, 0, 0] < alone.position_covariance[-1, 1, 0, 0]
    assert led.position[:, 2] == pytest.approx(alone.position[:, 2], abs=0.3)


def test_edges_are_those_of_the_graph_on_the_way():
    """A leader that draws away to beyond the reach of the rule acts no longer."""
    parting = straight([(0, 0), (-20, 0)], [(20, 0), (10, 0)])
    positions = []
    for max_gap in (18.0, 60.0):
        rule = replace(LED, max_gap=max_gap, gap_scale=np.inf)
        tracker = Tracker(TrackerSettings({"default": ClassSettings(motion=ConstantVelocity(1.0))}, edges=(rule,)))
        run(tracker, seen(np.random.default_rng(0), parting, np.arange(0, 0.4, 0.1), velocity=parting(1) - parting(0)))
        positions.append(tracker.predict([4.0]).position[0, 1, 0])
    assert positions[0] < positions[1] - 2.0


def test_headings_turn_with_the_velocity():
    def bend(t):
        return 30 * np.array([[np.sin(0.3 * t), 1 - np.cos(0.3 * t)]])

    tracker = Tracker(TrackerSettings({"default": ClassSettings(motion=Curvilinear(turn_time=5.0))}))
    run(tracker, [frame(t, bend(t), yaw=0.3 * t) for t in np.arange(0, 4, 0.1)])
    found = tracker.predict([0.0, 0.4, 1.0])
    assert found.yaw[0, 0] == pytest.approx(0.3 * 3.9, abs=0.05)
    assert (np.diff(found.yaw[:, 0]) > 0.02).all()
    course = np.arctan2(found.velocity[:, 0, 1], found.velocity[:, 0, 0])
    assert np.diff(found.yaw[:, 0]) == pytest.approx(np.diff(course), abs=1e-6)


def test_only_what_is_reported_is_predicted_and_what_can_be():
    settings = TrackerSettings(edges=(), min_hits=2, tentative_score_factor=0.0)
    tracker, far = Tracker(settings), MAX_POSITION - 20.0
    run(tracker, [frame(0.1 * k, [(far + 0.4 * k, 0), (far, 80)], velocity=((4, 0), (0, 0))) for k in range(4)])
    tracker.step(frame(0.4, [(far + 1.6, 0), (far, 80), (far, 40)]))
    assert tracker.predict([0.0]).id.tolist() == [1, 2]
    found = tracker.predict([1.0, 30.0], joint=True)
    assert found.id.tolist() == [2]
    assert found.position.shape == (2, 1, 2)
    assert found.joint_covariance.shape == (2, 2, 2)


def test_without_tracks_frames_or_horizons_nothing_is_predicted(subtests):
    tracker = Tracker()
    with pytest.raises(InputError, match="predict: expected a frame before"):
        tracker.predict([1.0])
    tracker.step(frame(0.0, []))
    found = tracker.predict([1.0, 2.0], joint=True)
    assert len(found) == 0
    assert found.position.shape == (2, 0, 2)
    assert found.joint_covariance.shape == (2, 0, 0)
    for horizons in [[], [-1.0], [1.0, np.nan], [np.inf], [2.0, 1.0], [1.0, 1.0], [61.0], 1.0, [[1.0]], ["soon"], None]:
        with subtests.test(horizons=horizons):
            tracker = followed(until=0.5)
            with pytest.raises(InputError, match=r"horizons.*: expected"):
                tracker.predict(horizons)
            with pytest.raises(InputError, match="horizons: expected a list of seconds"):
                tracker.predict(1.0)
