"""Priors, marginals, relative poses, robust losses and angles that wrap."""

from itertools import product

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    Mixture,
    Robust,
    SingularSystemError,
    between_factor,
    gaussian_factor,
    gaussian_factors,
    gaussian_graph,
    joint_prior_factor,
    marginal_factors,
    marginal_moments,
    noise_model,
    pose,
    pose_prior_factor,
    prior_factor,
    prior_factors,
)
from factors.gaussian import block_covariances


def random_graph(rng, dims, covariance):
    keys = list(dims)
    factors = [prior_factor(key, rng.normal(size=dims[key]), covariance(rng, dims[key])) for key in keys]
    for _ in range(2 * len(keys)):
        chosen = rng.permutation(keys)[: rng.integers(1, 5)].tolist()
        m = int(rng.integers(1, 4))
        blocks = [rng.normal(size=(m, dims[key])) for key in chosen]
        factors.append(gaussian_factor(chosen, blocks, rng.normal(size=m), covariance(rng, m)))
    return gaussian_graph(factors)


def moments(graph, keys):
    information, vector = graph.hessian(gtsam.Ordering(keys))
    covariance = np.linalg.inv(information)
    return covariance @ vector, covariance


@pytest.mark.parametrize("elimination", ["cholesky", "qr"])
@pytest.mark.parametrize("seed", range(5))
def test_marginal_keeps_what_is_known_of_the_rest(seed, elimination, covariance):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(500)[:9].tolist()
    dims = {key: int(rng.integers(1, 5)) for key in keys}
    graph = random_graph(rng, dims, covariance)
    gone, kept = keys[:4], keys[4:]
    mean, P = moments(graph, [*kept, *gone])
    size = sum(dims[key] for key in kept)

    remaining = marginal_factors(graph, gone, elimination)
    assert sorted(remaining.keyVector()) == sorted(kept)
    reduced_mean, reduced_P = moments(remaining, kept)
    np.testing.assert_allclose(reduced_mean, mean[:size], atol=1e-8)
    np.testing.assert_allclose(reduced_P, P[:size, :size], atol=1e-8)

    joint_mean, joint_P = marginal_moments(graph, kept[::-1][:3], elimination)
    rows = np.concatenate([_rows(kept, dims, key) for key in kept[::-1][:3]])
    np.testing.assert_allclose(joint_mean, mean[rows], atol=1e-8)
    np.testing.assert_allclose(joint_P, P[np.ix_(rows, rows)], atol=1e-8)


def test_block_covariances_are_those_of_the_dense_inverse(covariance, subtests):
    for options in [{}, {"function": gtsam.EliminateQR}]:
        for seed in range(5):
            with subtests.test(options=options, seed=seed):
                rng = np.random.default_rng(seed)
                keys = rng.permutation(500)[:12].tolist()
                dims = {key: int(rng.integers(1, 5)) for key in keys}
                graph = random_graph(rng, dims, covariance)
                graph.push_back(prior_factor(501, np.zeros(2), np.eye(2)))  # a tree of its own
                dims[501] = 2
                found = block_covariances(graph.eliminateMultifrontal(**options), dims)
                _, P = moments(graph, [*keys, 501])
                assert set(found) == set(dims)
                for key, block in found.items():
                    rows = _rows([*keys, 501], dims, key)
                    np.testing.assert_allclose(block, P[np.ix_(rows, rows)], rtol=1e-9, atol=1e-12)
                with pytest.raises(FactorError, match="dims: expected the dimensions of"):
                    block_covariances(graph.eliminateMultifrontal(), dims | {keys[0]: 7})


