"""The tracker and its graph: what the edges are good for, and what happens without."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Detections, Frame, InputError, Tracker, TrackerSettings
from saga_fg.model.edge_rules import Following, Neighbours, Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.tracking import AssociationSettings, ClassSettings, ExistenceSettings
from tests.saga_fg.traffic_frames import columns, frame, run, seen, straight

PATIENT = {
    "classes": {"default": ClassSettings(motion=ConstantVelocity(1.0), max_deviation=np.inf)},
    "max_coasting": 10.0,
    "max_out_of_view": 10.0,
}


def braking_platoon(t, n=4, gap=14.0):
    """Four cars one behind the other that brake together, from 12 m/s by 2 m/s^2 between 3 and 7 s."""
    braking = np.clip(t - 3.0, 0.0, 4.0)
    ahead = 12.0 * t - braking**2 - 8.0 * max(0.0, t - 7.0)
    return np.stack([ahead - gap * np.arange(n), np.zeros(n)], axis=-1)


def hidden_car_error(edges, seed, hidden=2, since=3.5, until=6.5):
    """Distance of the third car's track from the car when it has been hidden while all were braking."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(TrackerSettings(edges=edges, **PATIENT))
    for t in np.arange(0.0, until, 0.1):
        position = braking_platoon(t) + 0.1 * rng.normal(size=(4, 2))
        visible = np.ones(4, dtype=bool)
        visible[hidden] = t < since
        tracks = tracker.step(frame(t, position[visible]))
    assert tracks.id.tolist() == [1, 2, 3, 4]
    return float(np.linalg.norm(tracks.boxes.position[hidden, :2] - braking_platoon(tracks.timestamp)[hidden]))


def test_a_hidden_member_of_a_platoon_is_carried_by_those_still_seen():
    with_graph = np.mean([hidden_car_error((Following(), Neighbours()), seed) for seed in range(5)])
    without = np.mean([hidden_car_error((), seed) for seed in range(5)])
    assert without > 5.0, "the test would show nothing"
    assert with_graph < 0.5 * without


def test_the_hidden_member_knows_that_it_is_less_certain_than_its_neighbours():
    tracker = Tracker(TrackerSettings(**PATIENT))
    free = Tracker(TrackerSettings(edges=(), **PATIENT))
    rng = np.random.default_rng(0)
    for t in np.arange(0.0, 5.0, 0.1):
        position = braking_platoon(t) + 0.1 * rng.normal(size=(4, 2))
        told = frame(t, position if t < 3.5 else position[[0, 1, 3]])
        tracks, independent = tracker.step(told), free.step(told)
    spread = tracks.position_covariance[:, 0, 0]
    assert spread.argmax() == 2
    assert spread[2] < independent.position_covariance[2, 0, 0]


def test_without_edges_every_object_has_its_own_filter_exactly():
    """Told together or each to a tracker of its own: the same numbers."""
    truth = straight([(0, 0), (40, 5), (-60, -8)], [(8, 0), (5, 1), (0, 3)])
    frames = seen(np.random.default_rng(7), truth, np.arange(0, 4, 0.1), yaw=np.nan, world_T_ego=np.eye(4))
    classical = TrackerSettings(edges=())
    together = run(Tracker(classical), frames)
    for k in range(3):
        alone = run(
            Tracker(classical),
            [Frame(f.timestamp, f.sensor, f.detections.select([k]), f.world_T_ego) for f in frames],
        )
        for all_of_them, one in zip(together, alone, strict=True):
            mine = all_of_them.select(all_of_them.id == k + 1)
            expected, got = columns(one), columns(mine)
            for told in (expected, got):
                told.pop("id")
            assert got == expected


def test_classical_settings_have_no_edges_and_others_have():
    frames = seen(np.random.default_rng(0), braking_platoon, np.arange(0, 2, 0.1))
    for edges, expected in (((), 0), ((Following(),), 3)):
        tracker = Tracker(TrackerSettings(edges=edges))
        run(tracker, frames)
        assert tracker.graph.edge_count == expected


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
    tracker = Tracker(rules=(rule,))
    run(tracker, seen(np.random.default_rng(0), straight([(0, 0), (30, 40)], [(9, 0), (0, 0)]), np.arange(0, 2, 0.1)))
    assert rule.asked > 10
    assert [(g.interaction, g.target.tolist(), g.source.tolist()) for g in tracker.graph.edges] == [
        ("SharedVelocity", [1], [0])
    ]
    now, later = (tracker.tracks(t).boxes.velocity[1, 0] for t in (1.9, 2.4))
    assert later > now + 0.5, "the second object is at rest, but pulled along by the first"


def test_a_coasting_track_that_hardly_exists_has_no_edges():
    classes = {"default": ClassSettings(min_score=0.0, initiation_score=0.0)}
    doubtful = TrackerSettings(classes, existence=ExistenceSettings(delete_below=0.0))
    tracker, places = Tracker(doubtful, rules=(Chain(rate=0.3),)), [(0.0, 0.0), (30.0, 40.0), (60.0, 0.0)]
    tied = []
    for k, score in enumerate((0.09, None, 0.9, 0.9)):
        detected = places[1:] if score is None else places
        tracker.step(frame(0.1 * k, detected, score=[score or 0.9, 0.9, 0.9][-len(detected) :]))
        tied.append([(g.target.tolist(), g.source.tolist()) for g in tracker.graph.edges] if tracker.graph else [])
    assert tied == [[], [([1, 2], [0, 1])], [([2], [1])], [([1, 2], [0, 1])]]


def test_a_rule_that_makes_no_sense_is_named_and_nothing_has_happened():
    broken, untouched = Tracker(rules=(Broken(),)), Tracker(rules=())
    run(untouched, seen(np.random.default_rng(0), braking_platoon, np.arange(0, 1, 0.1)))
    broken.restore(untouched.snapshot())
    later = frame(1.0, braking_platoon(1.0))
    with pytest.raises(InputError, match="edge rule Broken: source: row 99 is outside 4 nodes"):
        broken.step(later)
    with pytest.raises(InputError, match="edge rule Broken"):
        broken.tracks(1.5)
    again = Tracker(rules=())
    again.restore(broken.snapshot())
    assert columns(again.step(later)) == columns(untouched.step(later))


def test_an_empty_table_of_detections_with_a_graph():
    tracker = Tracker()
    run(tracker, seen(np.random.default_rng(0), braking_platoon, np.arange(0, 1, 0.1)))
    nothing = tracker.step(Frame(1.0, "lidar", Detections.empty()))
    assert nothing.id.tolist() == [1, 2, 3, 4]


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
