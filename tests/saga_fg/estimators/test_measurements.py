"""Measurements of an estimator, floors of covariances, and Gaussians by blocks."""

import numpy as np
import pytest

from factors import Bearing, Radar, Range, RangeBearing, RangeRate
from saga_fg import ConstantVelocity, InputError, NodeType, SagaError, SceneGraph
from saga_fg.estimators import BatchSolver, GraphFilter, JointKalmanFilter, Measurements, Observations
from saga_fg.estimators.partition import BlockGaussian, Partition, StateLayout, missing_covariance, not_smaller
from saga_fg.model.discretisation import discretise
from saga_fg.numerics.arrays import FloatArray
from tests.saga_fg.graph_keys import newest_key
from tests.saga_fg.model.test_motion import BACK_ENDS


def measurements(**columns):
    good = {"nodes": [7, 3], "z": np.zeros((2, 2)), "H": np.eye(2, 4), "R": np.eye(2)}
    return Measurements(**(good | columns))


def test_one_matrix_serves_all_measurements_or_each_has_its_own_and_a_node_may_be_measured_twice():
    shared = measurements()
    assert shared.H.shape == (2, 2, 4)
    assert shared.R.shape == (2, 2, 2)
    assert shared.nodes.tolist() == [7, 3]
    assert len(shared) == 2
    each = measurements(H=np.stack([np.eye(2, 4), 2 * np.eye(2, 4)]), R=np.stack([np.eye(2), 3 * np.eye(2)]))
    assert each.H[1, 0, 0] == 2
    assert each.R[1, 0, 0] == 3
    assert not each.z.flags.writeable
    assert measurements(nodes=[3, 3]).nodes.tolist() == [3, 3]


@pytest.mark.parametrize("H", [np.eye(2, 4), np.empty((0, 2, 4))])
def test_nothing_was_measured(H):
    none = Measurements([], np.empty((0, 2)), H, np.eye(2))
    assert len(none) == 0
    assert none.H.shape == (0, 2, 4)


