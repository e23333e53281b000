"""The journal of a tracker: what it says of a few frames worked out by hand, and that keeping it changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Detection, Detections, Frame, Sensor, Tracker, TrackerSettings, Tracks
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_effects import edge_effects
from saga_fg.model.edge_rules import Neighbours
from saga_fg.model.interactions import NodeTable, SharedVelocity
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.tracking import AssociationSettings, ClassSettings, Journal
from saga_fg.tracking.journal import TrackerView

SETTINGS = TrackerSettings(edges=())


def frame(time: float, *x: float, score: float = 0.95, label: str = "car") -> Frame:
    return Frame(time, "lidar", Detections.of([Detection(label, (each, 0.0, 1.0), score=score) for each in x]))


def run(*frames: Frame, settings: TrackerSettings = SETTINGS) -> tuple[list[dict], list[Tracks]]:
    events: list[dict] = []
    tracker = Tracker(settings, {"default": Sensor()}, observer=Journal(settings, events.append))
    return events, [tracker.step(each) for each in frames]


def of_kind(events: list[dict], kind: str) -> list[dict]:
    return [event for event in events if event["event"] == kind]


def test_births_say_what_they_come_from_and_who_was_near() -> None:
    events, _ = run(frame(0.0, 10.0), frame(0.1, 10.0, 12.0))
    first, second = of_kind(events, "initiated")
    assert (first["track"], first["detection"], first["nearest_tracks"]) == (1, 0, [])
    assert first["probability"] == pytest.approx(0.95)
    assert second["detection"] == 1
    assert second["position"] == [12.0, 0.0]
    assert second["nearest_tracks"][0]["track"] == 1


def test_matches_name_the_candidates_and_why_they_were_rejected() -> None:
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


def test_the_chosen_candidate_is_listed_however_many_are_nearer() -> None:
    classes = {"default": ClassSettings(nms_distance=0.0, weak_nms_distance=0.0, min_score=0.0)}
    weak = [Detection("car", (0.02 * k, 0.0, 1.0), score=0.01) for k in range(1, 9)]
    crowd = Frame(0.1, "lidar", Detections.of([*weak, Detection("car", (0.3, 0.0, 1.0), score=0.99)]))
    settings = TrackerSettings(classes, association=AssociationSettings(clutter_area=5000.0), edges=())
    events, _ = run(frame(0.0, 0.0), crowd, settings=settings)
    (matched,) = of_kind(events, "matched")
    assert [c["outcome"] for c in matched["candidates"]].count("chosen") == 1
    assert matched["candidates"][-1]["detection"] == 8


def test_what_another_track_took_is_named() -> None:
    events, _ = run(frame(0.0, 0.0, 1.0), frame(0.1, 0.0, 1.0), frame(0.2, 0.9))
    last = {event["track"]: event for event in events if event["time"] == 0.2 and "track" in event}
    assert last[2]["event"] == "matched"
    assert last[1]["event"] == "missed"
    assert last[1]["candidates"][0]["outcome"] == "taken by track 2"
    assert last[1]["coasting"] == pytest.approx(0.1)
    assert last[1]["existence"][1] < last[1]["existence"][0]


def test_ends_have_a_reason() -> None:
    detected = (frame(0.1 * k, 0.0, score=0.99) for k in range(2))
    settings = replace(SETTINGS, association=AssociationSettings(relink_above=1.0))
    events, _ = run(*detected, *(frame(0.1 * k) for k in range(2, 30)), settings=settings)
    (deleted,) = of_kind(events, "deleted")
    assert deleted["confirmed"]
    assert deleted["reason"].startswith("its place is no longer known well enough")
    events, _ = run(frame(0.0, 0.0, score=0.2), *(frame(0.1 * k) for k in range(1, 9)))
    assert of_kind(events, "deleted")[0]["reason"].startswith("existence below 0.02")


def test_keeping_a_journal_changes_nothing() -> None:
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


def test_the_effect_of_an_edge_is_the_prediction_with_less_that_without() -> None:
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


def test_a_view_stays_as_it_was() -> None:
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


def test_an_observer_is_told_every_stage_in_turn() -> None:
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
