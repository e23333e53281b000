"""The scene graph: edges fit their nodes, and what does not fit is named."""

import numpy as np
import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, Edges, InputError, NodeType, RandomWalk, SceneGraph

CAR = NodeType("car", ConstantVelocity())
TRUCK = NodeType("truck", ConstantAcceleration())
LINE = NodeType("stop line", RandomWalk())


def edges(target=(0,), source=(1,), d_i=4, d_j=4, **columns):
    count = np.size(target)
    good = {
        "interaction": "pull",
        "target": target,
        "source": source,
        "rate": np.ones(count),
        "A_self": np.zeros((count, d_i, d_i)),
        "A_other": np.zeros((count, d_i, d_j)),
        "b": np.zeros((count, d_i)),
    }
    return Edges(**(good | columns))


def test_a_heterogeneous_graph():
    pulls = edges((0, 1), (1, 0))
    stops = edges((0, 2), (3, 3), rate=[0.5, 0.0], d_j=2)
    graph = SceneGraph([11, 5, 7, 9], (CAR, CAR, CAR, LINE), (pulls, stops))
    assert len(graph) == 4
    assert graph.nodes.tolist() == [11, 5, 7, 9]
    assert graph.dims.tolist() == [4, 4, 4, 2]
    assert graph.edge_count == 4
    assert len(pulls) == 2


def test_graphs_without_nodes_or_edges():
    assert len(SceneGraph([], ())) == 0
    assert SceneGraph.of([1, 2], CAR).types == (CAR, CAR)
    empty = edges((), ())
    assert SceneGraph.of([1, 2], CAR, [empty]).edge_count == 0
    assert SceneGraph.of([1], TRUCK, [empty]).edge_count == 0  # no edge, so none that does not fit


def test_wrong_edges_are_named(subtests):
    for columns, message in [
        ({"target": (0, 1)}, "edges of pull: source: expected 2 entries, got 1"),
        ({"target": 0}, "edges of pull: target: expected a list of integers, got 0"),
        ({"target": [0.5]}, r"edges of pull: target: expected a list of integers, got \[0.5\]"),
        ({"source": ["b"]}, "edges of pull: source: expected a list of integers"),
        ({"source": (0,)}, "edges of pull: node row 0 has an edge to itself"),
        ({"rate": [-0.5]}, r"edges of pull: rate\[0\]: expected a rate >= 0 in 1/s, got -0.5"),
        ({"rate": [np.nan]}, r"edges of pull: rate\[0\]: expected a finite number"),
        ({"rate": [1.0, 1.0]}, r"edges of pull: rate: expected shape \(1,\)"),
        ({"A_self": np.zeros((1, 4, 3))}, r"edges of pull: A_self: expected shape \(1, 4, 4\), got \(1, 4, 3\)"),
        ({"A_other": np.full((1, 4, 4), np.inf)}, r"edges of pull: A_other\[0, 0, 0\]: expected a finite number"),
        ({"A_other": np.zeros((4, 4))}, "edges of pull: A_self: expected shape"),
        ({"b": np.zeros((1, 3))}, r"edges of pull: b: expected shape \(1, 4\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            edges(**columns)


def test_wrong_graphs_are_refused(subtests):
    for nodes, types, groups, message in [
        ([1, 1], (CAR, CAR), (), "nodes: expected unique ids, 1 occurs more than once"),
        ([1, 2], (CAR,), (), "types: expected 2 node types, got 1"),
        ([1.5], (CAR,), (), "nodes: expected a list of integers"),
        ([1, 2], (CAR, CAR), (edges((0,), (2,)),), "edges of pull: source: row 2 is outside 2 nodes"),
        ([1, 2], (CAR, CAR), (edges((-1, 0), (1, 1)),), "edges of pull: target: row -1 is outside 2 nodes"),
        ([8, 9], (CAR, TRUCK), (edges((0,), (1,)),), "source: node 9 has 6 components, the interaction 4"),
        ([8, 9], (CAR, TRUCK), (edges((1,), (0,)),), "target: node 9 has 6 components, the interaction 4"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            SceneGraph(nodes, types, groups)


def test_diffusion_may_be_scaled_node_by_node():
    assert SceneGraph.of([1, 2], CAR).diffusion_scale.tolist() == [1.0, 1.0]
    assert SceneGraph([1, 2], (CAR, CAR), (), [0.5, 2.0]).diffusion_scale.tolist() == [0.5, 2.0]
    for scale, message in (
        ([0.5], r"diffusion_scale: expected shape \(2,\)"),
        ([0.5, 0.0], r"diffusion_scale\[1\]: expected a factor > 0, got 0"),
        ([np.nan, 1.0], r"diffusion_scale\[0\]: expected a finite number"),
    ):
        with pytest.raises(InputError, match=message):
            SceneGraph([1, 2], (CAR, CAR), (), scale)


def test_columns_are_read_only():
    assert not edges().rate.flags.writeable
    assert not edges().target.flags.writeable
    assert not SceneGraph.of([1], CAR).nodes.flags.writeable


def test_a_part_of_a_graph_keeps_the_edges_within_it():
    ring = edges((0, 1, 2), (1, 2, 0), rate=[0.1, 0.2, 0.3])
    graph = SceneGraph(np.array([7, 5, 9]), (CAR,) * 3, (ring,), np.array([1.0, 2.0, 3.0]))
    part = graph.only(np.array([9, 5, 100]))
    assert part.nodes.tolist() == [5, 9]
    assert part.diffusion_scale.tolist() == [2.0, 3.0]
    (group,) = part.edges
    assert (group.target.tolist(), group.source.tolist(), group.rate.tolist()) == ([0], [1], [0.2])
