"""Learning interactions: gaps, their prediction, and what comes out of the fit."""

import dataclasses
import math

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.learning import (
    FilterNoise,
    FilterNoiseLikelihood,
    GapSample,
    GapSettings,
    JointGaps,
    Trajectories,
    filter_independently,
    fit_interactions,
    gap_errors,
    negative_log_likelihood,
    predict_gaps,
    predict_with,
    sample_gaps,
)
from saga_fg.learning.interaction_fit import FittedInteractions, couple_rules
from saga_fg.model.edge_features import EdgeFeatures
from saga_fg.model.edge_information import EdgeInformation
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedCourse, SharedVelocity
from tests.saga_fg.following_pairs import GAP, RATE, following_pairs

SHORT = GapSettings(longest=1.5)
FOLLOW = Following(CarFollowing(time_constant=math.inf), rate=0.3, gap_scale=20.0)


def alone(_features, _seen):
    return []


def gaps_of(trajectories, q=1.5, r=0.005, settings=None):
    filtered = filter_independently(trajectories, np.full(len(trajectories.label), q), r)
    return filtered, sample_gaps(trajectories, filtered, ("car",), settings)


def test_the_known_rate_is_found_again_and_lowers_errors_on_other_recordings():
    _, sample = gaps_of(following_pairs(seed=1), settings=SHORT)
    fitted = fit_interactions(sample, 0.005, {"default": 0.3}, (FOLLOW,), iterations=12)
    behind = EdgeFeatures(*(np.array([v]) for v in (GAP, 0.0, 0.0, GAP, 0.0, 8.0, 8.0, 1.0, 1.0)))
    assert fitted.rules[0].strength(behind)[0] == pytest.approx(RATE, rel=0.35)
    _, other = gaps_of(following_pairs(seed=2), settings=SHORT)
    kf = predict_gaps(other, alone, fitted.acceleration_noise["car"], 0.0)
    learned, classical = (np.nanmean(gap_errors(other, p)[:, -1]) for p in (predict_with(other, fitted), kf))
    assert learned < 0.9 * classical


def test_where_nobody_follows_nothing_is_learned():
    trajectories = following_pairs(pairs=4, moments=60, seed=3)
    apart = trajectories.position + 1000.0 * np.arange(8)[:, None]
    lonely = Trajectories(
        trajectories.time, trajectories.id, trajectories.label, trajectories.length, apart, trajectories.heading
    )
    _, sample = gaps_of(lonely)
    fitted = fit_interactions(sample, 0.005, {"default": 0.3}, (FOLLOW,), iterations=3)
    assert not sample.other_seen.any()
    alike = predict_gaps(sample, alone, fitted.acceleration_noise["car"], 0.0)
    np.testing.assert_allclose(predict_with(sample, fitted).position, alike.position)


def test_the_classical_filter_in_gaps_is_the_joint_filter_without_edges():
    trajectories = following_pairs(pairs=2, moments=40)
    settings = GapSettings(longest=1.5)
    filtered, sample = gaps_of(trajectories, settings=settings)
    joint = JointGaps(trajectories, filtered, {"default": 1.5}, 0.005, ()).errors(sample, settings)
    np.testing.assert_allclose(joint, gap_errors(sample, predict_gaps(sample, alone, 1.5, 0.0)), atol=1e-9)


@pytest.mark.parametrize(
    ("rule", "share"),
    [
        (FOLLOW, 0.2),
        (Following(SharedCourse(), rate=0.5, gap_scale=20.0), 0.2),
        (Neighbours(SharedVelocity(), rate=0.5, distance_scale=20.0), 0.5),  # both ways: the joint state knows more
    ],
)
def test_prediction_with_edges_is_close_to_the_joint_filter(rule, share):
    trajectories = following_pairs(pairs=2, moments=80)
    filtered, sample = gaps_of(trajectories)
    fitted = FittedInteractions((rule,), {"default": 1.5}, 0.0, 0.0)
    joint = JointGaps(trajectories, filtered, {"default": 1.5}, 0.005, (rule,)).errors(sample, GapSettings())
    lone = gap_errors(sample, predict_with(sample, fitted))
    known = np.isfinite(joint)
    assert known.sum() > 50
    assert np.abs(joint - lone)[known].mean() < share * lone[known].mean()


def test_no_rate_makes_a_gap_run_away():
    trajectories = following_pairs(pairs=2, moments=80)
    _, sample = gaps_of(trajectories)
    stiff = Following(CarFollowing(time_constant=math.inf), rate=1e4, gap_scale=20.0)
    prediction = predict_gaps(sample, couple_rules((stiff,), sample), 0.3, 0.0)
    assert np.nanmax(gap_errors(sample, prediction)) < 100
    assert np.isfinite(negative_log_likelihood(sample, prediction, 0.02))


