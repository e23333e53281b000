"""Learned interactions act where recordings that were held out say they should."""

import dataclasses
import math

import numpy as np
import pytest

from saga_fg.learning import (
    FORMS_OF_TRACKERS,
    FilterNoise,
    FittedInteractions,
    GapSettings,
    fit_by_held_out,
    gap_moments,
)
from saga_fg.learning.held_out_fit import HIDDEN, coupled_classes, held_out_parts
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing
from tests.saga_fg.following_pairs import RATE, following_pairs

SHORT = GapSettings(longest=1.5)
OWN = FilterNoise({"car": 0.3, "default": 0.3}, 0.005)
FOLLOW = Following(CarFollowing(time_constant=math.inf), rate=RATE, gap_scale=100.0)


def teaches(*rules, explained_noise=0.0, noise=0.2):
    def fit(sample, position_noise, acceleration_noise):
        return FittedInteractions(rules, {"car": noise, "default": 7.0}, explained_noise, 0.0)

    return fit


def fitted(fit, seeds=(0, 1)):
    recordings = [following_pairs(pairs=2, moments=45, seed=seed) for seed in seeds]
    return fit_by_held_out(recordings, ("car",), OWN, fit, SHORT)


def test_what_lowers_errors_on_recordings_held_out_stays_with_its_noise():
    found = fitted(teaches(FOLLOW))
    assert found.rules == (FOLLOW,)
    assert found.acceleration_noise == {"car": 0.2, "default": 0.3}


def test_what_raises_them_is_left_out_and_the_classical_filter_remains():
    headway = CarFollowing(time_constant=1.0, headway=5.0, gap="standstill")
    wrong = dataclasses.replace(FOLLOW, interaction=headway)
    found = fitted(teaches(wrong))
    assert found.rules == ()
    assert found.acceleration_noise == OWN.acceleration_noise


def test_what_is_wrong_in_view_alone_acts_on_what_is_hidden():
    stiff = dataclasses.replace(FOLLOW, rate=4.0)
    (rule,) = fitted(teaches(stiff, explained_noise=3.0)).rules
    assert rule.information_gain == HIDDEN


def test_trackers_are_given_edges_that_leave_what_is_in_view_alone():
    recordings = [following_pairs(pairs=2, moments=45, seed=seed) for seed in (0, 1)]
    found = fit_by_held_out(recordings, ("car",), OWN, teaches(FOLLOW), SHORT, FORMS_OF_TRACKERS)
    assert found.rules == (dataclasses.replace(FOLLOW, information_gain=HIDDEN),)
    assert found.acceleration_noise == OWN.acceleration_noise


def test_a_single_recording_is_held_out_by_halves():
    only = following_pairs(pairs=1, moments=41)
    (first,), (second,) = held_out_parts([only])
    assert (len(first), len(second)) == (20, 21)
    np.testing.assert_array_equal(np.concatenate([first.position, second.position]), only.position)
    parts = held_out_parts([first, second, only])
    assert [[id(each) for each in part] for part in parts] == [[id(first), id(only)], [id(second)]]
    assert len(fitted(teaches(FOLLOW), seeds=(0,)).rules) == 1


def test_halves_whose_gaps_have_other_steps_are_tried_as_far_as_they_go():
    often = following_pairs(pairs=2, moments=90)
    k = np.arange(90)
    recording = often.moments((k < 30) | (k % 4 == 0))  # steps of 0.5 s, then of 0.4 s
    parts = [half for (half,) in held_out_parts([recording])]
    assert [gap_moments(half, SHORT)[2] for half in parts] == [3, 4]
    assert len(fit_by_held_out([recording], ("car",), OWN, teaches(FOLLOW), SHORT).rules) == 1


def test_without_anything_to_try_on_nothing_is_believed():
    recordings = [following_pairs(pairs=1, moments=30), following_pairs(pairs=1, moments=3)]
    assert fit_by_held_out(recordings, ("car",), OWN, teaches(FOLLOW), SHORT).rules == ()


@pytest.mark.parametrize(
    ("classes", "groups"),
    [
        ([("car", "bus"), ("pedestrian",)], [{"car", "bus"}, {"pedestrian"}]),
        ([("car",), ("bus",), ("bus", "car")], [{"car", "bus"}]),
        ([], []),
    ],
)
def test_classes_between_which_there_are_edges_are_one_group(classes, groups):
    assert coupled_classes(tuple(Neighbours(classes=each) for each in classes)) == groups
