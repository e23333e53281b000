"""Ranks and ghosts of a result that is made by hand."""

import numpy as np
import pytest

from benchmarks.recording_sets import class_rows, rank_quality
from data_tools.metrics import NuScenesTrackingScene, SceneBoxes
from saga_fg import Boxes


def table(rows):
    """Boxes (frame, id, class, x, score) of a scene."""
    frame, id_, label, x, score = (np.array(column) for column in zip(*rows, strict=True))
    position = np.stack([x, np.zeros(len(x)), np.zeros(len(x))], axis=1).astype(float)
    boxes = Boxes.of(label, position, np.tile((4.0, 2.0, 1.5), (len(x), 1)), np.zeros(len(x)))
    return SceneBoxes(frame.astype(int), id_.astype(str), boxes, score.astype(float))


def test_rank_quality_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    true, false = rng.integers(0, 9, 40) + 2.0, rng.integers(0, 9, 60) + 0.0
    pairs = np.sign(true[:, None] - false)
    assert rank_quality(true, false) == pytest.approx((pairs > 0).mean() + (pairs == 0).mean() / 2)
    assert np.isnan(rank_quality(true, np.empty(0)))


def test_ghosts_are_counted_by_kind():
    truth = table([(k, "a", "car", 0.0, 0.0) for k in range(4)] + [(3, "b", "truck", 30.0, 0.0)])
    found = [(k, "1", "car", 0.1, 0.9) for k in range(4)]
    ghosts = [
        (3, "2", "car", 1.5, 0.9),
        (3, "3", "car", 30.0, 0.9),
        (3, "4", "car", 15.0, 0.9),
        (3, "5", "car", -15.0, 0.9),
    ]
    seen = table([(3, f"d{x}", "car", x, 0.0) for x in (0.1, 30.0, 15.0)])
    tracks = table([*found, *ghosts])
    scene = NuScenesTrackingScene(np.arange(4.0), np.zeros((4, 2)), truth, tracks)
    (row,) = [row for row in class_rows([scene], [(seen.frame, seen.boxes)]) if row["class"] == "car"]
    assert {kind: row[kind] for kind in ("beside", "other class", "clutter", "coasting")} == {
        "beside": 1,
        "other class": 1,
        "clutter": 1,
        "coasting": 1,
    }
    assert row["rank"] == 0.5
    assert row["left out"] == "-"


def test_frames_with_two_classes_are_judged_by_the_means_of_tracks():
    objects = [(k, *rest) for k in range(8) for rest in (("a", "car", 0.0, 0.9), ("b", "truck", 30.0, 0.5))]
    truth = table(objects)

    def shares(*scores):
        ghost = [(k, "c", "truck", 0.5, scores[k % 2]) for k in range(4)]
        found = table(sorted([*objects, *ghost]))
        scene = NuScenesTrackingScene(np.arange(8.0), np.zeros((8, 2)), truth, found)
        rows = {row["class"]: row for row in class_rows([scene], [(truth.frame, truth.boxes)])}
        return rows["mean"]["frames with two classes"], rows["truck"]["other class"]

    assert shares(0.6, 0.1) == ("0.000 (0.000)", 0)
    assert shares(0.9, 0.4) == ("0.500 (0.000)", 4)
