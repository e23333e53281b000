"""The tracker with its graph: edges, estimators, several sensors on one place, states that are kept."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import (
    ConstantAcceleration,
    ConstantVelocity,
    InputError,
    Sensor,
    Tracker,
    TrackerSettings,
)
from saga_fg.model.edge_rules import Neighbours, Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.sensor import FieldOfView, NoiseModel
from saga_fg.tracking import AssociationSettings, ClassSettings, ExistenceSettings
from tests.saga_fg.traffic_frames import assert_estimators_agree, assert_same, columns, frame, run, seen, straight

PATIENT = {
    "classes": {"default": ClassSettings(motion=ConstantVelocity(1.0), max_deviation=np.inf)},
    "max_coasting": 10.0,
}


def braking_platoon(t, n=4, gap=14.0):
    """Four cars one behind the other that brake together, from 12 m/s by 2 m/s^2 between 3 and 7 s."""
    braking = np.clip(t - 3.0, 0.0, 4.0)
    ahead = 12.0 * t - braking**2 - 8.0 * max(0.0, t - 7.0)
    return np.stack([ahead - gap * np.arange(n), np.zeros(n)], axis=-1)


def test_a_node_that_dies_leaves_its_information_and_its_neighbours():
    tracker = Tracker(TrackerSettings(association=AssociationSettings(relink_above=1.0)))
    run(tracker, seen(np.random.default_rng(0), braking_platoon, np.arange(0, 2, 0.1)))
    rest = lambda t: braking_platoon(t)[[0, 2, 3]]  # noqa: E731
    history = run(tracker, seen(np.random.default_rng(1), rest, np.arange(2, 5, 0.1)))
    assert history[-1].id.tolist() == [1, 3, 4]
    assert tracker.graph.nodes.tolist() == [1, 3, 4]


class Chain:
    """A user's rule: everyone is pulled by the node before it in the table, whatever it is."""

    interaction = SharedVelocity()

    def __init__(self, rate):
        self.rate = rate
        self.asked = 0

    def pairs(self, nodes):
        self.asked += 1
        n = len(nodes)
        return Pairs(np.arange(1, n), np.arange(n - 1), np.full(n - 1, self.rate))


class Broken:
    interaction = SharedVelocity()

    def pairs(self, nodes):
        return Pairs(np.array([0]), np.array([99]), np.array([1.0]))


def test_a_users_rule_takes_the_place_of_the_settings():
    rule = Chain(rate=0.3)
    tracker = Tracker(TrackerSettings(edges=(rule,)))
    run(tracker, seen(np.random.default_rng(0), straight([(0, 0), (30, 40)], [(9, 0), (0, 0)]), np.arange(0, 2, 0.1)))
    assert rule.asked > 10
    assert [(g.interaction, g.target.tolist(), g.source.tolist()) for g in tracker.graph.edges] == [
        ("SharedVelocity", [1], [0])
    ]
    now, later = (tracker.tracks(t).boxes.velocity[1, 0] for t in (1.9, 2.4))
    assert later > now + 0.5, "the second object is at rest, but pulled along by the first"


def test_a_coasting_track_that_hardly_exists_has_no_edges():
    classes = {"default": ClassSettings(min_score=0.0, initiation_score=0.0)}
    rules = (Chain(rate=0.3),)
    doubtful = TrackerSettings(classes, edges=rules, existence=ExistenceSettings(delete_below=0.0))
    tracker, places = Tracker(doubtful), [(0.0, 0.0), (30.0, 40.0), (60.0, 0.0)]
    tied = []
    for k, score in enumerate((0.09, None, 0.9, 0.9)):
        detected = places[1:] if score is None else places
        tracker.step(frame(0.1 * k, detected, score=[score or 0.9, 0.9, 0.9][-len(detected) :]))
        tied.append([(g.target.tolist(), g.source.tolist()) for g in tracker.graph.edges] if tracker.graph else [])
    assert tied == [[], [([1, 2], [0, 1])], [([2], [1])], [([1, 2], [0, 1])]]


