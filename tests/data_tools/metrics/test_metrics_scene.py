"""Metrics of any scene."""

import math

import numpy as np
import pytest

from data_tools.metrics import (
    SceneMetrics,
    coverage,
    match_scene,
    nees,
    scene_metrics,
    scene_metrics_by_label,
)
from saga_fg import Annotations, Boxes, InputError, Tracks


def truth(objects, hidden=()):
    """Annotations from {name: (x, y)} or {name: (x, y, vx, vy)}; class "car", "pedestrian" for names in lower case."""
    names = list(objects)
    rows = [(*objects[n], math.nan, math.nan)[:4] for n in names]
    return Annotations(
        np.array(names, dtype=str),
        Boxes.of(
            ["car" if n.isupper() else "pedestrian" for n in names],
            [(x, y, 0.0) for x, y, _, _ in rows],
            yaw=[0.1] * len(names),
            velocity=[(vx, vy) for _, _, vx, vy in rows],
        ),
        np.array([n not in hidden for n in names], dtype=bool),
    )


def tracks(found, label="car", variance=1.0):
    """Tracks from {id: (x, y)} or {id: (x, y, vx, vy)}."""
    n = len(found)
    rows = [(*v, 0.0, 0.0)[:4] for v in found.values()]
    return Tracks(
        0.0,
        np.array(list(found), dtype=np.int64),
        Boxes.of(
            [label] * n,
            [(x, y, 0.0) for x, y, _, _ in rows],
            yaw=[-0.1] * n,
            velocity=[(vx, vy) for _, _, vx, vy in rows],
        ),
        np.ones(n),
        np.tile(variance * np.eye(2), (n, 1, 1)),
        np.tile(np.eye(2), (n, 1, 1)),
        np.zeros(n),
    )


def test_counts_by_hand():
    # Moment 1: A found 1 m off, B missed. Moment 2: A found by another track (switch), B found, one track in the void.
    gt = [truth({"A": (0, 0), "B": (50, 0)}), truth({"A": (0, 0), "B": (50, 0)})]
    found = [tracks({1: (1, 0)}), tracks({2: (0, 0), 3: (50, 1), 4: (90, 0)})]
    m = scene_metrics(gt, found)
    assert (m.objects, m.matches, m.misses, m.false_positives, m.switches) == (4, 3, 1, 1, 1)
    assert m.mota == pytest.approx(1 - 3 / 4)
    assert m.motp == m.position.mean == pytest.approx(2 / 3)
    assert m.position.rmse == pytest.approx(math.sqrt(2 / 3))
    assert m.position.median == pytest.approx(1.0)
    assert len(m.velocity) == 0  # the truth has none
    assert math.isnan(m.velocity.rmse)


def test_an_object_keeps_its_track_within_the_gate_and_through_a_gap():
    gt = [truth({"A": (0, 0)}), truth({"A": (0, 0)}), truth({"A": (0, 0)})]
    found = [tracks({1: (0, 0)}), tracks({1: (1.5, 0), 2: (0, 0)}), tracks({1: (2.5, 0), 2: (0, 0)})]
    assert scene_metrics(gt[:2], found[:2]).switches == 0
    matchings = match_scene(gt, found)
    assert [m.distance.tolist() for m in matchings] == [[0.0], [1.5], [0.0]]
    assert [m.switched.tolist() for m in matchings] == [[False], [False], [True]]
    gt = [truth({"A": (0, 0)})] * 3
    found = [tracks({1: (0, 0)}), tracks({}), tracks({2: (0, 0)})]
    assert scene_metrics(gt, found).switches == 1
    assert scene_metrics(gt, [found[0], found[1], found[0]]).switches == 0


def test_two_objects_that_claim_one_track_share_it_out_to_the_nearer():
    gt = [truth({"A": (0, 0)}), truth({"B": (1, 0)}), truth({"A": (0, 0), "B": (1, 0)})]
    found = [tracks({1: (0, 0)}), tracks({1: (1, 0)}), tracks({1: (0.9, 0), 2: (0.3, 0)})]
    last = match_scene(gt, found)[-1]
    assert last.object_row.tolist() == [0, 1]
    assert last.track_row.tolist() == [1, 0]
    assert last.switched.tolist() == [True, False]


