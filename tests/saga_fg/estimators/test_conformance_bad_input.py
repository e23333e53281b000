"""Bad input to every estimator: one clear exception, and nothing has happened."""

import numpy as np
import pytest

from saga_fg import InputError, UnknownNodeError
from saga_fg.conformance.programs import BUS, CAR, CONE, TRAM, new_nodes, random_graph
from saga_fg.estimators import Measurements
from saga_fg.model.discretisation import discretise
from tests.saga_fg.every_estimator import ESTIMATORS, maker

MIXED = (CAR, BUS, CONE, CAR)
IDS = [4, 8, 15, 16]


def filled(make):
    """An estimator that has seen something of cars 4 and 16, bus 8 and cone 15."""
    rng = np.random.default_rng(0)
    estimator = make()
    for node, node_type in zip(IDS, MIXED, strict=True):
        new_nodes(rng, [node], node_type).run(estimator)
    estimator.predict(discretise(random_graph(rng, MIXED, IDS, 0.7), 0.4))
    estimator.update(Measurements([4, 16], rng.normal(size=(2, 2)), np.eye(2, 4), 0.2 * np.eye(2)))
    return estimator


def transition(ids, types=None, dt=0.3):
    types = types or tuple(dict(zip(IDS, MIXED, strict=True)).get(node, CAR) for node in ids)
    return discretise(random_graph(np.random.default_rng(1), types, ids, 0.7), dt)


def measured(nodes, d=4, **columns):
    m = len(nodes)
    return Measurements(**({"nodes": nodes, "z": np.zeros((m, 2)), "H": np.eye(2, d), "R": np.eye(2)} | columns))


def added(nodes, d=4, mean=0.0, P=None):
    P = np.eye(d) if P is None else np.asarray(P)
    return nodes, np.full((len(nodes), d), mean), np.tile(P, (len(nodes), 1, 1))


BAD = {
    "add: known already": (lambda e: e.add(*added([5, 8])), "node 8 is in the estimator already"),
    "add: twice in one call": (lambda e: e.add(*added([5, 5])), "nodes: expected unique ids, 5 occurs more"),
    "add: NaN mean": (lambda e: e.add(*added([5], mean=np.nan)), r"means\[0, 0\]: expected a finite number"),
    "add: NaN covariance": (lambda e: e.add(*added([5], P=np.full((4, 4), np.nan))), "covariances.*finite"),
    "add: singular covariance": (lambda e: e.add(*added([5], P=np.zeros((4, 4)))), "positive definite"),
    "add: asymmetric covariance": (
        lambda e: e.add(*added([5], P=np.eye(4) + np.eye(4, k=1))),
        r"covariances\[0\]: expected a symmetric matrix",
    ),
    "add: covariance of another size": (
        lambda e: e.add([5], np.zeros((1, 4)), np.eye(6)[None]),
        r"covariances: expected shape \(1, 4, 4\), got \(1, 6, 6\)",
    ),
    "add: too few means": (lambda e: e.add(*added([5])[:1], *added([5, 6])[1:]), "means: expected shape"),
    "add: ids that are no integers": (lambda e: e.add([5.5], *added([5])[1:]), "nodes: expected a list of"),
    "add: ids that are no list": (lambda e: e.add(5, *added([5])[1:]), "nodes: expected a list of integers"),
    "predict: a node missing": (lambda e: e.predict(transition([4, 8, 15])), "expected 4 nodes, got 3"),
    "predict: an unknown node": (lambda e: e.predict(transition([4, 8, 15, 99])), "node 99 is not in the estimator"),
    "predict: a node too many": (
        lambda e: e.predict(transition([4, 8, 15, 16, 99])),
        "node 99 is not in the estimator",
    ),
    "predict: other sizes": (
        lambda e: e.predict(transition(IDS, (CAR, CAR, CONE, CAR))),
        "transition: the sizes of its states differ",
    ),
    "predict: no transition": (
        lambda e: e.predict(transition(IDS).graph),
        "transition: expected Transition, got SceneGraph",
    ),
    "update: no measurements": (lambda e: e.update(([4], [[0.0, 0.0]])), "measurements: expected Measured"),
    "restore: no snapshot": (lambda e: e.restore((1, 2, 3.0)), "state: expected .*State, got tuple"),
    "update: unknown node": (lambda e: e.update(measured([4, 99])), "node 99 is not in the estimator"),
    "update: unknown node in the second kind": (
        lambda e: e.update([measured([4]), measured([16, 99])]),
        "node 99 is not in the estimator",
    ),
    "update: nodes of mixed sizes": (lambda e: e.update(measured([4, 8])), "expected states of equal size"),
    "update: H of another size": (lambda e: e.update(measured([4], d=6)), "H: expected 4 columns"),
    "update: H of another size, mixed": (lambda e: e.update(measured([8], d=4)), "H: expected 6 columns"),
    "marginalise: unknown node": (lambda e: e.marginalise([4, 99]), "node 99 is not in the estimator"),
    "marginalise: no list": (lambda e: e.marginalise(4), "nodes: expected a list of integer"),
    "mean: unknown node": (lambda e: e.mean([99]), "node 99 is not in the estimator"),
    "mean: mixed sizes": (lambda e: e.mean([4, 8]), "expected states of equal size"),
    "covariance: unknown node": (lambda e: e.covariance([99]), "node 99 is not in the estimator"),
    "covariance: mixed sizes": (lambda e: e.covariance([4, 8]), "expected states of equal size"),
    "joint mean: unknown node": (lambda e: e.joint_mean([4, 99]), "node 99 is not in the estimator"),
    "joint covariance: unknown node": (lambda e: e.joint_covariance([4, 99]), "node 99 is not in the estimator"),
    "joint covariance: ids that are no integers": (lambda e: e.joint_covariance(["4"]), "nodes: expected"),
}


