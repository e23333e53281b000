"""Ghosts and the ranking of whole tracks, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from data_tools.metrics import SceneBoxes, track_summaries, whole_tracks
from saga_fg import Boxes
from saga_fg.types.boxes import bev_iou


def table(*tracks, size=(4.0, 2.0, 1.5)):
    """Tracks (id, [(frame, x, y)], score or scores, label): cars or others, of heading 0."""
    rows = [
        (frame, name, x, y, score, label)
        for name, places, scores, label in tracks
        for (frame, x, y), score in zip(places, np.broadcast_to(scores, len(places)).tolist(), strict=True)
    ]
    rows.sort(key=lambda row: row[0])
    boxes = Boxes.of(
        [row[5] for row in rows],
        [(row[2], row[3], 0.0) for row in rows],
        [size] * len(rows),
        [0.0] * len(rows),
    )
    names = np.array([row[1] for row in rows], dtype=str)
    return SceneBoxes(np.array([row[0] for row in rows], dtype=int), names, boxes, np.array([row[4] for row in rows]))


def drive(y, frames=range(4)):
    return [(k, 5.0 * k, y) for k in frames]


def car(name, y, score, frames=range(4), label="car"):
    return name, drive(y, frames), score, label


def summary(found, truth=None):
    return track_summaries(whole_tracks(table() if truth is None else truth, found))["overall"]


def test_of_two_overlapping_tracks_the_worse_is_a_ghost() -> None:
    found = table(car("a", 0.0, 0.9), car("b", 0.5, 0.3), car("c", 20.0, 0.1))
    tracks = whole_tracks(table(car("x", 0.0, 0.0), car("y", 20.0, 0.0)), found)
    by_score = np.argsort(-tracks.score)
    np.testing.assert_array_equal(tracks.ghost[by_score], [False, True, False])
    np.testing.assert_array_equal(tracks.true[by_score], [True, False, True])  # one label is for one track
    figures = track_summaries(tracks)
    assert (figures["car"].tracks, figures["car"].true, figures["car"].ghosts) == (3, 2, 1)
    assert figures["car"].ghost_share == pytest.approx(1 / 3)
    assert figures["car"].rank_quality == pytest.approx((1 + 2 / 3) / 2)
    assert figures["overall"] == figures["car"]


def test_other_classes_other_frames_and_touching_boxes_make_no_ghost() -> None:
    assert summary(table(car("a", 0.0, 0.9), car("b", 0.5, 0.3, label="truck"))).ghosts == 0
    late = ("b", [(k + 1, 5.0 * k, 0.0) for k in range(4)], 0.3, "car")  # at the place of `a`, a frame later
    assert summary(table(car("a", 0.0, 0.9), late)).ghosts == 0
    assert summary(table(car("a", 0.0, 0.9), car("b", 1.7, 0.3))).ghosts == 0  # IoU 0.08
    assert summary(table(car("a", 0.0, 0.9), car("b", 1.6, 0.3))).ghosts == 1  # IoU 0.11


def test_a_ghost_overlaps_at_more_than_half_of_its_frames() -> None:
    for frames, ghosts in ((range(2), 0), (range(3), 1)):
        assert summary(table(car("a", 0.0, 0.9, frames), car("b", 0.0, 0.3))).ghosts == ghosts


def test_of_equal_scores_the_shorter_track_is_the_ghost() -> None:
    tracks = whole_tracks(table(), table(car("a", 0.0, 0.7, range(3)), car("b", 0.0, 0.7, range(7))))
    assert tracks.score.tolist() == [0.7, 0.7]  # to the last bit: neither is ranked before the other
    assert tracks.ghost.tolist() == [True, False]


def test_a_score_is_the_mean_over_the_track() -> None:
    found = table(car("a", 0.0, [0.9, 0.1, 0.1, 0.1]), car("b", 0.0, 0.4))
    assert whole_tracks(table(), found).ghost.tolist() == [True, False]


def test_rank_quality() -> None:
    truth = table(car("x", 0.0, 0.0), car("y", 10.0, 0.0))
    for scores, quality in [
        ([0.9, 0.8, 0.2, 0.1], 1.0),  # true, true, false, false
        ([0.1, 0.2, 0.8, 0.9], (1 / 3 + 2 / 4) / 2),  # reversed
        ([0.9, 0.2, 0.8, 0.1], (1 / 1 + 2 / 3) / 2),
        ([0.5, 0.5, 0.5, 0.5], 0.5),  # scores that tell nothing: the share of true tracks
    ]:
        found = table(*(car(name, y, s) for name, y, s in zip("abcd", (0.0, 10.0, 30.0, 40.0), scores, strict=True)))
        assert summary(found, truth).rank_quality == pytest.approx(quality)


def test_a_true_track_matches_at_more_than_half_of_its_boxes() -> None:
    for frames, true in ((range(2), 0), (range(3), 1)):
        assert summary(table(car("a", 1.0, 0.9)), table(car("x", 0.0, 0.0, frames))).true == true


def test_an_identity_of_two_classes_is_two_tracks() -> None:
    found = table(car("a", 0.0, 0.9, range(2)), car("a", 0.0, 0.5, range(2, 4), label="truck"))
    figures = track_summaries(whole_tracks(table(car("x", 0.0, 0.0)), found))
    assert {label: (f.tracks, f.true) for label, f in figures.items()} == {
        "overall": (2, 1),
        "car": (1, 1),
        "truck": (1, 0),
    }


def test_without_tracks_or_true_ones_figures_are_undefined() -> None:
    nothing = summary(table(), table(car("x", 0.0, 0.0)))
    assert (nothing.tracks, nothing.true, nothing.ghosts) == (0, 0, 0)
    assert math.isnan(nothing.ghost_share)
    assert math.isnan(nothing.rank_quality)
    assert math.isnan(summary(table(car("a", 0.0, 0.9))).rank_quality)


def test_boxes_of_unknown_size_overlap_nothing() -> None:
    places = [car("a", 0.0, 0.9), car("b", 0.0, 0.3)]
    assert summary(table(*places, size=(math.nan,) * 3)).ghosts == 0
    assert summary(table(*places)).ghosts == 1


def test_every_pair_is_compared() -> None:
    """The same ghosts as from the IoU of all boxes of each frame."""
    rng = np.random.default_rng(3)
    rows = 400
    key = np.sort(rng.choice(20 * 40, rows, replace=False))
    frame, name = key // 40, key % 40
    label = np.where(name % 2, "bus", "pedestrian")
    size = np.where(name[:, None] % 2, (11.0, 2.9, 3.4), (0.7, 0.7, 1.8)) * rng.uniform(0.8, 1.2, (rows, 3))
    place = np.column_stack([rng.uniform(0, np.where(name % 2, 40, 3)), rng.uniform(0, 3, rows), np.zeros(rows)])
    boxes = Boxes.of(label, place, size, rng.uniform(-3, 3, rows))
    found = SceneBoxes(frame, name.astype(str), boxes, rng.random(40)[name])
    tracks = whole_tracks(table(), found)
    over = np.zeros(rows, dtype=bool)
    for k in range(20):
        at = np.flatnonzero(frame == k)
        better = found.score[None, at] > found.score[at, None]
        same = label[None, at] == label[at, None]
        over[at] = ((bev_iou(boxes.select(at), boxes.select(at)) > 0.1) & better & same).any(axis=1)
    expected = sum(over[name == n].mean() > 0.5 for n in np.unique(name))
    assert 0 < expected < len(tracks)
    assert tracks.ghost.sum() == expected