def test_a_rule_that_makes_no_sense_is_named_and_nothing_has_happened():
    broken, untouched = (Tracker(TrackerSettings(edges=rules)) for rules in ((Broken(),), ()))
    run(untouched, seen(np.random.default_rng(0), braking_platoon, np.arange(0, 1, 0.1)))
    broken.restore(untouched.snapshot())
    later = frame(1.0, braking_platoon(1.0))
    with pytest.raises(InputError, match="edge rule Broken: source: row 99 is outside 4 nodes"):
        broken.step(later)
    with pytest.raises(InputError, match="edge rule Broken"):
        broken.tracks(1.5)
    again = Tracker(TrackerSettings(edges=()))
    again.restore(broken.snapshot())
    assert columns(again.step(later)) == columns(untouched.step(later))


def braking_behind_a_wall(method, estimator="kalman", gap=4.5):
    """Ids of five cars before and after they pass behind a wall, where all of them brake."""
    rng = np.random.default_rng(0)
    edges = (Neighbours(rate=1.0, distance_scale=20.0, speed_scale=np.inf),)
    association = AssociationSettings(method=method, clutter_area=1e4)
    far = {"default": ClassSettings(motion=ConstantVelocity(10.0), max_deviation=np.inf, max_distance=15.0)}
    told = PATIENT | {"classes": far}
    tracker = Tracker(TrackerSettings(edges=edges, association=association, estimator=estimator, **told))
    ids = []
    for t in np.arange(0.0, 5.21, 0.2):
        if 3.1 < t < 5.1:
            continue
        position = braking_platoon(t, n=5, gap=gap) + 0.1 * rng.normal(size=(5, 2))
        tracks = tracker.step(frame(t, position))
        tracks = tracks.select(tracks.coasting == 0)
        ids.append(tracks.id[np.argsort(-tracks.boxes.position[:, 0])].tolist())
    return ids[-2], ids[-1]


def test_a_group_that_braked_unseen_keeps_its_identities_by_its_shape():
    before, after = braking_behind_a_wall("hungarian")
    assert after != before, "the test would show nothing"
    for estimator in ("kalman", "isam2", "fixed-lag"):
        before, after = braking_behind_a_wall("graph", estimator)
        assert after == before == [1, 2, 3, 4, 5]


# The tracker on each estimator: the same tracks; and on the fixed-lag smoother, late frames where they belong

CLASSES = {
    "car": ClassSettings(motion=ConstantVelocity(1.0), gate=1 - 1e-7),
    "truck": ClassSettings(motion=ConstantAcceleration(0.5, fading_time=3.0), gate=1 - 1e-7),
}
SENSORS = {
    "lidar": Sensor(noise={"default": NoiseModel(position=0.4, velocity=0.5)}),
    "camera": Sensor(noise={"default": NoiseModel(position=0.2)}),
}
LABEL = ["car", "truck", "car", "car"]
TRUTH = straight([(0, 0), (-15, 0.3), (-30, 0), (5, 40)], [(12, 0), (12, 0), (11, 0), (0, -9)])


def tracker(estimator="kalman", **values):
    """Without bounds, so that all estimators are exact."""
    return Tracker(TrackerSettings(CLASSES, estimator=estimator, tolerance=0.0, **values), SENSORS)


def traffic(seed, late=0.0):
    """Frames in order of time; and in order of arrival, the camera's `late` s after they were taken."""
    rng = np.random.default_rng(seed)
    heading = [0.0, 0.0, 0.0, -np.pi / 2]
    lidar = seen(rng, TRUTH, np.arange(0, 4, 0.1), noise=0.3, label=LABEL, yaw=heading, velocity=TRUTH(1) - TRUTH(0))
    camera = seen(rng, TRUTH, np.arange(1.03, 3.4, 0.08), noise=0.15, sensor="camera", label=LABEL, yaw=heading)
    gone = [f for f in lidar if f.timestamp < 3.45]
    lost = [frame(f.timestamp, TRUTH(f.timestamp)[:3], label=LABEL[:3]) for f in lidar if f.timestamp >= 3.45]
    arrivals = [(f.timestamp, f) for f in [*gone, *lost]] + [(f.timestamp + late, f) for f in camera]
    in_order = sorted((f for _, f in arrivals), key=lambda f: f.timestamp)
    return in_order, [f for _, f in sorted(arrivals, key=lambda arrival: arrival[0])]


