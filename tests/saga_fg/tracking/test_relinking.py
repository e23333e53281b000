"""Objects that return after some seconds keep their identity; others don't take it."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, InputError, Tracker, TrackerSettings
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.tracking.relinking import relinkable
from tests.saga_fg.traffic_frames import columns, frame, run

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


def test_a_car_behind_a_van_for_four_seconds_stays_the_same():
    assert returning(SETTINGS, crossing, crossing, others=[VAN]) == [1, 2]
    assert returning(OFF, crossing, crossing, others=[VAN]) == [1, 3]


def test_a_parked_car_stays_the_same():
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


def test_another_class_does_not_take_it():
    tracker = Tracker(SETTINGS)
    run(tracker, [frame(0.1 * k, [(20.0, 5.0)]) for k in range(30)])
    run(tracker, [frame(0.1 * k, []) for k in range(30, 60)])
    tracks = tracker.step(frame(6.0, [(20.0, 5.0)], label="truck"))
    assert tracks.id[tracks.coasting == 0].tolist() == [2]


def test_a_probability_of_zero_is_refused():
    with pytest.raises(InputError, match="relink_above: expected a number above 0 to 1"):
        AssociationSettings(relink_above=0.0)


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


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_estimators_agree(estimator):
    frames = [frame(0.1 * k, [VAN, *([crossing(0.1 * k)] if not 30 <= k < 65 else [])]) for k in range(80)]
    expected = run(Tracker(SETTINGS), frames)
    found = run(Tracker(replace(SETTINGS, estimator=estimator)), frames)
    assert expected[-1].id.tolist() == [1, 2]
    for a, b in zip(expected, found, strict=True):
        assert a.id.tolist() == b.id.tolist()
        np.testing.assert_allclose(a.boxes.position, b.boxes.position, atol=1e-6)


def test_a_relinked_track_is_updated_as_any_other():
    """A tracker that assigns the return at once, as its gate is wide, has the same state."""
    wide = replace(SETTINGS, classes={"default": replace(SETTINGS.classes["default"], max_deviation=20.0)})
    everything = replace(wide, association=AssociationSettings(relink_above=1.0))
    frames = [frame(0.1 * k, [crossing(0.1 * k)] if not 30 <= k < 65 else []) for k in range(66)]
    relinked, assigned = run(Tracker(SETTINGS), frames)[-1], run(Tracker(everything), frames)[-1]
    assert columns(relinked)["position"] == columns(assigned)["position"]
    assert relinked.id.tolist() == assigned.id.tolist() == [1]


def test_without_relinking_none_can_be():
    tracker = Tracker(OFF)
    run(tracker, [frame(0.1 * k, [(20.0, 5.0)]) for k in range(30)])
    assert not relinkable(tracker._state).any()
