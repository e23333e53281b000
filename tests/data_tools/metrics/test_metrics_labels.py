"""Errors at labels: by hand, and the laws of pairing."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from data_tools.metrics import (
    SceneBoxes,
    calibration,
    error_summary,
    label_errors,
    label_velocities,
)
from data_tools.metrics.scene_boxes import nearest_pairs
from saga_fg import Boxes


def table(rows, covariance=None):
    """Rows (frame, id, x, y) or (frame, id, x, y, {label, yaw, v})."""
    full = [((*row, {})[:5]) for row in rows]
    boxes = Boxes.of(
        [o.get("label", "car") for *_, o in full],
        [(x, y, 0.0) for _, _, x, y, _ in full],
        [(4.0, 2.0, 1.5)] * len(full),
        [o.get("yaw", 0.0) for *_, o in full],
        [o.get("v", (math.nan, math.nan)) for *_, o in full],
    )
    frame, names = np.array([row[0] for row in full]), np.array([row[1] for row in full], dtype=str)
    given = {} if covariance is None else {"position_covariance": np.tile(covariance, (len(full), 1, 1))}
    return SceneBoxes(frame, names, boxes, np.ones(len(full)), **given)


def errors(truth, found, detections=None, covariance=None, reach=1):
    labels = table(truth)
    velocity = label_velocities(labels, np.arange(40) * 0.5, reach)
    seen = None if detections is None else (table(detections).frame, table(detections).boxes)
    return label_errors(labels, table(found, covariance), velocity, seen)


DRIVE = [(k, "a", 2.0 * k, 0.0) for k in range(5)]  # 4 m/s
PARKED = [(k, "p", 50.0, 0.0) for k in range(5)]


def test_velocities_count_where_labels_have_one_on_either_side_and_tracks_know_them():
    labels = table([*DRIVE[:3], (3, "b", 0.0, 9.0), DRIVE[4]])
    velocity = label_velocities(labels, np.arange(5) * 0.5, 1)
    np.testing.assert_array_equal(velocity, [[np.nan] * 2, [4, 0], [np.nan] * 2, [np.nan] * 2, [np.nan] * 2])
    np.testing.assert_array_equal(label_velocities(labels, np.arange(5) * 0.5, 2)[2], [4, 0])
    assert label_velocities(table([]), np.arange(5), 5).shape == (0, 2)
    truth = sorted([*DRIVE, *PARKED], key=lambda row: row[0])
    found = [(k, name, x, y, {"v": (1.0, 0.0)}) for k, name, x, y in truth]
    f = error_summary(errors(truth, found))
    assert f.velocity_parked == pytest.approx(1.0)
    assert f.velocity_moving == pytest.approx(3.0)
    assert f.velocity == pytest.approx(math.sqrt(5.0))
    found = [(k, "7", 2.0 * k, 0.0, {"v": (4.0, 1.0) if k > 1 else (math.nan, math.nan)}) for k in range(5)]
    f = error_summary(errors(DRIVE, found))
    assert f.velocity_unknown == 1  # the first label and the last have no velocity themselves
    assert f.velocity == pytest.approx(1.0)


def test_errors_by_hand():
    found = [(k, "7", 2.0 * k, 0.3, {"v": (4.0, 0.5), "yaw": 0.2 if k else np.pi - 0.1}) for k in range(5)]
    e = errors(DRIVE, found)
    f = error_summary(e)
    assert (f.labels, f.tracked) == (5, 5)
    assert f.position == pytest.approx(0.3)
    assert f.velocity == f.velocity_moving == pytest.approx(0.5)
    assert math.isnan(f.velocity_parked)
    assert math.isnan(f.detection)
    assert f.flipped == pytest.approx(0.2)
    assert f.heading == pytest.approx(math.sqrt((4 * 0.2**2 + (math.pi - 0.1) ** 2) / 5))


def test_only_what_detections_match_counts_and_covariances_are_needed_for_calibration():
    found = [(k, "7", 2.0 * k + 0.2, 0.0) for k in range(4)]  # none at the last
    seen = [(k, "d", 2.0 * k, 0.1 if k != 2 else 5.0) for k in range(5)]  # not at the third
    f = error_summary(errors(DRIVE, found, seen))
    assert (f.labels, f.tracked) == (4, 3)
    assert f.position == pytest.approx(0.2)
    assert f.detection == pytest.approx(0.1)
    c = calibration(errors(DRIVE, DRIVE))
    assert c.boxes == 0
    assert math.isnan(c.anees)


def test_calibration_of_errors_drawn_from_the_covariance():
    rng = np.random.default_rng(0)
    P = np.array([[0.09, 0.03], [0.03, 0.04]])
    rows = [(k, str(n), 20.0 * n, 5.0 * k) for k in range(40) for n in range(60)]
    shaken = np.array([row[2:] for row in rows]) + rng.multivariate_normal(np.zeros(2), P, len(rows))
    found = [(k, n, x, y) for (k, n, *_), (x, y) in zip(rows, shaken, strict=True)]
    c = calibration(errors(rows, found, covariance=P))
    assert c.enough_data
    assert c.consistent
    assert c.anees == pytest.approx(1, abs=0.1)
    assert c.median_nees == pytest.approx(1, abs=0.1)
    for p, share in c.coverage.items():
        assert share == pytest.approx(p, abs=0.03)
    overconfident = calibration(errors(rows, found, covariance=P / 4))
    assert not overconfident.consistent
    assert overconfident.coverage[0.9] == pytest.approx(chi2.cdf(chi2.ppf(0.9, 2) / 4, 2), abs=0.03)
    assert not calibration(errors(rows[:100], found[:100], covariance=P)).enough_data


@given(st.integers(0, 10_000))
def test_pairs_are_as_many_as_can_be_and_the_nearest_of_these(seed):
    rng = np.random.default_rng(seed)
    sides = []
    for count in rng.integers(0, 12, 2):
        frame = np.sort(rng.integers(0, 3, count))
        labels = rng.choice(["car", "bus"], count).tolist()
        sides.append((frame, Boxes.of(labels, 1e6 + rng.uniform(0, 6, (count, 3)))))
    a, b = sides
    row, column, distance = nearest_pairs(a, b, 2.0)
    assert len(set(row.tolist())) == len(row)
    assert len(set(column.tolist())) == len(column)
    apart = np.linalg.norm(a[1].position[:, None, :2] - b[1].position[None, :, :2], axis=2)
    np.testing.assert_allclose(distance, apart[row, column], atol=1e-9)
    same = (a[0][:, None] == b[0]) & (a[1].label[:, None] == b[1].label) & (apart <= 2.0)
    assert same[row, column].all()
    if same.any():
        cost = np.where(same, apart, 1000.0)
        best = linear_sum_assignment(cost)
        assert same[best].sum() == len(row)
        assert np.where(same, apart, 0.0)[best].sum() == pytest.approx(distance.sum())
