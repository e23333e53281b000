"""Matching by likelihood: who may take which detection, and which one is preferred."""

import numpy as np
import pytest

from saga_fg import Boxes, Sensor, TrackerSettings
from saga_fg.numerics.assignment import CrossCovariances, cheapest_first, least_total
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.tracking.association import EXISTENCE_WEIGHT, SCORE_WEIGHT, ExpectedTracks, match
from saga_fg.tracking.measurements import FrameMeasurements

CAR = (4.0, 2.0, 1.5)


def boxes(x, label="car", yaw=0.0, y=0.0):
    n = len(x)
    position = np.stack([np.asarray(x, dtype=float), np.broadcast_to(y, n), np.zeros(n)], axis=-1)
    return Boxes.of(np.broadcast_to(label, n), position, np.tile(CAR, (n, 1)), np.broadcast_to(yaw, n).astype(float))


def measured(found, probability, noise=0.3):
    n = len(found)
    R = np.tile(noise**2 * np.eye(4), (n, 1, 1))
    flat = np.zeros(n)
    return FrameMeasurements(
        sensor=Sensor(),
        name="lidar",
        world_T_ego=None,
        boxes=found,
        row=np.arange(n),
        probability=np.broadcast_to(probability, n),
        R=R,
        by_model=np.ones(n, dtype=bool),
        with_velocity=flat.astype(bool),
        z_noise=flat,
        yaw_noise=flat,
        range_rate=np.full(n, np.nan),
        range_rate_variance=flat,
        covariance_scale=flat,
        position_bias=flat,
        class_likelihood=np.empty((n, 0)),
        identity=np.full(n, -1),
        viewpoint=None,
    )