def test_the_assignment_makes_as_many_pairs_as_the_gate_allows_within_a_class():
    # Nearest first would pair A with 1 (distance 0.5) and leave B without a partner.
    gt = [truth({"A": (0, 0), "B": (2, 0)})]
    found = [tracks({1: (0.5, 0), 2: (-1.9, 0)})]
    pairs = match_scene(gt, found)[0]
    assert pairs.track_row.tolist() == [1, 0]
    assert scene_metrics([truth({"a": (0, 0)})], [tracks({1: (0, 0)})]).matches == 0


def test_by_label_pools_to_the_whole():
    gt = [truth({"A": (0, 0), "a": (1, 0)}), truth({"A": (1, 0), "a": (1, 1)}, hidden=("a",))]
    found = [tracks({1: (0.2, 0), 2: (1, 0.5)}), tracks({2: (1, 0)}, label="pedestrian")]
    parts = scene_metrics_by_label(gt, found)
    assert sorted(parts) == ["car", "pedestrian"]
    whole, pooled = scene_metrics(gt, found), SceneMetrics.pool(parts.values())
    for name in ("objects", "hidden_objects", "matches", "hidden_matches", "false_positives", "switches"):
        assert getattr(whole, name) == getattr(pooled, name), name
    assert sorted(whole.position.values) == sorted(pooled.position.values)


def test_hidden_objects_are_no_misses_but_their_errors_count():
    gt = [truth({"A": (0, 0, 1, 0)}), truth({"A": (1, 0, 1, 0)}, hidden="A"), truth({"A": (2, 0, 1, 0)}, hidden="A")]
    found = [tracks({1: (0, 0, 1, 0)}), tracks({1: (1.5, 0, 2, 0)}), tracks({})]
    m = scene_metrics(gt, found)
    assert (m.objects, m.hidden_objects, m.matches, m.hidden_matches) == (1, 2, 1, 1)
    assert (m.misses, m.false_positives) == (0, 0)
    assert m.hidden_recall == 0.5
    assert m.hidden_position.values.tolist() == [0.5]
    assert m.hidden_velocity.values.tolist() == [1.0]
    assert m.carried.values.tolist() == [0.5, 5.0]  # alive, then lost


def test_carried_error_follows_the_track_that_last_saw_the_object():
    gt = [
        truth({"A": (0, 0), "B": (50, 0)}, hidden="B"),  # B never seen: not carried by anybody
        truth({"A": (0, 0), "B": (50, 0)}, hidden="AB"),
        truth({"A": (0, 0), "B": (50, 0)}, hidden="AB"),
    ]
    found = [
        tracks({1: (0, 0)}),
        tracks({1: (3, 0), 2: (0, 0)}),  # track 2 is on the spot, but does not know that this is A
        tracks({1: (30, 0), 2: (0, 0)}),
    ]
    assert scene_metrics(gt, found).carried.values.tolist() == [3.0, 5.0]


def test_nees_uses_the_covariance_of_the_track_if_there_is_one():
    m = scene_metrics([truth({"A": (0, 0)})], [tracks({1: (1, 1)}, variance=0.5)])
    assert m.nees.values == pytest.approx([4.0])
    assert len(scene_metrics([truth({"A": (0, 0)})], [tracks({1: (1, 1)}, variance=0.0)]).nees) == 0
    values = nees(np.ones((3, 2)), np.stack([np.zeros((2, 2)), np.diag([1.0, 0.0]), np.eye(2)]))
    assert np.isnan(values[:2]).all()
    assert values[2] == pytest.approx(2.0)


def test_empty_scenes_and_moments_that_differ():
    m = scene_metrics([truth({})], [tracks({})])
    assert math.isnan(m.mota)
    assert math.isnan(m.recall)
    pooled = SceneMetrics.pool([])
    assert pooled.objects == 0
    assert len(pooled.carried) == 0
    assert scene_metrics([], []).objects == 0
    with pytest.raises(InputError, match=r"expected one entry per frame of the ground truth \(1\), got 2"):
        scene_metrics([truth({})], [tracks({}), tracks({})])


# Consistency figures


def test_nees_of_consistent_estimates_lies_in_its_band():
    rng = np.random.default_rng(4)
    L = rng.normal(size=(500, 2, 2))
    covariance = L @ np.swapaxes(L, 1, 2) + 0.1 * np.eye(2)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(500, 2)))
    values = nees(error, covariance)
    assert abs(values.mean() - 2) < 4 * np.sqrt(4 / 500)  # chi-squared with 2 degrees of freedom
    assert nees(2 * error, covariance) == pytest.approx(4 * values)
    for p in (0.5, 0.9, 0.99):
        assert abs(coverage(values, p) - p) < 4 * np.sqrt(p * (1 - p) / 500)
