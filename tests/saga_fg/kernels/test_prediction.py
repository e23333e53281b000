"""Exponentials, their integrals and paths along trails by kernels and by NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg.kernels.compilation import only_numpy
from saga_fg.model.discretisation import discretise, linear_motions
from saga_fg.tracking.traffic import Passages, Traffic, TrafficSettings
from saga_fg.tracking.trails import paths
from saga_fg.types.road_map import Lane, RoadMap
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE, TRAM, VAN, random_graph, random_types


def near(one, other, tolerance=1e-11):
    """Stacks of matrices that agree up to rounding, relative to the largest entry of each."""
    assert one.shape == other.shape
    scale = np.abs(other).max(axis=(1, 2), keepdims=True, initial=1e-12)
    assert (np.abs(one - other) <= tolerance * scale).all()


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.1, 0.7, 3.0]))
@settings(max_examples=60, deadline=None)
def test_transitions_of_random_graphs(seed, dt):
    rng = np.random.default_rng(seed)
    types = random_types(rng, int(rng.integers(0, 8)), kinds=(CAR, BUS, TRAM, CONE, POLE, VAN))
    graph = random_graph(rng, types)
    by_kernel = discretise(graph, dt)
    with only_numpy():
        by_numpy = discretise(graph, dt)
    np.testing.assert_allclose(by_kernel.b, by_numpy.b, rtol=1e-11, atol=1e-11)
    for one, other in ((by_kernel.F, by_numpy.F), (by_kernel.Q, by_numpy.Q)):
        for mine, theirs in zip(one, other, strict=True):
            assert mine.target.tolist() == theirs.target.tolist()
            assert mine.source.tolist() == theirs.source.tolist()
            near(mine.values, theirs.values)


@pytest.mark.parametrize("d", [1, 2, 4, 6])
@pytest.mark.parametrize("dt", [0.05, 1.0, 8.0])
def test_long_motions(d, dt):
    rng = np.random.default_rng(d)
    A, root = 0.3 * rng.normal(size=(12, d, d)), rng.normal(size=(12, d, d))
    by_kernel = linear_motions(A, root @ np.swapaxes(root, 1, 2), dt)
    with only_numpy():
        by_numpy = linear_motions(A, root @ np.swapaxes(root, 1, 2), dt)
    for one, other in zip(by_kernel, by_numpy, strict=True):
        near(one, other, 1e-11)


@given(st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_paths_along_trails(seed):
    rng = np.random.default_rng(seed)
    reach = float(rng.choice([0.0, 1.5, 4.0]))
    traffic, n, k = (
        Traffic(TrafficSettings(memory=20.0, reach=reach)),
        int(rng.integers(1, 30)),
        int(rng.integers(0, 12)),
    )
    place, heading = rng.uniform(-40, 40, (n, 2)), rng.uniform(-3, 3, n)
    if rng.random() < 0.5:
        traffic.add_lanes(RoadMap(lanes=(Lane("main", centre=((-40.3, 0.1), (0.2, 3.7), (40.9, 9.2))),)))
    for number in range(int(rng.integers(0, 25))):
        place = place + 2.2 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        s = np.flatnonzero(rng.random(n) < 0.8)
        noisy, time, none = place[s] + rng.normal(scale=0.1, size=(len(s), 2)), 0.5 * number, np.zeros(len(s))
        label, times, moves = np.full(len(s), "car"), np.full(len(s), time), rng.random(len(s)) < 0.9
        columns = s, label, noisy, heading[s], rng.uniform(2, 9, len(s)), none, none, times, moves
        traffic.update(Passages(*columns), time)
    start = rng.integers(0, 40, k), rng.uniform(-40, 40, (k, 2)), rng.uniform(-3, 3, k), 0.05 * rng.normal(size=k)
    by_kernel = paths(traffic, *start, steps=20)
    with only_numpy():
        by_numpy = paths(traffic, *start, steps=20)
    for name in vars(by_numpy):
        np.testing.assert_allclose(getattr(by_kernel, name), getattr(by_numpy, name), atol=1e-10)