def test_a_template_whose_interaction_gaps_do_not_know_is_refused():
    _, sample = gaps_of(following_pairs(pairs=2, moments=80))
    with pytest.raises(InputError, match=r"with time constant \.inf, got CarFollowing\(time_constant=4\.0"):
        fit_interactions(sample, 0.02, {"default": 0.3}, [Following(CarFollowing(time_constant=4.0))])


def test_a_gap_knows_its_neighbours_and_where_the_object_reappears():
    trajectories = following_pairs(pairs=2, moments=60)
    _, sample = gaps_of(trajectories)
    row = np.flatnonzero((sample.moment == 20) & (sample.row == 2))[0]
    np.testing.assert_allclose(sample.measured[row], trajectories.position[25:55:5, 2])
    assert sample.other_seen[row].sum(axis=1).tolist() == [1.0] * 6
    late = np.flatnonzero(sample.moment == 50)
    assert np.isnan(sample.measured[late][:, 1:]).all()
    assert (sample.dt[late][:, 1:] == 0).all()


def test_of_many_gaps_some_are_chosen_the_same_every_time():
    _, sample = gaps_of(following_pairs(pairs=2, moments=60))
    few = sample.sampled(5, seed=1)
    assert len(few) == 5
    assert set(zip(few.moment, few.row, strict=True)) <= set(zip(sample.moment, sample.row, strict=True))
    np.testing.assert_array_equal(sample.sampled(5, seed=1).moment, few.moment)
    assert sample.sampled(len(sample), seed=1) is sample


def test_edges_that_tell_the_hidden_alone_leave_those_in_view_to_their_measurements():
    trajectories = following_pairs(pairs=2, moments=80)
    filtered, sample = gaps_of(trajectories)

    def errors(news):
        rule = dataclasses.replace(FOLLOW, rate=RATE, information_gain=news)
        return JointGaps(trajectories, filtered, {"default": 1.5}, 0.005, (rule,)).errors(sample, GapSettings())

    kf, hidden, nobody = (
        errors(EdgeInformation(1e6)),
        errors(EdgeInformation(1.0, 1e6)),
        errors(EdgeInformation(1e4, 1e-3)),
    )
    np.testing.assert_allclose(kf, nobody, atol=1e-3)
    at_once = gap_errors(sample, predict_gaps(sample, alone, 1.5, 0.0))
    np.testing.assert_allclose(kf, at_once, atol=1e-3)
    assert np.nanmean(hidden[:, -1]) < 0.8 * np.nanmean(kf[:, -1])


def test_the_noise_of_the_classical_filter_is_found_again():
    rng = np.random.default_rng(5)
    dt, q, r = 0.5, 0.3, 0.05
    n, K = 15, 30
    v = rng.normal(0, 3, (n, 2))
    x, places = np.zeros((n, 2)), np.zeros((K, n, 2))
    for k in range(K):
        places[k] = x
        for _ in range(10):
            x = x + dt / 10 * v
            v = v + np.sqrt(q * dt / 10) * rng.normal(size=v.shape)
    places += rng.normal(0, r, places.shape)
    ids, label = np.array([f"{k:02d}" for k in range(n)]), np.full(n, "car")
    trajectories = Trajectories(dt * np.arange(K), ids, label, np.zeros(n), places, np.full((K, n), np.nan))
    own = FilterNoise.most_likely([FilterNoiseLikelihood(trajectories, ("car",), GapSettings())])
    assert 0.1 <= own.acceleration_noise["car"] <= 0.9
    assert 0.02 <= own.position_noise <= 0.1


def test_learning_from_nothing_is_an_error():
    trajectories = following_pairs(pairs=2, moments=2)
    _, sample = gaps_of(trajectories)
    with pytest.raises(InputError, match="at least one object that is followed"):
        fit_interactions(GapSample.concatenate([sample]), 0.005, {"default": 0.3})


def test_objects_in_view_are_likeliest_by_the_rate_at_which_they_follow():
    trajectories = following_pairs(pairs=3, moments=80)
    followers = np.arange(6) >= 3
    labels = np.where(followers, "car", "bus")  # leaders have their own noise
    trajectories = dataclasses.replace(trajectories, label=labels)
    filtered = filter_independently(trajectories, np.where(followers, 0.05, 1.5), 0.005)

    def likelihood(rate):
        rule = dataclasses.replace(FOLLOW, rate=rate, gap_scale=1e3)
        return JointGaps(trajectories, filtered, {"car": 0.05, "default": 1.5}, 0.005, (rule,)).log_likelihood()

    (right, count), (low, _), (high, _) = map(likelihood, (RATE, 0.5 * RATE, 2 * RATE))
    assert count == 6 * 79
    assert right > low + 5
    assert right > high + 5