def test_bad_input_ends_in_one_exception_and_changes_nothing(make, subtests):
    for name in BAD:
        with subtests.test(name=name):
            call, message = BAD[name]
            error = UnknownNodeError if "is not in" in message else InputError
            estimator, untouched = filled(make), filled(make)
            with pytest.raises(error, match=message):
                call(estimator)
            assert estimator.nodes.tolist() == untouched.nodes.tolist()
            assert np.array_equal(estimator.joint_mean(IDS), untouched.joint_mean(IDS))
            assert np.array_equal(estimator.joint_covariance(IDS), untouched.joint_covariance(IDS))
            for either in (estimator, untouched):
                new_nodes(np.random.default_rng(3), [23], TRAM).run(either)
                either.predict(discretise(random_graph(np.random.default_rng(4), (*MIXED, TRAM), [*IDS, 23], 0.5), 0.2))
                either.update(measured([4, 16]))
                either.marginalise([8])
            assert np.array_equal(
                estimator.joint_covariance([4, 15, 16, 23]), untouched.joint_covariance([4, 15, 16, 23])
            )
            assert np.array_equal(estimator.joint_mean([4, 15, 16, 23]), untouched.joint_mean([4, 15, 16, 23]))


def test_of_no_nodes_there_is_nothing_to_tell(make):
    for estimator in (make(), filled(make)):
        nodes = estimator.nodes.tolist()
        assert estimator.mean([]).shape[0] == estimator.covariance([]).shape[0] == 0
        assert estimator.joint_mean([]).shape == (0,)
        assert estimator.joint_covariance([]).shape == (0, 0)
        assert estimator.update(Measurements([], [], [], [])) == 0.0
        estimator.marginalise([])
        assert estimator.nodes.tolist() == nodes


def test_a_snapshot_of_another_kind_of_estimator_is_refused(make, subtests):
    with subtests.test():
        estimator, untouched = filled(make), filled(make)
        own = type(make().snapshot())
        others = [filled(maker(kind.values[0])).snapshot() for kind in ESTIMATORS]
        for state in others:
            if not isinstance(state, own):
                with pytest.raises(InputError, match=f"state: expected {own.__name__}, got {type(state).__name__}"):
                    estimator.restore(state)
        assert np.array_equal(estimator.joint_mean(IDS), untouched.joint_mean(IDS))
        assert np.array_equal(estimator.joint_covariance(IDS), untouched.joint_covariance(IDS))
