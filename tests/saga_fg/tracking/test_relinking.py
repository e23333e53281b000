"""Tracks that were lost and found again."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, InputError, Tracker, TrackerSettings
from saga_fg.graph import Additions
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.tracking.journal import Journal
from saga_fg.tracking.relinking import relinkable
from tests.saga_fg.traffic_frames import frame, run

SETTINGS = TrackerSettings(
    {"default": ClassSettings(ConstantVelocity(acceleration_noise=0.5), max_deviation=1.0, max_distance=3.0)},
    edges=(),
    association=AssociationSettings(clutter_area=3000.0),
    stationary_share=0.5,
)
OFF = replace(SETTINGS, association=AssociationSettings(clutter_area=3000.0, relink_above=1.0))
EGO = yaw_transform(0.0, 0.0, 0.0, 0.0)


def returning(settings, before, after, gap=4.0, others=()):
    """Ids at the end: an object at `before(t)` for 3 s, nobody but `others` for `gap` s, then at `after(t)`."""
    tracker = Tracker(settings)
    for k in range(round((4.0 + gap) / 0.1)):
        t = 0.1 * k
        place = before(t) if t < 2.95 else after(t) if t > 2.95 + gap else None
        tracker.step(frame(t, [*others, *([] if place is None else [place])], world_T_ego=EGO))
    tracks = tracker.step(frame(t + 0.1, [*others, after(t + 0.1)], world_T_ego=EGO))
    return tracks.id[np.argsort(tracks.boxes.position[:, 0])].tolist()


def crossing(t):
    """A car that drives at 5 m/s behind a van at (12, 0)."""
    return (24.0, 4.0 * t - 18.0)


VAN = (12.0, 0.0)


def test_cars_behind_a_van_or_parked_stay_the_same():
    assert returning(SETTINGS, crossing, crossing, others=[VAN]) == [1, 2]
    assert returning(OFF, crossing, crossing, others=[VAN]) == [1, 3]

    def parked(t):
        return (20.0, 5.0)

    assert returning(SETTINGS, parked, parked, gap=5.5) == [1]
    assert returning(SETTINGS, parked, parked, gap=7.0) == [2], "nobody is remembered for ever"


@pytest.mark.parametrize(
    "look_alike",
    [
        lambda t: (24.0, 30.0 - 4.0 * (t - 7.0)),
        lambda t: (30.0, 4.0 * t - 18.0),
        lambda t: (24.0, -30.0 + 4.0 * (t - 7.0)),
    ],
    ids=["from the other side", "on the next lane but one", "behind it"],
)
def test_a_look_alike_from_elsewhere_does_not_take_its_identity(look_alike):
    assert returning(SETTINGS, crossing, look_alike, others=[VAN])[-1] > 2


def test_another_class_or_no_relinking_take_nothing():
    tracker = Tracker(SETTINGS)
    run(tracker, [frame(0.1 * k, [(20.0, 5.0)]) for k in range(30)])
    run(tracker, [frame(0.1 * k, []) for k in range(30, 60)])
    tracks = tracker.step(frame(6.0, [(20.0, 5.0)], label="truck"))
    assert tracks.id[tracks.coasting == 0].tolist() == [2]
    with pytest.raises(InputError, match="relink_above: expected a number above 0 to 1"):
        AssociationSettings(relink_above=0.0)
    tracker = Tracker(OFF)
    run(tracker, [frame(0.1 * k, [(20.0, 5.0)]) for k in range(30)])
    assert not relinkable(tracker._state).any()


def test_a_track_that_was_just_detected_comes_first():
    """A car halts half a metre from where another one was parked that is hidden now."""
    tracker = Tracker(SETTINGS)
    both = [frame(0.1 * k, [(20.0, 0.0), (20.0, 12.0 - 0.3 * k)]) for k in range(30)]
    run(tracker, both)
    halting = [frame(0.1 * k, [(20.0, max(3.0 - 0.3 * (k - 30), 0.6))]) for k in range(30, 60)]
    assert {tuple(tracks.id[tracks.coasting == 0].tolist()) for tracks in run(tracker, halting)} == {(2,)}


def test_among_many_detections_only_a_well_known_place_tells():
    """A car comes back at the edge of where it may be: alone it is taken for itself, among many others it is not."""

    def far(t):
        return (24.0, 4.0 * t - 14.0)

    crowd = [(60.0 + 4.0 * k, 30.0) for k in range(12)]
    for others, same in ((0, True), (12, False)):
        tracker = Tracker(SETTINGS)
        run(tracker, [frame(0.1 * k, [crossing(0.1 * k)]) for k in range(30)])
        run(tracker, [frame(0.1 * k, []) for k in range(30, 60)])
        tracks = tracker.step(frame(6.0, [far(6.0), *crowd[:others]]))
        nearest = np.argmin(np.abs(tracks.boxes.position[:, 0] - 24.0) + tracks.coasting)
        assert (tracks.id[nearest] == 1) == same


# A return that began with a doubtful detection gets its old identity; others don't take it


class Quiet:
    """A provider without factors: it makes the graph run."""

    name = "quiet"

    def factors(self, view):
        return Additions()


CLUTTER = [(60.0 + 6.0 * k, 40.0 + 7.0 * j) for k in range(5) for j in range(3)]


def handed_crossing(t):
    """A car that drives at 5 m/s ahead."""
    return (24.0, 5.0 * t - 18.0)


def handed_returning(after, steps=4, settings=SETTINGS, providers=(), label="car"):
    """The tracker and its tracks by step: a car seen for 3 s, hidden for 3.5 s, back at `after(t)` amid clutter."""
    tracker = Tracker(settings, providers=providers)
    run(tracker, [frame(0.1 * k, [handed_crossing(0.1 * k)], yaw=np.pi / 2, world_T_ego=EGO) for k in range(30)])
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
    x, y = handed_crossing(t)
    return (x + 1.0, y - 6.0)


def from_ahead(t):
    """Where the car is expected, but it comes from the other side."""
    return (24.0, handed_crossing(6.5)[1] - 5.0 * (t - 6.5))


def test_a_return_among_many_detections_gets_its_identity_with_the_next_ones():
    tracker, steps = handed_returning(beside)
    assert [detected_ids(tracks) for tracks in steps] == [[2], [2], [1], [1]]
    table = tracker._state.table
    assert 2 not in table.id, "the new track is no more"
    assert table.sensors.hits[0].tolist() == [34], "all detections count"
    assert tracker.assignment.id.tolist() == [1]
    np.testing.assert_allclose(steps[-1].boxes.position[0, :2], beside(6.8), atol=0.3)


def test_a_return_where_it_was_expected_gets_it_sooner_and_a_look_alike_never():
    assert [detected_ids(tracks) for tracks in handed_returning(handed_crossing)[1]] == [[2], [1], [1], [1]]
    assert [detected_ids(tracks) for tracks in handed_returning(from_ahead, 8)[1]] == [[2]] * 8
    off = replace(SETTINGS, association=AssociationSettings(clutter_area=3000.0, relink_above=1.0))
    assert [detected_ids(tracks) for tracks in handed_returning(handed_crossing, settings=off)[1]] == [[2]] * 4


def test_an_unresolved_track_hands_nothing_over():
    for unresolved, kept in ((0.0, False), (6.0, True)):
        tracker, _ = handed_returning(beside, 2)
        tracker._state.table.unresolved[1] = unresolved
        tracker.step(frame(6.7, [beside(6.7)], yaw=np.pi / 2, world_T_ego=EGO))
        assert (2 in tracker._state.table.id) == kept


@pytest.mark.parametrize("providers", [(), (Quiet(),)])
def test_the_journal_tells_of_it(providers):
    events = []
    tracker, _ = handed_returning(beside, 2, replace(SETTINGS, estimator="isam2"), providers)
    tracker.observer = Journal(SETTINGS, events.append)
    run(tracker, [frame(t, [beside(t)], yaw=np.pi / 2, world_T_ego=EGO) for t in (6.7, 6.8)])
    (event,) = [one for one in events if one["event"] == "deleted" and one["track"] == 2]
    assert event["reason"] == "it is the return of an earlier track"
