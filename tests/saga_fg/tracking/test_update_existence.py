"""Existence by Bayes' rule, and what it makes of a track's score."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import load_config
from saga_fg.kernels.components import existences
from saga_fg.tracking import ExistenceSettings
from saga_fg.tracking.reporting import LASTING_SHARE, reported_score
from saga_fg.tracking.track_table import SensorEvidence, TrackTable
from saga_fg.tracking.tracker_state import LIFETIME
from tests.saga_fg.traffic_frames import frame

SETTINGS = ExistenceSettings()


def score(probability, hits, opportunities, coasting=False, existence=0.9, settings=SETTINGS, best=0.0):
    """Reported scores of tracks with these attributes."""
    probability = np.atleast_1d(np.asarray(probability, dtype=float))
    n = len(probability)
    sensors = SensorEvidence.empty(n, ["lidar"])
    sensors.hits[:], sensors.opportunities[:] = hits, opportunities
    best = np.maximum(probability, best)
    table = replace(
        TrackTable.empty(), existence=np.full(n, existence), score=probability, best_score=best, sensors=sensors
    )
    return reported_score(table, np.arange(n), np.full(n, coasting), settings)


def after_miss(r, p_detect, elapsed, settings):
    none = np.empty(0, dtype=np.int64), np.empty(0)
    missed, survival = np.ones(len(r), dtype=bool), np.exp(-elapsed / LIFETIME)
    return existences(r, missed, p_detect, *none, survival, settings.neutral_score)


def after_hit(r, probability, settings):
    missed, every = np.zeros(len(r), dtype=bool), np.arange(len(r))
    return existences(r, missed, np.zeros(len(r)), every, probability, 1.0, settings.neutral_score)


def test_a_miss_is_the_likelier_the_less_the_track_exists():
    r = np.array([0.1, 0.5, 0.9])
    expected = r * 0.1 / (r * 0.1 + (1 - r))
    assert after_miss(r, np.full(3, 0.9), 0.0, SETTINGS) == pytest.approx(expected)
    assert after_miss(r, np.zeros(3), 2.0, SETTINGS) == pytest.approx(r * np.exp(-2.0 / LIFETIME)), "nobody looked"


def test_a_detection_as_probable_as_clutter_says_nothing():
    r = np.array([0.2, 0.7])
    assert after_hit(r, np.full(2, SETTINGS.neutral_score), SETTINGS) == pytest.approx(r)
    assert (after_hit(r, np.full(2, 0.9), SETTINGS) > r).all()
    assert (after_hit(r, np.full(2, 0.05), SETTINGS) < r).all()


def test_the_score_is_the_detections_unless_set_otherwise():
    assert score([0.4, 0.8], 1, 5) == pytest.approx([0.4, 0.8])
    assert score([0.4, 0.8], 1, 5, coasting=True) == pytest.approx([0.36, 0.72])


@pytest.mark.parametrize("family", ["kitti", "nuscenes"])
def test_two_short_gaps_do_not_push_an_object_below_a_false_track(family):
    config = load_config(family)
    tracker, dt = config.new_tracker("saga"), 0.5 if family == "nuscenes" else 0.1
    logit = {"kitti": lambda p: (np.log(p / (1 - p)) + 2.4) / 0.4, "nuscenes": lambda p: p}[family]
    seen = [k for k in range(14) if k not in (4, 5, 9, 10)]
    scores = {"object": [], "false": []}
    for k in range(14):
        places = [(0.0, 0.0)] * (k in seen) + [(40.0, 40.0)] * (k >= 9)
        p = [0.6] * (k in seen) + [0.52] * (k >= 9)
        detected = frame(dt * k, places)
        detections = replace(detected.detections, score=logit(np.array(p)))
        tracks = tracker.step(replace(detected, detections=detections))
        near = np.hypot(*tracks.boxes.position[:, :2].T) < 10
        scores["object"] += tracks.score[near].tolist()
        scores["false"] += tracks.score[~near].tolist()
    assert len(scores["object"]) == 14, "it is reported while coasting, too"
    assert np.mean(scores["object"]) > np.mean(scores["false"])
    assert min(scores["object"][1:]) > 0.5 * max(scores["object"]), "a gap hardly changes its rank"


def test_a_steady_track_scores_higher_than_a_new_or_a_flickering_one():
    weighted = ExistenceSettings(prior_opportunities=1.0, hit_ratio_weight=0.5)
    counts = ((9, 9), (1, 1), (4, 9))
    steady, new, flickering = (score(0.6, *count, settings=weighted).item() for count in counts)
    assert steady == pytest.approx(0.6 * np.sqrt(0.9))
    assert steady > new > flickering


def test_one_weak_detection_leaves_a_share_of_the_best_one():
    assert score(0.05, 5, 5, best=0.9) == pytest.approx(LASTING_SHARE * 0.9)
    assert score(0.5, 5, 5, best=0.9) == pytest.approx(0.5), "detections that are not weak are believed"
    assert score(0.05, 5, 5, best=0.9, coasting=True) == pytest.approx(0.9 * LASTING_SHARE * 0.9)


@pytest.mark.parametrize("family", ["kitti", "nuscenes"])
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_a_score_is_monotone_in_all_evidence_of_the_track(family, data):
    """A higher probability of any detection lowers no score, then or later."""
    count = 8
    p = data.draw(st.lists(st.floats(0.1, 0.9), min_size=count, max_size=count), "probabilities")
    seen = [True, True, *data.draw(st.lists(st.booleans(), min_size=count - 2, max_size=count - 2), "detected")]
    raised = data.draw(st.sampled_from([k for k in range(count) if seen[k]]), "raised")
    higher = [*p]
    higher[raised] += data.draw(st.floats(0.0, 0.95 - p[raised]), "by")
    low, high = (_scores_of_one_object(family, values, seen) for values in (p, higher))
    assert low.keys() <= high.keys()
    assert all(high[k] >= value - 1e-9 for k, value in low.items())


def _scores_of_one_object(family, probability, seen):
    """Score by frame of a stationary object, detected in some frames with these probabilities."""
    tracker, dt = load_config(family).new_tracker("saga"), 0.5 if family == "nuscenes" else 0.1
    scores = {}
    for k, (p, there) in enumerate(zip(probability, seen, strict=True)):
        value = (np.log(p / (1 - p)) + 2.4) / 0.4 if family == "kitti" else p
        tracks = tracker.step(frame(dt * k, [(0.0, 0.0)] * there, score=value))
        assert len(tracks) <= 1
        if len(tracks):
            scores[k] = float(tracks.score[0])
    return scores
