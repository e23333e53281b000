"""The running graph as listed for pictures: every variable where it is, every factor of the frame on its variables."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.sampled_traffic import providers, sample_traffic
from factors import ResidualFactors
from saga_fg import Detection, Detections, Frame, Tracker, TrackerSettings
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import OBJECT, Additions
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.tracking import Journal
from saga_fg.tracking.journal import GraphRecord

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
    smoother, record = IncrementalSmoother(providers(scene), lag=None), GraphRecord()
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