def test_wrong_measurements_are_named(subtests):
    for columns, message in [
        ({"nodes": [1.0, 2.0]}, "nodes: expected a list of integers"),
        ({"nodes": [1]}, r"z: expected shape \(1, any\), got \(2, 2\)"),
        ({"z": np.zeros(2)}, r"z: expected shape \(2, any\)"),
        ({"z": [[0.0, np.nan], [0.0, 0.0]]}, r"z\[0, 1\]: expected a finite number, got nan"),
        ({"H": np.eye(3, 4)}, r"H: expected shape \(2, 2, any\), got \(2, 3, 4\)"),
        ({"H": np.full((2, 4), np.nan)}, r"H\[0, 0, 0\]: expected a finite number"),
        ({"R": np.eye(3)}, r"R: expected shape \(2, 2, 2\), got \(2, 3, 3\)"),
        ({"R": np.zeros((2, 2))}, r"R\[0\]: expected a positive definite matrix"),
        ({"R": np.stack([np.eye(2), np.diag([1.0, np.inf])])}, r"R\[1, 1, 1\]: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            measurements(**columns)


# Nonlinear sensors in every back end: filters linearise at the prediction, smoothers at their estimates

POSE = (2.0, -3.0, 3.0)
MODELS = {
    "range": Range(4, sensor_pose=POSE),
    "bearing": Bearing(4, sensor_pose=POSE),
    "range and bearing": RangeBearing(4, sensor_pose=POSE),
    "range rate": RangeRate(4, sensor_pose=POSE),
    "radar": Radar(4, sensor_pose=POSE),
}
TRUTH = np.array([[-8.0, -2.0, 4.0, 1.0], [-9.0, -3.5, 6.0, -1.0]])  # west of the sensor: bearings about pi
CAR = NodeType("car", ConstantVelocity(1.0))


def noise(model):
    return np.diag([1e-4 if k in model.angles else 1e-2 for k in range(model.dim)])


def told(estimator, model, offset=0.3, turns=0.0):
    """Two cars, known to half a metre, measured after an interval; whole turns are counted as the sensor likes."""
    estimator.add([1, 2], TRUTH + offset * np.array([1, -1, 1, 1]), np.tile(np.diag([0.25, 0.25, 1.0, 1.0]), (2, 1, 1)))
    estimator.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    z = model.predict(TRUTH + 0.1 * np.roll(TRUTH, 2, axis=1) * [1, 1, 0, 0])
    z[:, list(model.angles)] += turns
    estimator.update(Observations([1, 2], z, model, noise(model)))
    return estimator


def apart(a, b):
    sigma = np.sqrt(np.diag(b.joint_covariance([1, 2])))
    return np.abs((a.joint_mean([1, 2]) - b.joint_mean([1, 2])) / sigma).max()


@pytest.mark.parametrize("kind", MODELS)
def test_a_filter_takes_the_linearisation_at_the_prediction(kind):
    model, plain = MODELS[kind], JointKalmanFilter()
    filtered = told(JointKalmanFilter(), model)
    plain.add([1, 2], TRUTH + 0.3 * np.array([1, -1, 1, 1]), np.tile(np.diag([0.25, 0.25, 1.0, 1.0]), (2, 1, 1)))
    plain.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    before = apart(plain, filtered)
    x = plain.mean([1, 2])
    J = model.jacobian(x)  # type: ignore[attr-defined]
    innovation = model.predict(TRUTH + 0.1 * np.roll(TRUTH, 2, axis=1) * [1, 1, 0, 0]) - model.predict(x)  # type: ignore[attr-defined]
    angles = list(model.angles)  # type: ignore[attr-defined]
    innovation[:, angles] = (innovation[:, angles] + np.pi) % (2 * np.pi) - np.pi
    plain.update(Measurements([1, 2], innovation + (J @ x[:, :, None])[:, :, 0], J, noise(model)))
    assert apart(filtered, plain) < 1e-9
    assert before > 0.1  # it acts


@pytest.mark.parametrize("name", BACK_ENDS)
@pytest.mark.parametrize("kind", MODELS)
def test_every_back_end_takes_every_sensor(name, kind):
    """`kalman` is the extended Kalman filter; what linearises again comes to the minimum of the graph."""
    model, estimator = MODELS[kind], told(BACK_ENDS[name](), MODELS[kind])
    if name != "kalman":
        solver, nodes = BatchSolver(graph=told(GraphFilter(lag=100.0), model).graph()), [1, 2]
        minimum = np.array([solver.state(newest_key(solver.graph(), node)) for node in nodes])
        sigma = np.sqrt(np.diagonal(estimator.covariance(nodes), axis1=1, axis2=2))
        off, extended = (
            np.abs((x.mean(nodes) - minimum) / sigma).max() for x in (estimator, told(JointKalmanFilter(), model))
        )
        assert off < (0.5 * extended + 1e-9 if name == "isam2" else 5e-3)
    assert apart(estimator, told(BACK_ENDS[name](), model, turns=2 * np.pi)) < 1e-9


def test_where_a_bearing_is_undefined_is_an_error_after_which_all_goes_on(subtests):
    for name in BACK_ENDS:
        with subtests.test(name=name):
            estimator, model = BACK_ENDS[name](), MODELS["bearing"]
            estimator.add([1], [[*POSE[:2], 0.0, 0.0]], [np.eye(4)])
            estimator.predict(discretise(SceneGraph.of([1], CAR), 0.1))
            with pytest.raises(SagaError, match="at the sensor"):
                estimator.update(Observations([1], [[0.1]], model, [[0.01]]))
            estimator.update(Measurements([1], [[3.0, -3.0]], np.eye(2, 4), np.eye(2)))
            assert 2.0 < estimator.mean([1])[0, 0] < 3.0


# Covariances that are not smaller than others


def covariance(rng: np.random.Generator, d: int) -> FloatArray:
    root = rng.normal(size=(d, d + 2))
    return np.asarray(root @ root.T)


def smallest_eigenvalue(P: FloatArray) -> float:
    return float(np.linalg.eigvalsh((P + P.T) / 2)[0])


def test_what_is_missing_makes_it_no_smaller_in_any_direction(subtests):
    for seed in range(20):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            P, least = covariance(rng, 4), covariance(rng, 4)
            missing = missing_covariance(P, least)
            assert smallest_eigenvalue(missing) >= -1e-12
            assert smallest_eigenvalue(P + missing - least) >= -1e-10
            T = np.diag(10.0 ** rng.uniform(-3, 3, 4)) @ rng.normal(size=(4, 4))  # other units, other axes
            theirs = missing_covariance(T @ P @ T.T, T @ least @ T.T)
            expected = T @ missing @ T.T
            sigma = np.sqrt(np.diag(T @ least @ T.T))
            np.testing.assert_allclose(theirs / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6)


def test_nothing_is_missing_of_a_larger_one_and_without_variance_the_sum_is_taken():
    least = covariance(np.random.default_rng(1), 3)
    np.testing.assert_allclose(missing_covariance(1.5 * least, least), 0.0, atol=1e-12)
    least = np.diag([1.0, 0.0])
    np.testing.assert_array_equal(missing_covariance(np.eye(2), least), least)


def test_only_the_nodes_that_are_named_change():
    rng = np.random.default_rng(2)
    layout = StateLayout(np.array([3, 5, 8, 9]), np.array([2, 2, 3, 2]))
    partition = Partition(layout, np.array([0, 1, 0, 1]))
    blocks = tuple(np.stack([covariance(rng, places.shape[1]) for _ in places]) for places in partition.groups)
    x = BlockGaussian(partition, rng.normal(size=layout.size), blocks)
    earlier = StateLayout(np.array([8, 3, 5]), np.array([3, 2, 2]))
    P = 4 * covariance(rng, 7)
    least = BlockGaussian(Partition(earlier, np.zeros(3, dtype=np.int64)), np.zeros(7), (P[None],))
    raised = not_smaller(x, least, np.array([3, 8, 9]))  # 9 has come since
    np.testing.assert_array_equal(raised.mean, x.mean)
    np.testing.assert_array_equal(raised.joint(np.array([1, 3])), x.joint(np.array([1, 3])))
    both = np.array([0, 2])
    assert smallest_eigenvalue(raised.joint(both) - least.joint(np.array([1, 0]))) >= -1e-10
    assert smallest_eigenvalue(raised.joint(both) - x.joint(both)) >= -1e-10
    assert smallest_eigenvalue(raised.joint(np.arange(4))) > 0


# A block-diagonal Gaussian against the same Gaussian as one dense matrix


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


def test_integrating_out_leaves_the_block_of_the_others_and_no_new_nodes_change_nothing(gaussian):
    _, x = gaussian
    same = x.extended(x.layout.extended([], 4), np.empty((0, 4)), np.empty((0, 4, 4)))
    assert np.array_equal(dense(same), dense(x))
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


def test_nobody_is_correlated_with_nobody_and_components_that_are_none_reach_no_kernel():
    x = BlockGaussian.empty()
    none = np.empty(0, dtype=np.int64)
    assert [len(rows) for rows in x.correlated(none)] == [0, 0]
    assert x.between(none, none).shape == (0, 0, 0)
    layout = StateLayout().extended([1, 2], 4)
    for label in ([0], [0, 2], [0, -1], [0.0, 1.0]):
        with pytest.raises(InputError, match="label: expected components"):
            Partition(layout, np.array(label))
