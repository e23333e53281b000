"""Detections, online tracks and labels side by side: recall, errors on the same boxes, self-consistency."""

from __future__ import annotations

import numpy as np
import pytest

from data_tools.metrics import SceneBoxes
from data_tools.metrics.labels import (
    CommonBoxes,
    LabelledScene,
    common_boxes,
    precision_recall,
    scored_pairs,
    self_consistency,
)
from saga_fg.types.boxes import Boxes


def table(
    frame: list[int],
    ids: list[str],
    x: list[float],
    score: list[float] | None = None,
    variance: float | None = None,
    yaw: list[float] | None = None,
) -> SceneBoxes:
    """Cars at (x, 0)."""
    n = len(ids)
    position = np.column_stack([x, np.zeros(n), np.zeros(n)])
    boxes = Boxes.of(["car"] * n, position, np.tile([4.0, 2.0, 1.5], (n, 1)), yaw or np.zeros(n), np.zeros((n, 2)))
    P = np.empty((0, 2, 2)) if variance is None else np.tile(variance * np.eye(2), (n, 1, 1))
    return SceneBoxes(np.array(frame), np.array(ids), boxes, np.array(score or [0.0] * n), P)


TRUTH = table([0, 0, 1], ["a", "b", "a"], [0.0, 10.0, 1.0])


def test_the_surer_box_takes_the_object_and_hidden_objects_count_neither_way() -> None:
    found = table([0, 0, 0, 1], ["1", "2", "3", "1"], [0.1, 0.4, 10.3, 9.0], [0.3, 0.9, 0.8, 0.5])
    pairs = scored_pairs(TRUTH, np.array([True, False, True]), found, 1.0)
    assert pairs.objects == 2
    assert sorted(zip(pairs.score.tolist(), pairs.true.tolist(), strict=True)) == [
        (0.3, False),
        (0.5, False),
        (0.9, True),
    ]


def test_the_curve_runs_from_the_surest_box_to_all_of_them() -> None:
    found = table([0, 0, 0, 1], ["1", "2", "3", "1"], [0.0, 10.0, 50.0, 1.0], [0.9, 0.7, 0.7, 0.2])
    curve = precision_recall([scored_pairs(TRUTH, np.ones(3, dtype=bool), found, 2.0)])
    assert curve.recall.tolist() == pytest.approx([1 / 3, 2 / 3, 1.0])  # the two of equal score come together
    assert curve.precision.tolist() == pytest.approx([1.0, 2 / 3, 3 / 4])
    assert curve.whole == pytest.approx((0.75, 1.0))
    assert curve.best == pytest.approx((0.75, 1.0))
    assert curve.recall_at(0.7) == 1.0
    assert curve.recall_at(0.9) == pytest.approx(1 / 3)


def test_nothing_found_is_no_recall() -> None:
    curve = precision_recall([scored_pairs(TRUTH, np.ones(3, dtype=bool), table([], [], []), 2.0)])
    assert curve.whole[1] == 0.0
    assert curve.recall_at(0.5) == 0.0


def test_systems_are_compared_where_all_have_a_box() -> None:
    systems = {
        "one": table([0, 0, 1], ["1", "2", "1"], [0.3, 10.0, 1.0], variance=0.09),
        "other": table([0, 1], ["1", "1"], [0.1, 1.0], variance=0.09),
    }
    scene = LabelledScene(TRUTH, np.array([True, True, False]), np.zeros((3, 2)), np.array([5.0, 15.0, 6.0]), systems)
    same = common_boxes(scene, 2.0)
    assert same.distance.tolist() == [5.0, 6.0]
    assert same.visible.tolist() == [True, False]
    assert same.sample("one", "position").values.tolist() == pytest.approx([0.3, 0.0])
    assert same.sample("one", "nees").values.tolist() == pytest.approx([1.0, 0.0])
    pooled = CommonBoxes.concatenate([same, same])
    assert len(pooled) == 4
    assert pooled.sample("one", "position").rmse == pytest.approx(0.3 / np.sqrt(2))
    assert np.isnan(pooled.select(pooled.distance > 100).sample("one", "position").rmse)


def test_a_box_stays_with_the_visible_object() -> None:
    truth = table([0, 0], ["a", "b"], [0.0, 0.5])
    systems = {"one": table([0], ["1"], [0.4])}
    same = common_boxes(LabelledScene(truth, np.array([True, False]), np.zeros((2, 2)), np.zeros(2), systems), 2.0)
    assert same.sample("one", "position").values.tolist() == pytest.approx([0.4])
    assert same.visible.all()


def test_the_box_of_a_neighbour_is_not_that_of_the_object() -> None:
    truth = table([0, 0, 1, 1, 2], ["a", "b", "a", "b", "a"], [0.0, 1.5, 0.0, 1.5, 0.0])
    systems = {"one": table([0, 0, 1, 1, 2], ["1", "2", "1", "2", "2"], [0.1, 1.5, 0.1, 1.5, 1.5])}
    same = common_boxes(LabelledScene(truth, np.ones(5, dtype=bool), np.zeros((5, 2)), np.zeros(5), systems), 2.0)
    assert same.sample("one", "position").values.tolist() == pytest.approx([0.1, 0.0, 0.1, 0.0])


def test_self_consistency_sees_jumps_turns_and_gaps() -> None:
    times = np.arange(5) * 0.5
    steady = self_consistency(table([0, 1, 2, 3, 4], ["1"] * 5, [0.0, 1.0, 2.0, 3.0, 4.0]), times)
    assert (steady.objects, steady.boxes, steady.turned, steady.gaps) == (1, 5, 0.0, 0.0)
    assert steady.jerkiness == pytest.approx(0.0, abs=1e-12)
    restless = self_consistency(table([0, 1, 3, 4], ["1"] * 4, [0.0, 1.0, 0.0, 4.0], yaw=[0.0, 3.1, 3.1, 0.0]), times)
    assert restless.turned == pytest.approx(2 / 3)
    assert restless.gaps == pytest.approx(1 / 5)
    assert restless.jerkiness > 3.0


def test_the_residual_is_one_for_detections_around_the_truth() -> None:
    rng = np.random.default_rng(0)
    found = table([0] * 500, [str(k) for k in range(500)], (10.0 * np.arange(500)).tolist())
    sigma = 0.3
    noise = np.column_stack([rng.normal(0, sigma, (500, 2)), np.zeros(500)])
    boxes = Boxes.of(["car"] * 500, found.boxes.position + noise)
    R = np.tile(sigma**2 * np.eye(2), (500, 1, 1))
    figures = self_consistency(found, np.zeros(1), (np.zeros(500, dtype=np.int64), boxes, R))
    assert figures.residual == pytest.approx(1.0, abs=0.15)