def test_every_estimator_gives_the_same_tracks(subtests):
    """New tracks, a deletion, two sensors, two motion models, frames as late as the filters take."""
    for edges in [(), TrackerSettings().edges]:
        with subtests.test(edges=str(edges)):
            assert_estimators_agree(TrackerSettings(CLASSES, tolerance=0.0, edges=edges), SENSORS, traffic(0)[0])


@pytest.mark.parametrize("delay", [0.07, 0.9])
def test_a_smoother_takes_late_frames_as_if_they_had_come_in_time(delay):
    """States of independent objects, and so with frozen edges, do not depend on the order of arrival."""
    in_order, arriving = traffic(2, delay)
    prompt, late, without = (tracker("fixed-lag", edges=(), lag=2.0) for _ in range(3))
    run(prompt, in_order)
    run(late, arriving)
    run(without, [f for f in arriving if f.sensor == "lidar"])
    assert late.late_frames == 0
    first, second = prompt.tracks(4.5), late.tracks(4.5)
    assert_same(first, replace(second, score=first.score))  # scores are told in the order of arrival
    assert np.abs(prompt.tracks(4.5).boxes.position - without.tracks(4.5).boxes.position).max() > 0.01


# Several sensors at once: who may start a track, what scores add up to, and sensors that fall silent

WEAK = {"camera": Sensor(initiation="confirmed", noise={"default": NoiseModel(position=0.5)})}
TENTHS = np.arange(0, 2, 0.1)


def independent(**values):
    return TrackerSettings(edges=(), **values)


def test_a_weak_sensor_needs_repeated_evidence_or_another_sensor():
    tracker = Tracker(independent(), WEAK)
    reported = [len(t) for t in run(tracker, [frame(t, (10.0, 0.0), "camera") for t in TENTHS[:6]])]
    assert reported == [0, 0, 1, 1, 1, 1]
    tracker = Tracker(independent(tentative_score_factor=0.25), WEAK)
    scores = [t.score.tolist() for t in run(tracker, [frame(t, (10.0, 0.0), "camera", score=0.8) for t in TENTHS[:3]])]
    assert scores == [[pytest.approx(0.2)], [pytest.approx(0.2)], [pytest.approx(0.8)]]
    tracker = Tracker(independent(), WEAK)
    frames = [frame(0.0, (10.0, 0.0), "camera"), frame(0.05, (10.0, 0.0), "lidar"), frame(0.1, (10.0, 0.0), "camera")]
    assert [t.id.tolist() for t in run(tracker, frames)] == [[], [1], [1]]
    assert len(Tracker(independent(), WEAK).step(frame(0.0, (10.0, 0.0), "lidar"))) == 1


def test_what_a_better_sensor_overlooks_counts_only_while_that_does_not_look():
    narrow, here = Sensor(field_of_view=FieldOfView(max_range=30.0)), {"world_T_ego": np.eye(4)}
    for place, counts in (((10.0, 0.0), False), ((40.0, 0.0), True)):
        tracker = Tracker(independent(), {**WEAK, "lidar": narrow})
        times = TENTHS[:10]
        both = [f for t in times for f in (frame(t, [], **here), frame(t + 0.01, place, "camera", **here))]
        assert bool(len(run(tracker, both)[-1])) == counts, place
        silent = [frame(t, place, "camera", **here) for t in np.arange(1.0, 5.0, 0.1)]
        assert len(run(tracker, silent)[-1]) == 1, "nobody else has looked for long"
    tracker = Tracker(independent(), WEAK)
    assert len(run(tracker, [frame(0.0, [], **here), frame(0.01, (10.0, 0.0), "camera", **here)])[-1]) == 0
    assert len(tracker.step(frame(0.1, (10.0, 0.0), **here))) == 1, "the other sensor confirms it"
