"""Factors of users' own in the tracker: they act, they are refused by name, and without them nothing changes."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from factors import ResidualFactors
from saga_fg import Frame, InputError, Tracker, TrackerSettings
from saga_fg.graph import OBJECT, Additions, GraphError, GraphView
from saga_fg.model.edge_rules import Neighbours
from saga_fg.tracking import AssociationSettings
from tests.saga_fg.traffic_frames import frame, run, seen, straight

PLACE = np.array([5e5, -3e5])  # of the scene in the world
CARS = straight(PLACE + np.array([(0.0, 3.0), (9.0, 3.2), (0.0, -40.0)]), [(1.2, 0.4), (1.2, 0.4), (1.0, 0.0)])
SIDE_BY_SIDE = (Neighbours(),)
ISAM2 = TrackerSettings(estimator="isam2", edges=SIDE_BY_SIDE)


class Quiet:
    name = "quiet"

    def factors(self, view: GraphView) -> Additions:
        return Additions()


class Range:
    """A tape measure from the place to whoever is first: a nonlinear factor."""

    name = "tape"

    def __init__(self, metres: float = 4.0) -> None:
        self.metres = metres

    def factors(self, view: GraphView) -> Additions:
        rows = [[one.key] for one in list(view.now(OBJECT).values())[:1]]
        residual = partial(beyond, view.origin, self.metres)
        return Additions(factors=[ResidualFactors(rows, (4,), residual, [[0.01]], name="range")])


def beyond(origin: np.ndarray, metres: float, x: np.ndarray) -> np.ndarray:
    return np.hypot(*(x[:, :2] + origin - PLACE).T)[:, None] - metres


def frames(count: int = 12) -> list[Frame]:
    return seen(np.random.default_rng(0), CARS, np.arange(count) / 10)


def same(a: Any, b: Any, tolerance: float) -> None:
    assert a.id.tolist() == b.id.tolist()
    for name in ("position", "velocity"):
        assert getattr(a.boxes, name) == pytest.approx(getattr(b.boxes, name), abs=tolerance)
    assert a.position_covariance == pytest.approx(b.position_covariance, rel=100 * tolerance, abs=1e-9)


@pytest.mark.parametrize("association", ["hungarian", "graph"])
def test_a_provider_that_adds_nothing_changes_nothing(association: str) -> None:
    matching = AssociationSettings(method=association)
    plain = Tracker(TrackerSettings(association=matching, edges=SIDE_BY_SIDE, tolerance=0.0))  # exact, as iSAM2 is
    quiet = Tracker(replace(ISAM2, association=matching), providers=[Quiet()])
    for a, b in zip(run(plain, frames()), run(quiet, frames()), strict=True):
        same(a, b, 1e-6)
    assert quiet.graph.edge_count > 0


def test_a_users_factor_moves_what_the_tracker_reports() -> None:
    plain, measured = Tracker(ISAM2), Tracker(ISAM2, providers=[Range()])
    for f in frames():
        without, told = plain.step(f), measured.step(f)
    assert told.id.tolist() == without.id.tolist() == [1, 2, 3]
    apart = [np.hypot(*(tracks.boxes.position[0, :2] - PLACE)) for tracks in (without, told)]
    assert abs(apart[1] - 4.0) < 0.3 * abs(apart[0] - 4.0)
    moved = np.abs(told.boxes.velocity - without.boxes.velocity).max(axis=1)
    assert moved[1] > 1e-3, "neighbours share their velocity"
    assert moved[2] < 1e-3 * moved[1], "that one is far away"


def test_what_is_no_provider_is_refused_at_construction() -> None:
    with pytest.raises(InputError, match="providers: expected factor providers, with a method factors, got 1"):
        Tracker(providers=[1])  # type: ignore[list-item]


def test_variables_have_the_names_of_their_classes_and_times() -> None:
    class Named:
        name = "names"

        def __init__(self) -> None:
            self.seen: list[str] = []

        def factors(self, view: GraphView) -> Additions:
            self.seen += [str(one) for one in view.now(OBJECT).values()]
            return Additions()

    named = Named()
    run(Tracker(ISAM2, providers=[named]), frames(3))
    assert named.seen[-3:] == ["car 1 at 0.20 s", "car 2 at 0.20 s", "car 3 at 0.20 s"]


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (
            lambda x: np.full((len(x), 1), np.nan),
            "provider faulty: .* on car 1 at 1.00 s.*expected a finite number",
        ),
        (lambda x: 1 / 0, "provider faulty: .*division by zero"),
    ],
)
def test_a_faulty_factor_is_named_and_the_tracker_goes_on(residual: Callable[..., Any], message: str) -> None:
    class Faulty:
        name = "faulty"
        broken = False

        def factors(self, view: GraphView) -> Additions:
            rows = [[one.key] for one in view.now(OBJECT).values()]
            given = ResidualFactors(rows, (4,), residual, [[1.0]], name="wrong")
            return Additions(factors=[given]) if self.broken else Additions()

    provider = Faulty()
    tracker, untouched = Tracker(ISAM2, providers=[provider]), Tracker(ISAM2, providers=[Quiet()])
    for t in (tracker, untouched):
        run(t, frames()[:10])
    provider.broken = True
    with pytest.raises(GraphError, match=message):
        tracker.step(frames()[10])
    provider.broken = False
    same(tracker.step(frames()[10]), untouched.step(frames()[10]), 1e-6)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))])
def test_trackers_with_providers_can_be_copied_and_look_ahead(copied: Callable[[Tracker], Tracker]) -> None:
    tracker, watched = Tracker(ISAM2, providers=[Range()]), Tracker(ISAM2, providers=[Range()])
    for f in frames()[:8]:
        same(tracker.step(f), watched.step(f), 1e-4)
        watched.tracks(f.timestamp + 0.7)
    twin = copied(tracker)
    for f in frames()[8:]:
        same(tracker.step(f), twin.step(f), 1e-4)


def test_providers_from_the_configuration() -> None:
    named = TrackerSettings(estimator="isam2", providers=(f"{__name__}:Range",))
    by_name, by_hand = Tracker(named), Tracker(ISAM2, providers=[Range()])
    for f in frames(5):
        same(by_name.step(f), by_hand.step(f), 1e-12)


def test_names_that_lead_to_no_provider(subtests: pytest.Subtests) -> None:
    for name, message in [
        ("wall", "expected MODULE:NAME, got 'wall'"),
        ("no_such_module:Wall", "no_such_module:Wall: expected a module that can be imported"),
        ("math:Wall", "math:Wall: the module has no Wall"),
        ("math:sqrt", "math:sqrt: expected a class to be made without arguments"),
        ("collections:Counter", "collections:Counter: expected a factor provider, which has a method factors"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            Tracker(TrackerSettings(estimator="isam2", providers=(name,)))


@pytest.mark.parametrize(("name", "size"), [("isam2", 6), ("fixed-lag", 16)])
def test_tracks_come_and_go_in_a_graph_that_stays_small(name: str, size: int) -> None:
    association = AssociationSettings(relink_above=1.0)
    settings = TrackerSettings(estimator=name, lag=0.5, association=association)
    tracker, sizes = Tracker(settings, providers=[Range()]), []
    for k in range(60):
        where = CARS(0.1 * k)[[k // 20]] if k % 20 < 12 else np.empty((0, 2))
        tracker.step(frame(0.1 * k, where))
        graph = tracker.snapshot().joint[0].graph
        sizes.append(len(graph.variables))
    assert max(sizes) <= size