def pairs(tracks, found, probability=0.9, expected=0.8, sigma=1.0, classes=None, shared=0.0, **association):
    """`shared`: the share of their variance that tracks have in common."""
    n = len(tracks)
    settings = TrackerSettings(
        classes or {"default": ClassSettings(max_distance=20.0)}, association=AssociationSettings(**association)
    )
    P = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    cross = CrossCovariances(*np.triu_indices(n, 1), np.tile(shared * sigma**2 * np.eye(2), (n * (n - 1) // 2, 1, 1)))
    expected_tracks = ExpectedTracks(tracks, P, np.broadcast_to(expected, n), np.ones(n), cross)
    matching, _ = match(expected_tracks, measured(found, probability), settings, settings.association.clutter_area)
    return sorted(zip(matching.track.tolist(), matching.detection.tolist(), strict=True))


def test_classes_keep_to_themselves():
    assert pairs(boxes([0.0, 10.0], ["car", "bus"]), boxes([10.0, 0.0], ["car", "bus"])) == []
    assert pairs(boxes([0.0, 10.0], ["car", "bus"]), boxes([0.1, 10.2], ["car", "bus"])) == [(0, 0), (1, 1)]


def test_without_an_area_all_that_is_inside_the_gate_is_matched():
    assert pairs(boxes([0.0]), boxes([3.5]), probability=0.01, expected=0.01) == [(0, 0)]
    assert pairs(boxes([0.0]), boxes([9.0])) == []


def test_a_track_that_nobody_believes_in_takes_no_detection_from_afar():
    for expected, matched in ((0.8, [(0, 0)]), (1e-6, [])):
        assert pairs(boxes([0.0]), boxes([3.0]), expected=expected, clutter_area=100.0) == matched
    assert pairs(boxes([0.0]), boxes([0.5]), expected=1e-6, clutter_area=100.0) == [(0, 0)]


def test_the_stronger_of_two_detections_is_preferred():
    found = boxes([0.5, -0.6])
    assert pairs(boxes([0.0]), found, [0.5, 0.5], clutter_area=1000.0) == [(0, 0)]
    assert pairs(boxes([0.0]), found, [0.1, 0.9], clutter_area=1000.0) == [(0, 1)]


def test_the_decision_is_that_of_the_likelihood_ratio():
    """A pair is matched where the track explains a detection better than a miss and a false alarm, each weighted."""
    p, r, density, S = 0.7, 0.6, 2e-3, 1.0 + 0.09
    a, b = EXISTENCE_WEIGHT, SCORE_WEIGHT
    limit = np.sqrt(2 * S * (a * np.log(r / (1 - r)) + b * np.log(p / (1 - p)) - np.log(2 * np.pi * density * S)))
    for x, matched in ((limit - 0.01, [(0, 0)]), (limit + 0.01, [])):
        weights = {"clutter_area": (1 - p) / density}
        assert pairs(boxes([0.0]), boxes([x]), p, r, **weights) == matched


def test_among_many_weak_detections_a_match_needs_to_be_nearer():
    """They say that the detector is wrong often."""
    crowd = boxes([2.5, *np.arange(50.0, 100.0)])
    for others, matched in ((0.9, [(0, 0)]), (0.05, [])):
        weights = {"clutter_area": 1000.0}
        assert pairs(boxes([0.0]), crowd, [0.5, *np.full(50, others)], **weights) == matched


@pytest.mark.parametrize(("method", "chosen"), [("hungarian", [(0, 0), (1, 1)]), ("greedy", [(1, 0)])])
def test_greed_takes_the_nearest_pair_first(method, chosen):
    assert pairs(boxes([0.0, 3.0]), boxes([2.0, 6.0]), method=method) == chosen


def test_the_graph_of_nothing_within_reach_is_empty():
    for tracks, found in ((boxes([0.0, 5.0]), boxes([90.0])), (boxes([0.0]), boxes([90.0])), (boxes([0.0]), boxes([]))):
        assert pairs(tracks, found, method="graph", shared=0.9) == []
    assert pairs(boxes([0.0]), boxes([0.1]), method="graph") == [(0, 0)]


ROW = np.arange(0.0, 25.0, 5.0)  # a group in a row, one behind the other


def test_a_group_that_is_displaced_as_one_keeps_its_order():
    """Everybody is nine tenths of the spacing further on: one by one, the detection of the one behind is nearer."""
    weights = {"sigma": 1.5, "clutter_area": 1e4}
    swapped, kept = [(k + 1, k) for k in range(4)], [(k, k) for k in range(5)]
    tracks, found = boxes(ROW), boxes(ROW + 4.5)
    assert [
        pair for pair in pairs(tracks, found, method="hungarian", shared=0.98, **weights) if pair in swapped
    ] == swapped
    assert pairs(tracks, found, method="graph", shared=0.98, **weights) == kept


def test_the_one_that_is_missed_leaves_the_others_where_they_are():
    weights = {"sigma": 1.5, "clutter_area": 1e4}
    seen = np.array([0, 1, 3, 4])
    chosen = pairs(boxes(ROW), boxes(ROW[seen] + 4.5), method="graph", shared=0.98, **weights)
    assert chosen == [(int(k), row) for row, k in enumerate(seen)]


def test_the_graph_ties_classes_together():
    """The bus has but one detection; that the cars moved alike says which is whose."""
    tracks, found = boxes([0.0, 5.0, 30.0], ["car", "car", "bus"]), boxes([4.0, 9.0, 34.0], ["car", "car", "bus"])
    weights = {"sigma": 3.0, "clutter_area": 1e4}
    assert pairs(tracks, found, method="graph", shared=0.98, **weights) == [(0, 0), (1, 1), (2, 2)]


def test_without_anything_in_common_the_graph_matches_as_hungarian():
    rng = np.random.default_rng(0)
    weights = {"sigma": 2.0, "clutter_area": 1e3}
    for _ in range(20):
        tracks, found = (
            boxes(rng.uniform(0, 15, 6), rng.choice(["car", "bus"], 6), y=rng.normal(size=6)) for _ in "ab"
        )
        assert pairs(tracks, found, method="graph", shared=0.0, **weights) == pairs(tracks, found, **weights)


def test_greedy_assignment_in_the_order_of_cost():
    row, column = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    cost = np.array([1.0, 2.0, 1.5, 9.0])
    assert cheapest_first(row, column, cost - 5.0).tolist() == [0]
    assert cheapest_first(row, column, cost - 10.0).tolist() == [0, 3]
    assert least_total(row, column, cost - 10.0).tolist() == [1, 2]
    assert len(cheapest_first(row[:0], column[:0], cost[:0])) == 0
