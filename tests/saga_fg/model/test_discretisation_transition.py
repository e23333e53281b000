"""Transitions are checked where they are made, by hand or from a graph."""

import dataclasses

import numpy as np
import pytest

from saga_fg import Edges, InputError, SceneGraph
from saga_fg.conformance.programs import BUS, CAR, CONE
from saga_fg.model.discretisation import Blocks, Transition, discretise

GRAPH = SceneGraph([4, 9, 2], (CAR, BUS, CONE))
TRANSITION = discretise(GRAPH, 0.5)


def blocks(row, values):
    return Blocks(np.array([row]), np.array([row]), np.asarray(values, dtype=float)[None])


def test_blocks_are_where_their_nodes_are():
    assert TRANSITION.nodes.tolist() == [4, 9, 2]
    assert TRANSITION.offsets.tolist() == [0, 4, 10, 12]
    F = TRANSITION.F_matrix.toarray()
    assert F.shape == (12, 12)
    assert F[0, 2] == 0.5
    assert F[4, 8] == pytest.approx(0.125)
    assert np.array_equal(F[10:, 10:], np.eye(2))
    assert TRANSITION.Q_matrix.toarray()[10:, 10:] == pytest.approx(0.01 * np.eye(2))


def test_parts_that_do_not_fit_are_refused(subtests):
    for parts, message in [
        ({"b": np.zeros(11)}, r"transition over 0.5 s: b: expected 12 entries, got shape \(11,\)"),
        ({"b": np.full(12, np.nan)}, "transition over 0.5 s: b: expected finite numbers"),
        ({"F": (blocks(0, np.eye(6)),)}, "F: blocks of size 6 x 6 do not fit the states of their nodes"),
        ({"F": (blocks(0, np.full((4, 4), np.nan)),)}, "F: expected finite numbers"),
        ({"Q": TRANSITION.Q[:-1]}, "Q: expected one block for each of 3 nodes"),
        ({"Q": TRANSITION.Q + TRANSITION.Q[:1]}, "Q: expected one block for each of 3 nodes"),
        ({"Q": (blocks(0, np.full((4, 4), np.inf)), *TRANSITION.Q[1:])}, "Q: expected finite numbers"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            dataclasses.replace(TRANSITION, **parts)


def test_dynamics_that_explode_within_the_interval_are_refused():
    edges = Edges("repulsion", [0], [1], [1.0], [5.0 * np.eye(4)], np.zeros((1, 4, 4)), np.ones((1, 4)))
    graph = SceneGraph.of([1, 2], CAR, [edges])
    assert isinstance(discretise(graph, 1.0), Transition)
    with pytest.raises(InputError, match=r"transition over 1000 s: .*: expected finite numbers"):
        discretise(graph, 1000.0)


def test_no_nodes():
    empty = discretise(SceneGraph([], ()), 1.0)
    assert empty.F_matrix.shape == (0, 0)
    assert empty.nodes.tolist() == []
