"""Interactions from objects in view: the rates of drawn traffic are found again, and no more edges than there are."""

import dataclasses
import math

import numpy as np
import pytest

from benchmarks.in_view_fit import fit_interactions_in_view
from saga_fg import InputError
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.types.labelled_objects import LabelledObjects
from tests.saga_fg.following_pairs import RATE, following_pairs

FOLLOW = Following(CarFollowing(time_constant=math.inf), rate=0.3)


def test_the_rate_of_objects_in_view_is_found_again():
    trajectories = LabelledObjects.of(following_pairs(pairs=4, moments=30, seed=4)).about_their_mean()
    labels = np.where(np.arange(8) >= 4, "car", "bus")
    trajectories = dataclasses.replace(trajectories, label=labels)
    template = dataclasses.replace(FOLLOW, gap_scale=math.inf, lateral_scale=math.inf, heading_scale=math.inf)
    noise = {"car": 0.3, "default": 0.3}
    fitted = fit_interactions_in_view([trajectories], 0.005, noise, (template,), iterations=5)
    assert fitted.rules[0].rate == pytest.approx(RATE, rel=0.35)
    assert fitted.acceleration_noise["car"] < 0.3 * fitted.acceleration_noise["default"]
    with pytest.raises(InputError, match="seen twice"):
        fit_interactions_in_view([trajectories.until(0.0)], 0.005, noise, (template,))


def drifting(rng, groups, members, noise, moments=25, rate=0.0):
    """Groups far from each other; members take over the velocity of every other one of their group at this rate."""
    group = np.repeat(np.arange(groups), members)
    x = 100.0 * group[:, None] + 4.0 * rng.normal(size=(len(group), 2))
    v = np.tile([5.0, 0.0], (len(group), 1))
    places, h = [], 0.02
    for step in range(10 * moments):
        if step % 10 == 0:
            places.append(x)
        total = np.stack([v[group == g].sum(axis=0) for g in group])
        x = x + h * v
        v = v + h * rate * (total - members * v) + np.sqrt(h * noise) * rng.normal(size=v.shape)
    ids, label = np.array([f"{k:02d}" for k in range(len(group))]), np.full(len(group), "car")
    time, heading = 0.2 * np.arange(moments), np.zeros((moments, len(group)))
    return LabelledObjects(
        time, ids, label, np.full(len(group), 4.5), np.array(places), heading, np.full((*heading.shape, 2), np.nan)
    )


SHARING = Neighbours(
    SharedVelocity(), rate=0.5, distance_scale=math.inf, heading_scale=math.inf, speed_scale=math.inf, max_distance=50.0
)


def test_what_objects_in_view_do_not_share_is_not_learned():
    trajectories = drifting(np.random.default_rng(6), groups=2, members=3, noise=0.5)
    fitted = fit_interactions_in_view([trajectories], 0.005, {"default": 1.0}, (SHARING,), iterations=5)
    assert fitted.rules == ()
    assert fitted.acceleration_noise["default"] == pytest.approx(0.5, rel=0.3)


def test_no_more_edges_are_learned_than_there_are_members_to_share_with():
    trajectories = drifting(np.random.default_rng(7), groups=2, members=3, noise=0.5, rate=1.0)
    template = dataclasses.replace(SHARING, max_degree=8)
    fitted = fit_interactions_in_view([trajectories], 0.005, {"default": 1.0}, (template,), (1, 2, 5), iterations=5)
    (rule,) = fitted.rules
    assert rule.max_degree == 2
    assert rule.rate == pytest.approx(1.0, rel=0.4)
