"""False loops are left out, true ones kept, whatever the covariances in the file are worth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.loops import with_false_loops
from data_tools.pose_graphs import city, read_g2o, torus
from saga_fg import InputError
from saga_fg.slam.pose_graph import (
    LandmarkObservations,
    PointLandmarks,
    PoseGraph,
    PosePriors,
    consensus,
    optimise_poses,
    trusted,
)
from saga_fg.slam.pose_graph.consensus import chosen_edges


@pytest.mark.parametrize(("share", "seed"), [(0.3, 2), (1.0, 0)])
def test_few_loops_and_poor_odometry(recordings: Path, share: float, seed: int) -> None:
    """Loops that a bad solution puts far out come back when it is better."""
    graph = read_g2o(recordings / "slam" / "MIT.g2o")
    agreed = consensus(with_false_loops(graph, share, seed))
    assert agreed.kept[: len(graph.first)].all()
    assert not agreed.kept[len(graph.first) :].any()


def graph_of(dim: int) -> PoseGraph:
    graph, _ = city(200, seed=1) if dim == 2 else torus(100, seed=1, windings=10)
    return graph


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scale", [1.0, 1 / 25])
def test_the_optimum_is_that_without_the_false_loops(dim: int, scale: float) -> None:
    """scale: of the information, as files have it that overstate their noise."""
    graph = graph_of(dim)
    graph = replace(graph, information=scale * graph.information)
    spoilt = with_false_loops(graph, 0.5, seed=3)
    agreed = consensus(spoilt)
    true = len(graph.first)
    assert not agreed.kept[true:].any()
    assert agreed.kept[:true].mean() > 0.98
    assert agreed.kept[trusted(spoilt)].all()
    clean, found = optimise_poses(graph), optimise_poses(agreed.graph)
    off = (found.world_T_pose - clean.world_T_pose)[:, :dim, dim]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05


def test_a_loop_far_worse_than_the_others_is_kept_where_its_covariance_allows_it() -> None:
    graph = graph_of(2)
    graph = replace(graph, information=graph.information / 400)
    loop = int(np.flatnonzero(~trusted(graph))[3])
    measured = graph.first_T_second.copy()
    measured[loop, 0, 2] += 2 / np.sqrt(graph.information[loop, 0, 0])
    spoilt = with_false_loops(replace(graph, first_T_second=measured), 0.5, seed=3)
    agreed = consensus(spoilt)
    assert agreed.kept[loop]
    assert not agreed.kept[len(graph.first) :].any()


def test_priors_and_landmarks_take_part_and_are_kept() -> None:
    """The graph lies where the priors say, and landmarks seen from far apart speak against false loops too."""
    graph, true = city(200, seed=1)
    away = np.eye(3)
    away[:2, 2] = [300.0, -40.0]
    pose, point = np.arange(0, 200, 10), np.zeros(20, dtype=np.int64)
    z = (np.linalg.inv(true[pose]) @ np.array([5.0, 6.0, 1.0]))[:, :2]
    seen = LandmarkObservations("point", pose, point, z, np.tile(np.eye(2), (20, 1, 1)))
    landmarks = PointLandmarks(np.array([999]), (seen,), np.array([[0.0, 0.0]]))
    priors = PosePriors(np.array([7, 150]), away @ true[[7, 150]], np.tile(100 * np.eye(3), (2, 1, 1)))
    spoilt = replace(with_false_loops(graph, 0.5, seed=3), priors=priors, landmarks=landmarks)
    agreed, edges = consensus(spoilt), len(graph.first)
    assert not agreed.kept[edges:].any()
    assert agreed.kept[:edges].mean() > 0.98
    assert agreed.graph.landmarks is not None
    np.testing.assert_allclose(agreed.graph.landmarks.position, [[305.0, -34.0]], atol=1.0)
    assert np.abs((agreed.graph.world_T_pose - away @ true)[:, :2, 2]).max() < 1.5


def test_a_gap_in_the_odometry_is_bridged() -> None:
    graph = graph_of(2)
    agreed = consensus(chosen_edges(graph, ~trusted(graph) | (np.minimum(graph.first, graph.second) != 150)))
    assert agreed.kept.mean() > 0.98


def test_a_graph_in_pieces_is_refused() -> None:
    graph = graph_of(2)
    with pytest.raises(InputError, match="expected measurements that connect it with the first pose"):
        consensus(chosen_edges(graph, graph.first < 10))


def test_a_graph_without_measurements_is_kept() -> None:
    none = np.zeros(0, dtype=np.int64)
    alone = PoseGraph(np.arange(1), np.eye(3)[None], none, none, np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    agreed = consensus(alone)
    assert agreed.kept.shape == (0,)
    assert len(agreed.graph) == 1
