"""Tracks end when they can't be found again."""

import pytest

from saga_fg import ConstantVelocity, Tracker, TrackerSettings
from saga_fg.tracking import AssociationSettings, ClassSettings
from tests.saga_fg.traffic_frames import frame, run


def life(noise=1.0, score=0.9, seen=20, max_deviation=1.5, relink_above=0.9, **overall):
    """Time for which an object lives on after `seen` detections of its class, s."""
    classes = {"default": ClassSettings(motion=ConstantVelocity(acceleration_noise=noise), max_deviation=max_deviation)}
    association = AssociationSettings(relink_above=relink_above)
    tracker = Tracker(TrackerSettings(classes, edges=(), association=association, **overall))
    run(tracker, [frame(0.1 * k, (10.0, 0.0), score=score) for k in range(seen)])
    for k in range(1, 100):
        tracker.step(frame(0.1 * (seen - 1 + k), []))
        if len(tracker.snapshot().table) == 0:
            return 0.1 * k
    raise AssertionError("it lives for ever")


def test_a_well_known_object_is_remembered():
    assert life(noise=0.1) == pytest.approx(6.1)
    assert life(noise=0.1, max_coasting=3.0) == pytest.approx(3.1)


def test_an_object_that_may_be_anywhere_is_not():
    assert 1.1 < life(noise=20.0) < 4.0
    assert life(noise=200.0) < life(noise=20.0) < life(noise=2.0)


def test_without_relinking_the_deviation_alone_decides():
    for noise in (0.5, 2.0):  # of a position after t s: q t^3 / 3 and what is not known of the velocity
        until = life(noise=noise, max_deviation=2.0, relink_above=1.0)
        assert 0.6 * (12 / noise) ** (1 / 3) < until <= (12 / noise) ** (1 / 3) + 0.11
    assert life(noise=2.0, max_deviation=1.0, relink_above=1.0) < life(noise=2.0, max_deviation=3.0, relink_above=1.0)


def test_a_doubtful_object_ends_sooner_than_a_sure_one():
    assert life(score=0.12, seen=2) < life(seen=2) < life(seen=20)


def test_a_follower_of_a_leader_in_view_is_kept_and_reported_for_longer_than_a_car_alone():
    """Nothing but the leader keeps its place known."""
    ends = []
    for edges in ((), TrackerSettings().edges):
        tracker = Tracker(TrackerSettings(edges=edges, association=AssociationSettings(relink_above=1.0)))
        run(tracker, [frame(0.1 * k, [(1.0 * k + 15.0, 0.0), (1.0 * k, 0.0)]) for k in range(40)])
        led = run(tracker, [frame(0.1 * k, [(1.0 * k + 15.0, 0.0)]) for k in range(40, 110)])
        assert led[-1].id.tolist() == [1]
        ends.append(0.1 * sum(2 in tracks.id for tracks in led))
        told = [tracks.position_covariance[tracks.id == 2, 0, 0] for tracks in led]
        assert max(variance.max(initial=0.0) for variance in told) <= 1.5**2
    assert 1.0 < ends[0] < 1.8
    assert ends[1] > 1.3 * ends[0]
