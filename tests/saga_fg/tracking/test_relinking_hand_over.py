"""A return that began with a doubtful detection gets its old identity; others don't take it."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Tracker, TrackerSettings
from saga_fg.graph import Additions
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.tracking.journal import Journal
from tests.saga_fg.traffic_frames import frame, run

SETTINGS = TrackerSettings(
    {"default": ClassSettings(ConstantVelocity(acceleration_noise=0.5), max_deviation=1.0, max_distance=3.0)},
    edges=(),
    association=AssociationSettings(clutter_area=3000.0),
    stationary_share=0.5,
)
EGO = yaw_transform(0.0, 0.0, 0.0, 0.0)


class Quiet:
    """A provider without factors: it makes the graph run."""

    def factors(self, view):
        return Additions()


CLUTTER = [(60.0 + 6.0 * k, 40.0 + 7.0 * j) for k in range(5) for j in range(3)]


def crossing(t):
    """A car that drives at 5 m/s ahead."""
    return (24.0, 5.0 * t - 18.0)


def returning(after, steps=4, settings=SETTINGS, providers=(), label="car"):
    """The tracker and its tracks by step: a car seen for 3 s, hidden for 3.5 s, back at `after(t)` amid clutter."""
    tracker = Tracker(settings, providers=providers)
    run(tracker, [frame(0.1 * k, [crossing(0.1 * k)], yaw=np.pi / 2, world_T_ego=EGO) for k in range(30)])
    run(tracker, [frame(0.1 * k, [], yaw=np.pi / 2, world_T_ego=EGO) for k in range(30, 65)])
    frames = []
    for k in range(65, 65 + steps):
        others = CLUTTER if k == 65 else []
        frames.append(
            frame(
                0.1 * k,
                [after(0.1 * k), *others],
                score=0.3 if k == 65 else 0.9,
                label=label,
                yaw=np.pi / 2,
                world_T_ego=EGO,
            )
        )
    return tracker, run(tracker, frames)


def detected_ids(tracks):
    return tracks.id[(tracks.coasting == 0) & (tracks.boxes.position[:, 0] < 50)].tolist()


def beside(t):
    """Not quite where it was expected: so far off that one detection among many does not tell."""
    x, y = crossing(t)
    return (x + 1.0, y - 6.0)


def from_ahead(t):
    """Where the car is expected, but it comes from the other side."""
    return (24.0, crossing(6.5)[1] - 5.0 * (t - 6.5))


def test_a_return_among_many_detections_gets_its_identity_with_the_next_ones():
    tracker, steps = returning(beside)
    assert [detected_ids(tracks) for tracks in steps] == [[2], [2], [1], [1]]
    table = tracker._state.table
    assert 2 not in table.id, "the new track is no more"
    assert table.sensors.hits[0].tolist() == [34], "all detections count"
    assert tracker.assignment.id.tolist() == [1]
    np.testing.assert_allclose(steps[-1].boxes.position[0, :2], beside(6.8), atol=0.3)


def test_a_return_where_it_was_expected_gets_it_sooner():
    assert [detected_ids(tracks) for tracks in returning(crossing)[1]] == [[2], [1], [1], [1]]


def test_a_look_alike_from_elsewhere_does_not_take_it():
    assert [detected_ids(tracks) for tracks in returning(from_ahead, 8)[1]] == [[2]] * 8


def test_switched_off():
    off = replace(SETTINGS, association=AssociationSettings(clutter_area=3000.0, relink_above=1.0))
    assert [detected_ids(tracks) for tracks in returning(crossing, settings=off)[1]] == [[2]] * 4


def test_an_unresolved_track_hands_nothing_over():
    for unresolved, kept in ((0.0, False), (6.0, True)):
        tracker, _ = returning(beside, 2)
        tracker._state.table.unresolved[1] = unresolved
        tracker.step(frame(6.7, [beside(6.7)], yaw=np.pi / 2, world_T_ego=EGO))
        assert (2 in tracker._state.table.id) == kept


@pytest.mark.parametrize("providers", [(), (Quiet(),)])
def test_the_journal_tells_of_it(providers):
    events = []
    tracker, _ = returning(beside, 2, replace(SETTINGS, estimator="isam2"), providers)
    tracker.observer = Journal(SETTINGS, events.append)
    run(tracker, [frame(t, [beside(t)], yaw=np.pi / 2, world_T_ego=EGO) for t in (6.7, 6.8)])
    (event,) = [one for one in events if one["event"] == "deleted" and one["track"] == 2]
    assert event["reason"] == "it is the return of an earlier track"


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_estimators_agree(estimator):
    expected = returning(beside)[1]
    found = returning(beside, settings=replace(SETTINGS, estimator=estimator))[1]
    for a, b in zip(expected, found, strict=True):
        assert a.id.tolist() == b.id.tolist()
        np.testing.assert_allclose(a.boxes.position, b.boxes.position, atol=1e-6)
        np.testing.assert_allclose(a.boxes.velocity, b.boxes.velocity, atol=1e-6)
