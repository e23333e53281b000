"""The journal of a tracker: lives of tracks, graphs and edges."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from factors import ResidualFactors
from saga_fg import Detection, Detections, Frame, Sensor, Tracker, TrackerSettings, Tracks
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import OBJECT, Additions
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.graph_building import edge_effects
from saga_fg.model.interactions import NodeTable, SharedVelocity
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.model.sensor import NoiseModel
from saga_fg.providers import Imu, StartSettings
from saga_fg.tracking import AssociationSettings, ClassSettings, Journal
from saga_fg.tracking.edge_record import ACCELERATION, MAX_RATIO, EdgeRecord, HaltingPlaces
from saga_fg.tracking.journal import EventGraph, TrackerView
from tests.saga_fg.sampled_traffic import providers, sample_traffic
from tests.saga_fg.traffic_frames import columns, seen
from tests.saga_fg.traffic_frames import frame as edge_frame
from tests.saga_fg.traffic_frames import run as edge_run

SETTINGS = TrackerSettings(edges=())


def frame(time: float, *x: float, score: float = 0.95, label: str = "car") -> Frame:
    return Frame(time, "lidar", Detections.of([Detection(label, (each, 0.0, 1.0), score=score) for each in x]))


def run(*frames: Frame, settings: TrackerSettings = SETTINGS) -> tuple[list[dict], list[Tracks]]:
    events: list[dict] = []
    tracker = Tracker(settings, {"default": Sensor()}, observer=Journal(settings, events.append))
    return events, [tracker.step(each) for each in frames]


def of_kind(events: list[dict], kind: str) -> list[dict]:
    return [event for event in events if event["event"] == kind]


def test_births_say_what_they_come_from_and_who_was_near():
    events, _ = run(frame(0.0, 10.0), frame(0.1, 10.0, 12.0))
    first, second = of_kind(events, "initiated")
    assert (first["track"], first["detection"], first["nearest_tracks"]) == (1, 0, [])
    assert first["probability"] == pytest.approx(0.95)
    assert second["detection"] == 1
    assert second["position"] == [12.0, 0.0]
    assert second["nearest_tracks"][0]["track"] == 1


def test_matches_name_the_candidates_and_why_they_were_rejected():
    events, _ = run(frame(0.0, 0.0, 6.0), frame(0.1, 0.1, 6.0), frame(0.2, 0.2, 1.2, 6.0))
    last = [event for event in events if event["time"] == 0.2]
    matched = {event["track"]: event for event in of_kind(last, "matched")}
    assert set(matched) == {1, 2}
    one = matched[1]
    chosen = next(c for c in one["candidates"] if c["outcome"] == "chosen")
    assert chosen["detection"] == 0
    assert chosen["position"] == [0.2, 0.0]
    assert chosen["metres"] == pytest.approx(abs(one["predicted"][0] - 0.2))
    assert chosen["distance2"] < chosen["gate"]
    outcomes = {c["detection"]: c["outcome"] for c in one["candidates"]}
    assert outcomes.get(2) in (None, "outside the gate", "too far", "taken by track 2")
    assert one["existence"][1] >= one["existence"][0]
    assert one["edges"] == []


def test_chosen_candidates_and_what_others_took_are_named():
    classes = {"default": ClassSettings(nms_distance=0.0, weak_nms_distance=0.0, min_score=0.0)}
    weak = [Detection("car", (0.02 * k, 0.0, 1.0), score=0.01) for k in range(1, 9)]
    crowd = Frame(0.1, "lidar", Detections.of([*weak, Detection("car", (0.3, 0.0, 1.0), score=0.99)]))
    settings = TrackerSettings(classes, association=AssociationSettings(clutter_area=5000.0), edges=())
    events, _ = run(frame(0.0, 0.0), crowd, settings=settings)
    (matched,) = of_kind(events, "matched")
    assert [c["outcome"] for c in matched["candidates"]].count("chosen") == 1
    assert matched["candidates"][-1]["detection"] == 8
    events, _ = run(frame(0.0, 0.0, 1.0), frame(0.1, 0.0, 1.0), frame(0.2, 0.9))
    last = {event["track"]: event for event in events if event["time"] == 0.2 and "track" in event}
    assert last[2]["event"] == "matched"
    assert last[1]["event"] == "missed"
    assert last[1]["candidates"][0]["outcome"] == "taken by track 2"
    assert last[1]["coasting"] == pytest.approx(0.1)
    assert last[1]["existence"][1] < last[1]["existence"][0]


def test_ends_have_a_reason():
    detected = (frame(0.1 * k, 0.0, score=0.99) for k in range(2))
    settings = replace(SETTINGS, association=AssociationSettings(relink_above=1.0))
    events, _ = run(*detected, *(frame(0.1 * k) for k in range(2, 30)), settings=settings)
    (deleted,) = of_kind(events, "deleted")
    assert deleted["confirmed"]
    assert deleted["reason"].startswith("its place is no longer known well enough")
    events, _ = run(frame(0.0, 0.0, score=0.2), *(frame(0.1 * k) for k in range(1, 9)))
    assert of_kind(events, "deleted")[0]["reason"].startswith("existence below 0.02")


def test_keeping_a_journal_changes_nothing():
    settings = replace(SETTINGS, edges=(Neighbours(rate=2.0),))
    frames = [frame(0.1 * k, k * 1.0, k * 1.0 + 6.0, k * 1.0 + 12.0) for k in range(12)]
    events, tracks = run(*frames, settings=settings)
    plain = Tracker(settings, {"default": Sensor()})
    for each, found in zip(frames, tracks, strict=True):
        expected = plain.step(each)
        np.testing.assert_array_equal(found.boxes.position, expected.boxes.position)
        np.testing.assert_array_equal(found.position_covariance, expected.position_covariance)
    acting = [event for event in of_kind(events, "matched") if event["edges"]]
    assert acting
    assert {edge["interaction"] for event in acting for edge in event["edges"]} == {"SharedVelocity"}


def test_the_effect_of_an_edge_is_the_prediction_with_less_that_without():
    car = NodeType("car", ConstantVelocity(acceleration_noise=1.0))
    rng = np.random.default_rng(0)
    n, dt = 4, 0.5
    position, velocity = rng.normal(size=(n, 2)), rng.normal(size=(n, 2))
    flat = np.zeros(n)
    table = NodeTable(
        np.arange(n) + 7, np.full(n, "car"), (car,) * n, position, velocity, flat, flat, flat, np.ones(n, bool)
    )
    target, source, rate = np.array([0, 0, 2]), np.array([1, 3, 0]), np.array([0.5, 1.0, 2.0])
    edges = Edges("SharedVelocity", target, source, rate, *SharedVelocity().triples(table, target, source))
    effects = edge_effects(SceneGraph(table.id, table.types, (edges,)), dt, table)
    assert [(e.target, e.source, e.rate) for e in effects] == [(7, 8, 0.5), (7, 10, 1.0), (9, 7, 2.0)]

    def predicted(kept: list[int]) -> np.ndarray:
        some = Edges("SharedVelocity", target[kept], source[kept], rate[kept], *(
            getattr(edges, name)[kept] for name in ("A_self", "A_other", "b")
        ))  # fmt: skip
        transition = discretise(SceneGraph(table.id, table.types, (some,)), dt)
        x = np.concatenate([position, velocity], axis=1).ravel()
        return (transition.F_matrix @ x + transition.b).reshape(n, 4)

    for k, effect in enumerate(effects):
        without = predicted([e for e in range(3) if e != k])
        change = (predicted([0, 1, 2]) - without)[effect.target - 7]
        np.testing.assert_allclose(np.concatenate([effect.position, effect.velocity]), change, atol=1e-12)


def test_a_view_stays_as_it_was():
    views: list[TrackerView] = []

    class Keep:
        def after(self, stage: str, view) -> None:
            views.append(view())

    tracker = Tracker(SETTINGS, observer=Keep())
    for k in range(20):
        tracker.step(frame(0.1 * k, 10.0 + k))
    before = next(view for view in views if len(view.table.id))
    assert before.nodes.has_moved is not None
    assert before.nodes.has_moved.tolist() == before.table.has_moved.tolist() == [False]
    assert views[-1].table.has_moved.tolist() == [True]


def test_an_observer_is_told_every_stage_in_turn():
    stages: list[str] = []

    class Watch:
        def after(self, stage: str, view) -> None:
            stages.append(stage)
            if stage == "initiate":
                seen: TrackerView = view()
                assert len(seen.initiated) == 1
                assert seen.positions()[0].tolist() == [10.0, 0.0]

    Tracker(SETTINGS, observer=Watch()).step(frame(0.0, 10.0))
    assert stages == ["predict", "measure", "associate", "update", "existence", "initiate", "delete", "report"]


# The running graph as listed for pictures: every variable where it is, every factor of the frame on its variables

RULES = (Following(interaction=SharedVelocity(along_heading=True), rate=1.5),)


class Wall:
    name = "wall"

    def factors(self, view):
        rows = [[one.key] for one in view.now(OBJECT).values()]
        return Additions(factors=[ResidualFactors(rows, (4,), lambda x: x[:, 1:2], np.eye(1), name="keeps off")])


def graphs(settings=None, tracker_providers=()):
    """Graphs of three cars in a row from 100 m on; the third is initiated with the third frame."""
    events, settings = [], settings or TrackerSettings(edges=RULES)
    tracker = Tracker(settings, observer=Journal(settings, events.append), providers=tracker_providers)
    for k in range(4):
        places = [(100.0 + k - 12 * n, 0.0, 0.8) for n in range(2 + (k > 1))]
        cars = [Detection("car", place, (4.5, 1.8, 1.5), yaw=0.0, score=0.95) for place in places]
        tracker.step(Frame(50.0 + 0.1 * k, "lidar", Detections.of(cars)))
    return [json.loads(json.dumps(event, allow_nan=False)) for event in events if event["event"] == "graph"]


def named(graph, kind):
    """The variables of each factor of a kind."""
    return [[graph["nodes"][n]["name"] for n in one["nodes"]] for one in graph["factors"] if one["kind"] == kind]


def test_a_tracker_tells_the_graph_of_every_frame():
    first, _, third, last = graphs()
    assert named(first, "initiation") == [["car 1 at 0.00 s"], ["car 2 at 0.00 s"]]
    assert named(first, "interaction") == []
    assert named(third, "initiation") == [["car 3 at 0.20 s"]]
    assert named(third, "detection") == [["car 1 at 0.20 s"], ["car 2 at 0.20 s"]]
    interactions = {nodes[0]: nodes[1:] for nodes in named(last, "interaction")}
    assert interactions["car 2 at 0.30 s"] == ["car 2 at 0.20 s", "car 1 at 0.20 s"]
    assert interactions["car 1 at 0.30 s"] == ["car 1 at 0.20 s"]
    (edge,) = next(f["edges"] for f in last["factors"] if f["kind"] == "interaction" and len(f["nodes"]) == 3)
    assert edge[0] == "SharedVelocity"
    assert edge[1] > 0
    (car,) = (node for node in last["nodes"] if node["name"] == "car 1 at 0.30 s")
    np.testing.assert_allclose(car["position"], [103.0, 0.0], atol=0.3)
    assert np.linalg.eigvalsh(car["covariance"]).min() > 0
    assert np.shape(car["outline"]) == (4, 2)


def test_factors_of_users_are_in_it_under_their_names():
    plain, walled = (graphs(TrackerSettings(estimator="isam2"), given) for given in ((), (Wall(),)))
    assert {factor["kind"] for factor in plain[-1]["factors"]} == {"interaction", "detection"}
    assert named(walled[-1], "wall: keeps off") == [[f"car {n} at 0.30 s"] for n in (1, 2, 3)]
    rest = [factor for factor in walled[-1]["factors"] if not factor["kind"].startswith("wall")]
    assert [f["nodes"] for f in rest] == [f["nodes"] for f in plain[-1]["factors"]]


def test_any_running_graph_is_listed_factor_for_factor():
    scene = sample_traffic(np.random.default_rng(0), frames=4, intervals=(0.5,))
    smoother, record = IncrementalSmoother(providers(scene), lag=None), EventGraph()
    for moment in scene.frames:
        smoother.step(moment.time)
    graph = smoother.graph()
    record.add(graph, origin=(10.0, 20.0), covariance=smoother.covariance)
    assert {node["name"] for node in record.nodes} == {str(one) for one in graph.variables.values()}
    assert [named(vars(record), kind) for kind in ("detection", "interaction")] == [
        [[str(one) for one in factor.variables] for factor in graph.factors() if factor.provider == provider]
        for provider in ("detections", "interactions")
    ]
    for key, one in graph.variables.items():
        state = graph.state(key)
        place = state[:2] if one.kind == OBJECT else state.translation()
        (node,) = (node for node in record.nodes if node["name"] == str(one))
        np.testing.assert_allclose(node["position"], np.add(place, (10.0, 20.0)), atol=1e-3)
        assert ("covariance" in node) == (one.kind == OBJECT)


def test_the_vehicle_s_velocity_is_no_place():
    smoother, record = IncrementalSmoother([Imu(StartSettings((5.0, 6.0, 0.0), planar=False))]), EventGraph()
    smoother.step(0.0)
    smoother.step(0.1, frame=Frame(0.1, "imu", Detections.empty()))
    record.add(smoother.graph())
    assert {node["name"].split(" at")[0] for node in record.nodes} == {"vehicle 0"}


# Edges that answer for themselves, and the lines at which vehicles halt

FOLLOWING = Following(SharedVelocity(), rate=2.0, max_gap=60.0, gap_scale=np.inf, parked=True)
EDGE_SETTINGS = TrackerSettings(edges=(FOLLOWING,), edge_prior=0.9)
CAR = NodeType("car", ConstantVelocity(1.0))


def nodes(position, velocity, ids=None, heading=0.0, moved=1.0):
    """Cars, as edge rules see them."""
    position, velocity = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    n = len(position)
    ids = np.arange(n) if ids is None else np.array(ids)
    yaw, variance = np.full(n, heading, dtype=float), np.full(n, 0.04)
    return NodeTable(
        ids, np.full(n, "car"), (CAR,) * n, position, velocity, yaw, np.full(n, 4.5), variance, np.full(n, moved)
    )


def moved(table, dt=1.0):
    return replace(table, position=table.position + dt * table.velocity)


def after_a_second(before, after, rules=(FOLLOWING,)):
    """The record of cars that move as `before` says for a second, and then as `after` says."""
    here, start = np.ones(len(before), dtype=bool), moved(before, -1.0)
    record = EdgeRecord().later(rules, start, here, 9.0).later(rules, before, here, 10.0)
    return record.later(rules, replace(after, position=before.position + after.velocity), here, 11.0)


def probability(record, table, prior=0.9, halting=None, time=11.0, target=0, source=1):
    governing = record.governing((FOLLOWING,), halting or HaltingPlaces(), prior, time)
    return governing(0, table, np.array([target]), np.array([source]))[0]


def test_a_trial_is_the_ratio_of_two_normal_densities():
    places, v = [(0, 0), (20, 0)], np.array([[0.0, 0.0], [5.0, 0.0]])
    record = after_a_second(nodes(places, v), nodes(places, [(1.0, 0), (5.0, 0)]))
    asked, variance = 5.0 * (1 - (1 - np.exp(-2.0)) / 2.0), 0.04 + 0.04 + ACCELERATION**2
    ratio = (1.0**2 - (1.0 - asked) ** 2) / (2 * variance)
    assert abs(ratio) < MAX_RATIO
    assert record.sums[0, 1, 0, 1] == (pytest.approx(ratio), 11.0)


def test_who_stands_while_the_leader_leaves_is_soon_not_led_by_him_and_who_follows_is():
    places = [(0, 0), (20, 0)]
    waits = nodes(places, [(0, 0), (8, 0)])
    record, here, found = EdgeRecord(), np.ones(2, dtype=bool), []
    for time in np.arange(9.0, 15.0):
        record = record.later((FOLLOWING,), moved(waits, time - 11.0), here, time)
        found.append(probability(record, waits, time=time))
    assert found == sorted(found, reverse=True)
    assert found[1] == found[0] > found[2]
    assert found[-1] < 0.05
    follows = after_a_second(waits, nodes(places, [(4, 0), (8, 0)]))
    assert probability(follows, waits) > 0.95
    assert probability(EdgeRecord(), waits) == pytest.approx(0.9)


def test_who_leaves_a_leader_that_speeds_up_still_follows_him_when_he_brakes():
    waits = nodes([(0, 0), (20, 0)], [(0, 0), (8, 0)])
    record = after_a_second(waits, waits)
    assert probability(record, waits) < 0.8
    braking = nodes([(0, 0), (20, 0)], [(8, 0), (0, 0)])
    assert probability(record, braking) == pytest.approx(0.9)


def test_records_fade_and_tell_about_other_vehicles_at_the_place_alone():
    places = [(0, 0), (20, 0)]
    waits = nodes(places, [(0, 0), (8, 0)])
    record = after_a_second(waits, waits)
    assert probability(record, waits, time=2000.0) == pytest.approx(0.9, abs=1e-3)
    others = nodes(places, [(0, 0), (8, 0)], ids=[7, 8])
    elsewhere = nodes([(0, 200), (20, 200)], [(0, 0), (8, 0)], ids=[7, 8])
    across = nodes(places, [(0, 0), (4, 8)], ids=[7, 8], heading=np.pi / 2)
    here, there, other_way = (probability(record, table) for table in (others, elsewhere, across))
    assert here < min(there, other_way)
    assert there == other_way < 0.9  # all know that the rule has failed once


def test_who_is_not_seen_at_the_end_tells_nothing_and_who_is_not_seen_begins_nothing():
    table = nodes([(0, 0), (20, 0)], [(0, 0), (8, 0)])
    both, one = np.array([True, True]), np.array([False, True])
    for seen_at, trials in (((both, both, one), True), ((both, one, both), False), ((one, both, both), False)):
        record = EdgeRecord()
        for time, here in enumerate(seen_at):
            begun, record = record.trials, record.later((FOLLOWING,), table, here, float(time))
        assert (len(begun) > 0, record.sums) == (trials, {})
    late = EdgeRecord().later((FOLLOWING,), table, both, 0.0).later((FOLLOWING,), table, both, 5.0)
    assert late.trials == ()


def test_information_gain_does_not_hide_what_an_edge_would_say_of_a_hidden_object():
    places, v = [(0, 0), (20, 0)], [(0, 0), (5, 0)]
    gains = replace(FOLLOWING, information_gain=True)
    whole, weighted = (after_a_second(nodes(places, v), nodes(places, v), (rule,)) for rule in (FOLLOWING, gains))
    assert weighted.sums == whole.sums


def halts(places, rows, time):
    """Cars that come one by one, each of which stands at (0, 0) for two seconds, or not, and goes on."""
    for number, stands in enumerate(rows):
        for x in np.arange(-10, 8, 0.5):
            wait = [0.0] * 20 if stands and x == 0 else []
            for v in [5.0, *wait]:
                table = nodes([(x, 0.1 * number)], [(v, 0.0)], ids=[number])
                places, time = places.later(table, np.ones(1, dtype=bool), time), time + 0.1
    return places


def test_halts_in_one_place_are_one_line_with_the_share_of_those_that_halted():
    places = halts(HaltingPlaces(), [True, True, False, True], 0.0)
    assert len(places.lines) == 1
    assert places.lines.probability[0] == pytest.approx(3 / 5)
    assert np.abs(places.lines.position[0]).max() < 0.5
    assert len(halts(HaltingPlaces(), [False] * 3, 0.0).lines) == 0


def test_a_line_ends_the_edge_to_a_leader_who_has_crossed_it():
    places = halts(HaltingPlaces(), [True, True, True], 0.0)
    halt = places.lines.probability[0]
    pairs = {
        "crossed": ([(-1, 0), (10, 0)], halt),
        "both before": ([(-20, 0), (-1, 0)], 0.0),
        "both beyond": ([(6, 0), (16, 0)], 0.0),
        "other lane": ([(-1, 3.5), (10, 3.5)], 0.0),
    }
    for name, (where, expected) in pairs.items():
        table = nodes(where, [(5, 0), (5, 0)])
        assert places.across(table, np.array([0]), np.array([1]))[0] == pytest.approx(expected), name
    faster, slower = (nodes([(-1, 0), (10, 0)], [(5, 0), (v, 0)]) for v in (7, 3))
    assert probability(EdgeRecord(), faster, halting=places) == pytest.approx(0.9 * (1 - halt))
    assert probability(EdgeRecord(), slower, halting=places) == pytest.approx(0.9)


@pytest.mark.parametrize("case", ["parked", "queue", "creeps"])
def test_no_line_where_nobody_halts_of_his_own(case):
    places = HaltingPlaces()
    for k in range(40):
        if case == "parked":
            table = nodes([(0, 0)], [(0, 0)], moved=0.0)
        elif case == "queue":
            table = nodes([(0, 0), (7, 0)], [(0, 0), (2, 0)])
        else:
            table = nodes([(0.1 * k, 0)], [(1.0, 0)])
        places = places.later(table, np.ones(len(table), dtype=bool), 0.1 * k)
    assert len(places.lines) == 0


def crossing(settings, hidden=np.inf):
    """A car stands at a line, with a heading; another stands before it and then goes away. Both are seen at 10 Hz, the
    first until it is `hidden`. Returns the tracker and its tracks."""
    rng, leader = np.random.default_rng(0), lambda t: 12.0 + np.maximum(t - 3.0, 0.0) ** 2
    frames = [
        edge_frame(t, place[:1] if t >= hidden else place, yaw=0.0)
        for t in np.arange(0, 10, 0.1)
        for place in [np.array([[leader(t), 0.0], [0.0, 0.0]]) + 0.05 * rng.normal(size=(2, 2))]
    ]
    tracker = Tracker(settings, {"default": Sensor(noise={"default": NoiseModel(position=0.1)})})
    return tracker, edge_run(tracker, frames)


def test_a_hidden_car_that_waited_is_not_pulled_after_its_leader():
    settings = replace(EDGE_SETTINGS, stationary_share=0.0, max_coasting=10.0)
    place = {}
    for prior in (0.9, 1.0):
        _, tracks = crossing(replace(settings, edge_prior=prior), hidden=8.0)
        place[prior] = tracks[90].boxes.position[tracks[90].id == tracks[40].id[1], 0][0]
    assert place[0.9] < 0.3 * place[1.0]
    assert place[1.0] > 10.0


def test_a_tracker_goes_on_from_a_snapshot_with_what_its_edges_have_told():
    tracker, _ = crossing(EDGE_SETTINGS)
    assert tracker._state.edge_record.sums
    twin = pickle.loads(pickle.dumps(tracker))
    later = seen(
        np.random.default_rng(1), lambda t: np.array([[12 + (t - 3) ** 2, 0.0], [0.0, 0.0]]), np.arange(10.0, 12, 0.1)
    )
    assert [columns(a) for a in edge_run(tracker, later)] == [columns(b) for b in edge_run(twin, later)]


def test_certain_edges_record_nothing_and_pedestrians_answer_too():
    tracker, tracks = crossing(replace(EDGE_SETTINGS, edge_prior=1.0))
    assert tracker._state.edge_record.sums == {}
    _, without = crossing(replace(EDGE_SETTINGS, edge_prior=1.0, edges=()))
    assert [columns(t) for t in tracks] != [columns(t) for t in without]
    group = Neighbours(classes=("pedestrian",), rate=1.0, distance_scale=2.0, max_distance=4.5, min_speed=0.0)
    table = nodes([(0, 0), (1, 0)], [(0.5, 0.5), (1.5, 0)])
    walk = replace(table, label=np.full(2, "pedestrian"), velocity=np.array([[0.2, 0.0], [2.2, 0.0]]))
    assert after_a_second(walk, walk, (group,)).sums
