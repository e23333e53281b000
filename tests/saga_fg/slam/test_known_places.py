"""Places of poses known from outside, as by GPS, in a pose graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.loops import with_false_loops
from data_tools.pose_graphs import city, torus
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph, PosePriors, PositionPriors, consensus, graph_error, optimise_poses


def surveyed(dim: int, sigma: float = 0.01) -> tuple[PoseGraph, FloatArray]:
    """A graph of which every tenth place is known, in a world other than the guess's, and the true poses there."""
    graph, true = city(120, seed=3) if dim == 2 else torus(120, seed=3, windings=6)
    world = np.eye(dim + 1)
    world[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    world[:dim, dim] = np.arange(dim) + 20.0
    true = world @ true
    rows = np.arange(0, len(graph), 10)
    information = np.tile(np.eye(dim) / sigma**2, (len(rows), 1, 1))
    return replace(graph, places=PositionPriors(rows, true[rows, :dim, dim], information)), true


@pytest.mark.parametrize("dim", [2, 3])
def test_known_places_say_where_the_graph_is_and_how_it_is_turned(dim: int) -> None:
    graph, true = surveyed(dim)
    optimised = optimise_poses(graph, certify=True)
    off = optimised.world_T_pose[:, :dim, dim] - true[:, :dim, dim]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert graph.places is not None
    assert np.linalg.norm(off[graph.places.pose], axis=1).max() < 0.05
    assert graph_error(graph.at(optimised.world_T_pose)) == pytest.approx(optimised.error)
    assert optimised.chordal is not None
    assert optimised.chordal.certified
    near = optimised.chordal.world_T_pose[:, :dim, dim] - true[:, :dim, dim]
    assert np.linalg.norm(near, axis=1).max() < 0.3
    spread = optimised.covariances()[:, -dim:, -dim:] if dim == 3 else optimised.covariances()[:, :2, :2]
    assert np.sqrt(spread[graph.places.pose].max()) < 0.011  # no worse than what is known of them


def test_a_known_place_counts_by_its_distance() -> None:
    graph, _ = surveyed(2)
    assert graph.places is not None
    off = graph.world_T_pose[graph.places.pose, :2, 2] - graph.places.position
    expected = 0.5 * np.einsum("ni,nij,nj", off, graph.places.information, off)
    held = replace(graph, places=None)
    assert graph_error(graph) == pytest.approx(expected + graph_error(held))


def test_false_loops_are_found_with_known_places() -> None:
    graph, true = surveyed(2)
    places = graph.places
    spoilt = replace(with_false_loops(replace(graph, places=None), 0.5, seed=1), places=places)
    agreed = consensus(spoilt)
    assert not agreed.kept[len(graph.first) :].any()
    assert np.linalg.norm((agreed.graph.world_T_pose - true)[:, :2, 2], axis=1).max() < 0.3


def test_too_few_places_are_refused_unless_a_pose_is_known(subtests: pytest.Subtests) -> None:
    for dim, count in [(2, 1), (3, 2)]:
        with subtests.test(dim=dim, count=count):
            graph, true = surveyed(dim)
            places = graph.places
            assert places is not None
            few = replace(
                graph, places=PositionPriors(places.pose[:count], places.position[:count], places.information[:count])
            )
            with pytest.raises(InputError, match="nothing tells which way the graph is turned"):
                optimise_poses(few)
            k = 3 * (dim - 1)
            known = PosePriors(np.array([0]), true[:1], 1e6 * np.eye(k)[None])
            off = optimise_poses(replace(few, priors=known), certify=True).world_T_pose[0] - true[0]
            assert np.abs(off).max() < 0.05
