"""Tracks end when they can't be found again."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Tracker, TrackerSettings
from saga_fg.tracking import AssociationSettings, ClassSettings
from tests.saga_fg.traffic_frames import frame, run


def life(noise=1.0, score=0.9, seen=20, **association):
    """Time for which an object lives on after `seen` detections of its class, s."""
    motion = ConstantVelocity(acceleration_noise=noise)
    classes = {"default": ClassSettings(motion=motion, max_coasting=1.0)}
    tracker = Tracker(TrackerSettings(classes, edges=(), association=AssociationSettings(**association)))
    run(tracker, [frame(0.1 * k, (10.0, 0.0), score=score) for k in range(seen)])
    for k in range(1, 100):
        tracker.step(frame(0.1 * (seen - 1 + k), []))
        if len(tracker.snapshot().table) == 0:
            return 0.1 * k
    raise AssertionError("it lives for ever")


def test_a_well_known_object_is_remembered():
    assert life(noise=0.1) == pytest.approx(6.1)
    assert life(noise=0.1, relink_within=3.0) == pytest.approx(3.1)


def test_an_object_that_may_be_anywhere_is_not():
    assert 1.1 < life(noise=20.0) < 4.0
    assert life(noise=200.0) < life(noise=20.0) < life(noise=2.0)


def test_without_relinking_all_end_alike():
    assert life(noise=0.1, relink_above=1.0) == life(noise=20.0, relink_above=1.0) == pytest.approx(1.1)


def test_a_doubtful_object_ends_sooner_than_a_sure_one():
    assert life(score=0.12, seen=2) < life(seen=2) < 1.2 < life(seen=3)


def test_the_end_of_one_changes_no_other():
    tracker = Tracker(TrackerSettings(edges=(), association=AssociationSettings(relink_above=1.0)))
    both = [frame(0.1 * k, [(0.0, 0.0), (20.0, 0.1 * k)]) for k in range(10)]
    run(tracker, both)
    later = run(tracker, [frame(0.1 * k, [(0.0, 0.0)]) for k in range(10, 40)])
    assert later[-1].id.tolist() == [1]
    assert np.isfinite(later[-1].position_covariance).all()
