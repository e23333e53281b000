"""Existence by Bayes' rule, and what it makes of a track's score."""

import numpy as np
import pytest

from saga_fg.tracking import ExistenceSettings
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.existence import after_hit, after_miss, reported_score

SETTINGS = ExistenceSettings(lifetime=np.inf)


def columns(score, hits, looks, existence=0.9):
    score = np.atleast_1d(np.asarray(score, dtype=float))
    label, told, confirmed = np.full(len(score), "car"), (score, score), np.zeros(len(score), dtype=bool)
    table = TrackColumns.born(np.arange(len(score)), label, score, told, 0.0, 0.0, confirmed, True)
    table.hits, table.looks = np.broadcast_to(hits, len(score)) * 1.0, np.broadcast_to(looks, len(score)) * 1.0
    table.existence = np.full(len(score), existence)
    return table


def test_a_miss_is_the_likelier_the_less_the_track_exists():
    r = np.array([0.1, 0.5, 0.9])
    expected = r * 0.1 / (r * 0.1 + (1 - r))
    assert after_miss(r, np.full(3, 0.9), 1.0, SETTINGS) == pytest.approx(expected)
    assert after_miss(r, np.zeros(3), 1.0, SETTINGS) == pytest.approx(r), "nobody looked"
    assert after_miss(r, np.zeros(3), 2.0, ExistenceSettings(lifetime=4.0)) == pytest.approx(r * np.exp(-0.5))


def test_a_detection_as_probable_as_clutter_says_nothing():
    r = np.array([0.2, 0.7])
    assert after_hit(r, np.full(2, SETTINGS.neutral_score), SETTINGS) == pytest.approx(r)
    assert (after_hit(r, np.full(2, 0.9), SETTINGS) > r).all()
    assert (after_hit(r, np.full(2, 0.05), SETTINGS) < r).all()


def test_the_score_is_the_detections_unless_told_otherwise():
    seen, coasting = np.zeros(2, dtype=bool), np.ones(2, dtype=bool)
    table = columns([0.4, 0.8], 1, 5)
    assert reported_score(table, seen, SETTINGS) == pytest.approx([0.4, 0.8])
    assert reported_score(table, coasting, SETTINGS) == pytest.approx([0.36, 0.72])
    assert reported_score(table, coasting, ExistenceSettings(coasting_score_factor=0.5)) == pytest.approx([0.18, 0.36])


def test_a_steady_track_scores_higher_than_a_new_or_a_flickering_one():
    settings = ExistenceSettings(prior_opportunities=1.0, hit_ratio_weight=0.5)
    steady, new, flickering = (
        float(reported_score(columns(0.6, hits, looks), np.zeros(1, dtype=bool), settings)[0])
        for hits, looks in ((9, 9), (1, 1), (4, 9))
    )
    assert steady == pytest.approx(0.6 * np.sqrt(0.9))
    assert steady > new > flickering
