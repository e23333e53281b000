"""A block-diagonal Gaussian against the same Gaussian as one dense matrix."""

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.partition import Partition, StateLayout


def random_gaussian(rng, nodes, dims, label):
    layout = StateLayout(nodes, dims)
    partition = Partition(layout, np.unique(label, return_inverse=True)[1])
    blocks = []
    for places in partition.groups:
        A = rng.normal(size=(*places.shape, places.shape[1]))
        blocks.append(A @ np.swapaxes(A, 1, 2) + np.eye(places.shape[1]))
    return BlockGaussian(partition, rng.normal(size=layout.size), tuple(blocks))


def dense(x):
    return x.joint(np.arange(len(x.layout)))


@pytest.fixture(params=range(6))
def gaussian(request):
    rng = np.random.default_rng(request.param)
    n = 9
    dims = np.full(n, 4) if request.param % 2 else rng.choice([4, 6], n)
    return rng, random_gaussian(rng, np.arange(n) * 3, dims, rng.integers(6, size=n))


def test_new_nodes_are_independent_and_leave_the_others_as_they_are(gaussian, subtests):
    for size in [2, 4, 6]:
        with subtests.test(size=size):
            rng, x = gaussian
            means, P = rng.normal(size=(2, size)), np.stack([np.eye(size) * 2, np.eye(size) * 3])
            new = x.extended(x.layout.extended([100, 101], size), means, P)
            D = x.layout.size
            expected = np.zeros((D + 2 * size,) * 2)
            expected[:D, :D] = dense(x)
            expected[D:, D:] = np.diag(np.repeat([2.0, 3.0], size))
            assert np.array_equal(dense(new), expected)
            assert np.array_equal(new.mean, np.concatenate([x.mean, means.ravel()]))


def test_no_new_nodes_change_nothing(gaussian):
    _, x = gaussian
    same = x.extended(x.layout.extended([], 4), np.empty((0, 4)), np.empty((0, 4, 4)))
    assert np.array_equal(dense(same), dense(x))


def test_integrating_out_leaves_the_block_of_the_others(gaussian):
    _, x = gaussian
    alone = np.flatnonzero(np.bincount(x.partition.label)[x.partition.label] == 1)
    for rows in (alone, np.array([0]), np.array([1, 4, 8]), np.arange(9)):
        left = x.without(rows)
        kept = np.setdiff1d(np.arange(9), rows)
        assert np.array_equal(dense(left), x.joint(kept))
        assert np.array_equal(left.mean, x.mean[x.layout.places(kept)])
        assert left.layout.nodes.tolist() == x.layout.nodes[kept].tolist()


def test_covariances_of_any_nodes_in_any_order():
    rng = np.random.default_rng(7)
    x = random_gaussian(rng, np.arange(8), np.full(8, 4), rng.integers(4, size=8))
    P = dense(x).reshape(8, 4, 8, 4)
    for rows in (np.arange(8), np.array([5, 2]), np.arange(8)[::-1]):
        assert np.array_equal(x.covariances(rows), P[rows, :, rows, :])


def test_packing_joins_small_components_of_rare_sizes_and_nothing_else():
    label = np.array([0, 0, 1, 1, 1, 2, 3, 4, 4, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5])
    x = random_gaussian(np.random.default_rng(0), np.arange(len(label)), np.full(len(label), 4), label)
    packed = x.partition.packed
    parts = sorted(np.flatnonzero(packed.label == k).tolist() for k in range(packed.count))
    assert parts == [[0, 1, 2, 3, 4, 7, 8], [5], [6], list(range(9, 23))]
    assert np.array_equal(dense(x.over(packed)), dense(x))
    assert packed.packed is packed


def test_pairs_of_one_component_are_all_that_is_correlated(gaussian):
    """Node by node as in the dense matrix, in any order of the nodes."""
    rng, x = gaussian
    nodes = rng.permutation(9)[:7]
    places = [x.layout.places(np.array([row])) for row in nodes.tolist()]
    P = dense(x)
    first, second = x.correlated(nodes)
    found = {tuple(sorted(pair)) for pair in zip(first.tolist(), second.tolist(), strict=True)}
    assert len(found) == len(first)
    assert found == {(i, j) for i in range(7) for j in range(i + 1, 7) if P[np.ix_(places[i], places[j])].any()}
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        assert np.array_equal(x.between(nodes[[i]], nodes[[j]])[0], P[np.ix_(places[i], places[j])])


def test_nobody_is_correlated_with_nobody():
    x = BlockGaussian.empty()
    none = np.empty(0, dtype=np.int64)
    assert [len(rows) for rows in x.correlated(none)] == [0, 0]
    assert x.between(none, none).shape == (0, 0, 0)


def test_components_that_are_none_never_reach_a_kernel() -> None:
    layout = StateLayout().extended([1, 2], 4)
    for label in ([0], [0, 2], [0, -1], [0.0, 1.0]):
        with pytest.raises(InputError, match="label: expected components"):
            Partition(layout, np.array(label))