def test_bad_priors_and_hard_constraints_are_refused(subtests):
    hard = gtsam.noiseModel.Constrained.All(2)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(gtsam.JacobianFactor(1, np.eye(2), -np.eye(2)[0], hard))
    with pytest.raises(FactorError, match="expected variance in all directions, got a hard constraint"):
        block_covariances(graph.eliminateMultifrontal(function=gtsam.EliminateQR), {1: 2})
    for keys, means, P, message in [
        ([1, 2], [[0.0], [0.0]], np.ones((3, 1, 1)), "expected 2 covariances, got 3"),
        ([1, 1], [[0.0], [0.0]], np.eye(1), "occurs twice"),
        ([1], [[0.0], [0.0]], np.eye(1), "keys: expected 2 rows"),
        ([1, 2], [[0.0], [np.nan]], np.eye(1), r"means\[1, 0\]"),
        ([1, 2], [0.0, 0.0], np.eye(1), "means: expected shape"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            prior_factors(keys, means, P)


def _rows(keys, dims, key):
    start = sum(dims[other] for other in keys[: keys.index(key)])
    return np.arange(start, start + dims[key])


@pytest.mark.parametrize("seed", range(3))
def test_joint_prior_says_its_mean_and_covariance(seed, covariance):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(50)[:6].tolist()
    means = [rng.normal(size=rng.integers(1, 4)) for _ in keys]
    P = covariance(rng, sum(map(len, means)))
    mean, recovered = marginal_moments(gaussian_graph([joint_prior_factor(keys, means, P)]), keys)
    np.testing.assert_allclose(mean, np.concatenate(means), atol=1e-9)
    np.testing.assert_allclose(recovered, P, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_many_factors_equal_one_by_one(seed, covariance):
    rng = np.random.default_rng(seed)
    n, m, dims = 6, 3, [2, 5, 1, 3]
    keys = np.stack([rng.permutation(40)[: len(dims)] for _ in range(n)])
    blocks, rhs = [rng.normal(size=(n, m, d)) for d in dims], rng.normal(size=(n, m))
    R = np.stack([covariance(rng, m) for _ in range(n)])
    for i, factor in enumerate(gaussian_factors(keys, blocks, rhs, R).native()):
        alone = gaussian_factor(keys[i].tolist(), [block[i] for block in blocks], rhs[i], R[i])
        assert factor.keys() == alone.keys()
        np.testing.assert_allclose(factor.augmentedJacobian(), alone.augmentedJacobian(), atol=1e-12)


def test_unknown_keys_and_eliminations_are_refused(covariance, subtests):
    graph = gaussian_graph([prior_factor(1, [0.0], [[1.0]])])
    with pytest.raises(FactorError, match="no variable x7"):
        marginal_factors(graph, [gtsam.symbol("x", 7)])
    with pytest.raises(FactorError, match="no variable 2"):
        marginal_moments(graph, [1, 2])
    with pytest.raises(FactorError, match="elimination: expected one of cholesky, qr"):
        marginal_factors(gaussian_graph([prior_factor(1, [0.0], [[1.0]])]), [1], "lu")
    for elimination in ["cholesky", "qr"]:
        with subtests.test(elimination=elimination):
            graph = gaussian_graph([gaussian_factor([1, 2], [np.eye(2), np.eye(2)], [0.0, 0.0])])
            with pytest.raises(SingularSystemError, match="does not determine"):
                marginal_moments(graph, [1], elimination)


def test_singular_system_names_the_free_variables_only(subtests):
    for elimination in ["cholesky", "qr"]:
        with subtests.test(elimination=elimination):
            x = [gtsam.symbol("x", i) for i in range(4)]
            between = [np.eye(2), -np.eye(2)]
            graph = gaussian_graph(
                [
                    prior_factor(x[0], [0.0, 0.0], np.eye(2)),
                    gaussian_factor([x[0], x[1]], between, [0.0, 0.0]),
                    gaussian_factor([x[2], x[3]], between, [0.0, 0.0]),  # these two hang in the air
                ]
            )
            with pytest.raises(SingularSystemError, match="does not determine x2, x3") as caught:
                marginal_factors(graph, x, elimination)
            assert caught.value.keys == (x[2], x[3])
            with pytest.raises(SingularSystemError):
                marginal_moments(graph, x, elimination)


def test_nan_is_found_when_marginalising(subtests):
    for elimination in ["cholesky", "qr"]:
        for others in [[], [6]]:
            for broken in ["getA", "getb"]:
                with subtests.test(elimination=elimination, others=others, broken=broken):
                    factor = prior_factor(5, [1.0], [[1.0]])
                    getattr(factor, broken)()[:] = np.nan  # as an in-place update might
                    graph = gaussian_graph(
                        [factor, *(gaussian_factor([5, key], [[[1.0]], [[1.0]]], [0.0]) for key in others)]
                    )
                    with pytest.raises(FactorError, match="factors on 5 hold numbers that are not finite"):
                        marginal_factors(graph, [5], elimination)


def test_qr_keeps_the_digits_that_cholesky_loses():
    """A chain of nearly rigid links: prior of variance 1, links of variance 1e-12."""
    rng = np.random.default_rng(0)
    offsets = rng.normal(size=20)
    factors = [prior_factor(0, [1.0], [[1.0]])]
    factors += [gaussian_factor([t, t + 1], [[[-1.0]], [[1.0]]], [offsets[t]], [[1e-12]]) for t in range(20)]
    graph = gaussian_graph(factors)
    mean, variance = marginal_moments(graph, [20], "qr")
    assert mean[0] == pytest.approx(1.0 + offsets.sum(), abs=1e-9)
    assert variance[0, 0] == pytest.approx(1.0 + 20e-12, rel=1e-11)
    rough, _ = marginal_moments(graph, [20])
    assert abs(rough[0] - mean[0]) > 1e-9


# Between and prior factors: GTSAM's residuals, and nothing that would crash it gets in


def transforms(dim: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    kind = gtsam.Pose2 if dim == 2 else gtsam.Pose3
    return [kind.Expmap(rng.normal(size=3 * (dim - 1))).matrix() for _ in range(3)]


def test_the_residual_is_that_of_the_equation(covariance, subtests):
    for dim, seed in product([2, 3], range(4)):
        with subtests.test(dim=dim, seed=seed):
            first, second, measured = transforms(dim, seed)
            P = covariance(np.random.default_rng(seed), 3 * (dim - 1))
            values = gtsam.Values()
            values.insert(9, pose("first", first))
            values.insert(2, pose("second", second))
            log = gtsam.Pose2.Logmap if dim == 2 else gtsam.Pose3.Logmap
            r = log(pose("r", np.linalg.inv(measured) @ np.linalg.inv(first) @ second))
            assert between_factor(9, 2, measured, P).error(values) == pytest.approx(0.5 * r @ np.linalg.solve(P, r))
            r = log(pose("r", np.linalg.inv(measured) @ first))
            assert pose_prior_factor(9, measured, P).error(values) == pytest.approx(0.5 * r @ np.linalg.solve(P, r))


def test_a_robust_loss_is_gtsams_and_keeps_correlations(subtests):
    values = gtsam.Values()
    values.insert(1, gtsam.Pose2())
    values.insert(2, gtsam.Pose2(10, 0, 0))
    factor = between_factor(1, 2, np.eye(3), np.eye(3), Robust("huber", 1.0))
    assert factor.error(values) == pytest.approx(10 - 0.5)
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(noise_model("P", P, 2).covariance(), P)
    for loss, scale in [("l1", 1.0), ("huber", 0.0), ("huber", -1.0), ("tukey", np.nan)]:
        with subtests.test(loss=loss, scale=scale), pytest.raises(FactorError):
            Robust(loss, scale)


def test_what_would_crash_gtsam_is_refused(subtests):
    for arguments, message in [
        ((1, 1, np.eye(3), np.eye(3)), "occurs twice"),
        ((1, 2, np.eye(5), np.eye(3)), "3 x 3 or 4 x 4"),
        ((1, 2, 2 * np.eye(4), np.eye(6)), "rigid"),
        ((1, 2, np.eye(4) * np.nan, np.eye(6)), "finite"),
        ((1, 2, np.eye(4), np.eye(3)), "covariance: expected shape"),
        ((1, 2, np.eye(3), -np.eye(3)), "positive definite"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            between_factor(*arguments)


# Robust losses against GTSAM's, and against their own definition

LOSSES = ["huber", "cauchy", "geman-mcclure", "tukey"]
DISTANCES = np.array([0.0, 0.1, 0.999, 1.7, 1.70001, 5.0, 1e3])


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("scale", [0.3, 1.7])
def test_cost_and_weight_are_gtsams(loss, scale):
    robust = Robust(loss, scale)
    model = robust.model(gtsam.noiseModel.Unit.Create(1))
    theirs = [(model.loss(s * s), model.weight(np.array([s]))) for s in DISTANCES]
    np.testing.assert_allclose(robust.cost(DISTANCES), [cost for cost, _ in theirs], rtol=1e-12)
    np.testing.assert_allclose(robust.weight(DISTANCES), [weight for _, weight in theirs], rtol=1e-12, atol=1e-15)


def test_a_mixture_holds_with_its_probability():
    s = np.linspace(0.01, 6.0, 200) + 1e-4
    for probability in (0.05, 0.5, 0.99):
        mixture, h = Mixture(probability), 1e-6
        slope = (mixture.cost(s + h) - mixture.cost(s - h)) / (2 * h)
        np.testing.assert_allclose(mixture.weight(s) * s, slope, atol=1e-8)
        assert mixture.weight(0.0) == pytest.approx(probability)
        assert mixture.weight(20.0) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(Mixture(1.0).cost(s), s * s / 2)
    assert not Mixture(0.0).weight(s).any()
    each = Mixture([0.2, 0.9])
    np.testing.assert_allclose(each.weight([1.0, 1.0]), [Mixture(p).weight(1.0) for p in (0.2, 0.9)])
    for bad in (-0.1, 1.1, np.nan):
        with pytest.raises(FactorError, match="probability"):
            Mixture(bad)
