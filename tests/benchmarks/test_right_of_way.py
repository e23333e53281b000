"""Simulated crossings and merges under a known rule, and what the tracker says of them."""

from functools import cache

import numpy as np
import pytest

from benchmarks import right_of_way
from benchmarks.crossings import CrossingWorld, Rule, build_crossing, crossing_scene
from benchmarks.right_of_way import Told, judged_pairs
from saga_fg.tracking.right_of_way import JOINS, WALKS, probabilities

RULES: tuple[Rule, ...] = ("all_way_stop", "priority_road", "cone_merge", "zebra", "midblock")


@cache
def crossing(rule: Rule) -> CrossingWorld:
    return build_crossing(rule, 1, duration=40.0)


@pytest.mark.parametrize("rule", RULES)
def test_vehicles_under_a_rule_wait_and_do_not_collide(rule):
    here = crossing(rule)
    n = here.yields.shape[1]
    place = np.where(here.objects.present[:, :n, None], here.objects.position[:, :n], np.nan)
    away = np.linalg.norm(place[::10, :, None] - place[::10, None], axis=-1)
    walks = here.objects.label[:n] == "pedestrian"
    away[:, walks[:, None] & walks] = np.inf
    away[:, np.arange(n), np.arange(n)] = np.inf
    assert np.nanmin(away) > 1.5
    assert here.yields.any()
    assert not (here.takes & ~here.meet).any()
    assert not (here.yields & ~here.meet).any()
    assert not here.yields[:, np.arange(n), np.arange(n)].any()
    cones = here.objects.label == "traffic_cone"
    assert cones.any() == (rule == "cone_merge")


def test_all_halt_at_an_all_way_stop():
    here = crossing("all_way_stop")
    speed = np.linalg.norm(here.objects.velocity, axis=-1)
    before = np.linalg.norm(here.objects.position, axis=-1)
    near = here.objects.present & (before < 14) & (before > 7)
    through = (here.objects.present & (before > 40)).any(axis=0) & (here.objects.present & (before < 5)).any(axis=0)
    first = here.objects.present.argmax(axis=0)
    through &= before[first, np.arange(len(first))] > 20  # the others may have halted before
    assert through.sum() >= 3
    for k in np.flatnonzero(through):
        assert speed[near[:, k], k].min() < 1.0


def test_a_crossing_is_the_same_for_the_same_seed():
    one, other = (crossing_scene(build_crossing("priority_road", 4, duration=2.0, warm_up=5.0), 4) for _ in range(2))
    assert len(one.frames) == 20
    for a, b in zip(one.frames, other.frames, strict=True):
        assert np.array_equal(a.detections.boxes.position, b.detections.boxes.position)


def test_who_takes_the_right_of_way_is_told_where_ways_come_together(monkeypatch):
    monkeypatch.setattr(right_of_way, "FIT_DURATION", 50.0)
    evidence, answer = (np.concatenate(each) for each in zip(*judged_pairs("cone_merge", 1003, 0.5), strict=True))
    p, takes = probabilities(evidence)[:, 1], answer[:, 1]
    assert takes.any()
    assert p[takes].mean() > 0.2
    assert p[takes].mean() > 20 * p[~takes].mean()
    assert (p[evidence[:, JOINS] == 0] == 0).all()


def test_people_have_priority_at_a_zebra_and_wait_for_gaps_elsewhere(monkeypatch):
    share = {}
    for rule in ("zebra", "midblock"):
        here = crossing(rule)
        walks = here.objects.label[: here.yields.shape[1]] == "pedestrian"
        seconds = here.yields.sum(axis=0)
        cars, people = seconds[~walks][:, walks].sum(), seconds[walks][:, ~walks].sum()
        assert min(cars, people) > 0
        share[rule] = cars / (cars + people)
    assert share["zebra"] > 2 * share["midblock"]
    monkeypatch.setattr(right_of_way, "FIT_DURATION", 30.0)
    evidence, answer = (np.concatenate(each) for each in zip(*judged_pairs("zebra", 1001, 0.3), strict=True))
    p, true = probabilities(evidence)[:, 0], answer[:, 0]
    assert (evidence[:, WALKS] != 0).all()
    assert p[true].mean() > 5 * p[~true].mean()


def test_figures_of_pairs_and_moments():
    told = Told()
    for _ in range(10):
        told.add(0, {(1, 2), (3, 4)}, {(1, 2), (5, 6)}, 0.1)
    figures = told.figures()
    assert (figures["true pairs"], figures["told pairs"]) == (2, 2)
    assert figures["precision"] == figures["recall"] == figures["precision of moments"] == 0.5
