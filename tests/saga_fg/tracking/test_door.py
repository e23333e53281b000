"""What comes in is checked once, at the door; inside, tables of tracks and measurements are not checked again."""

import numpy as np
import pytest

from pipelines.config import load_config
from saga_fg import InputError, Sensor, Tracker
from saga_fg.conformance.programs import CAR
from saga_fg.estimators import Measurements
from saga_fg.estimators.partition import StateLayout
from saga_fg.model.discretisation import Transition
from saga_fg.model.edge_rules import Neighbours
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.nonlinear_interactions import SmoothDriver
from saga_fg.model.scene_graph import Edges, NonlinearEdges, SceneGraph
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame


def frame(number, count=6):
    place = np.zeros((count, 3))
    place[:, 0] = 20.0 * np.arange(count) + 0.1 * number
    boxes = Boxes.of(
        ["car"] * count, place, np.tile((4.0, 1.8, 1.6), (count, 1)), np.zeros(count), np.tile((1.0, 0.0), (count, 1))
    )
    return Frame(0.1 * number, "lidar", Detections(boxes, np.full(count, 0.9)), np.eye(4))


class Law(SharedVelocity):
    """A user's, whose triples are not finite."""

    def triples(self, nodes, target, source):
        triples = super().triples(nodes, target, source)
        return triples._replace(b=triples.b + np.nan)


def test_a_law_of_a_user_is_checked():
    with pytest.raises(InputError, match="of Law: b"):
        TrackerSettings(edges=(Neighbours(Law()),))


NONLINEAR = NonlinearEdges(SmoothDriver(), [0], [1], [1.0], [4.0])
LINEAR = Edges("shared", [0], [1], [0.5], -np.eye(4)[None], np.eye(4)[None], np.zeros((1, 4)))


def test_groups_of_edges_in_the_wrong_place(subtests):
    for given, message in [
        ({"edges": (NONLINEAR,)}, r"edges\[0\]: expected Edges, got NonlinearEdges"),
        ({"nonlinear": (LINEAR,)}, r"nonlinear\[0\]: expected NonlinearEdges, got Edges"),
        ({"edges": NONLINEAR}, "edges: expected tuple or list, got NonlinearEdges"),
        ({"edges": (LINEAR, 3)}, r"edges\[1\]: expected Edges, got int"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            SceneGraph([1, 2], (CAR, CAR), **given)


def test_what_is_no_edge_rule(subtests):
    for rules, message in [
        ((NONLINEAR,), r"\[0\]: expected an edge rule with interaction, pairs; it lacks pairs, got NonlinearEdges"),
        (NONLINEAR, ": expected tuple or list, got NonlinearEdges$"),
        ((Neighbours(), Neighbours), r"\[1\]: expected an edge rule with .*, got the class Neighbours, make it: Neigh"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=f"^edges{message}"):
            TrackerSettings(edges=rules)


def test_inside_nothing_is_checked_again(monkeypatch):
    """Of boxes only those that the sensor places in the world and those reported; of all else none."""
    tracker = load_config("nuscenes").new_tracker("saga")
    for number in range(5):
        tracker.step(frame(number))
    inner = Measurements, Edges, NonlinearEdges, SceneGraph, Transition, StateLayout
    made: dict = dict.fromkeys((Boxes, *inner), 0)
    for kind in made:
        real = kind.__post_init__

        def counted(self, kind=kind, real=real):
            made[kind] += 1
            real(self)

        monkeypatch.setattr(kind, "__post_init__", counted)
    coming = frame(5)
    made[Boxes] = 0
    reported = tracker.step(coming)
    assert len(reported.id) == 6
    assert made.pop(Boxes) <= 2
    assert set(made.values()) == {0}


def test_what_is_reported_is_its_own_and_cannot_be_written():
    tracker = Tracker(sensors={"lidar": Sensor()})
    for number in range(4):
        tracks = tracker.step(frame(number))
    for name in ("label", "position", "size", "yaw", "velocity"):
        assert not getattr(tracks.boxes, name).flags.writeable
    before = tracks.boxes.position.copy()
    tracker.step(frame(4))
    np.testing.assert_array_equal(tracks.boxes.position, before)
