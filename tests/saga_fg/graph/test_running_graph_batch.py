"""The batch back end of the running graph: the textbook where all is linear, else iSAM2 that keeps everything."""

import copy

import numpy as np
import pytest

from benchmarks.sampled_traffic import (
    DetectionProvider,
    ObjectProvider,
    VehicleProvider,
    providers,
    sample_traffic,
)
from factors import ResidualFactors, prior_factor
from saga_fg.conformance.programs import CAR, CONE, random_program
from saga_fg.errors import InputError
from saga_fg.estimators import BatchSolver, GraduatedNonConvexity, IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import EGO_POSE, OBJECT, Additions, GraphError, NewVariable, UndeterminedError, key_of
from tests.saga_fg.graph.test_running_graph_linear import MILLISECONDS, USUAL, largest_errors
from tests.saga_fg.graph_estimator import GraphEstimator


class Batch(GraphEstimator):
    """ObjectProvider in a `BatchSolver`."""

    def __init__(self):
        self.smoother, self.nodes = BatchSolver(), []
        self.smoother.step(0.0)


def test_random_programs_agree_with_the_textbook(subtests):
    """Agreement is limited by factors of the noise of 0.02 s of constant acceleration."""
    for seed in range(10):
        with subtests.test(seed=seed):
            mean, joint, single = largest_errors(
                random_program(np.random.default_rng(seed), moments=7, intervals=USUAL), Batch()
            )
            assert mean < 5e-9
            assert max(joint, single) < 1e-9


def test_milliseconds_beside_seconds(subtests):
    for seed in range(10):
        with subtests.test(seed=seed):
            program = random_program(np.random.default_rng(seed), moments=9, intervals=MILLISECONDS, kinds=(CAR, CONE))
            assert max(largest_errors(program, Batch())) < 1e-9


def apart(one, other):
    """The largest difference of any variable of two back ends, in its posterior standard deviations."""
    differences = []
    for key, variable in one.graph().variables.items():
        way = variable.type.local(one.state(key), other.state(key))
        differences.append(np.abs(way / np.sqrt(np.diag(one.covariance(key)))).max())
    return max(differences)


def driven(estimator, scene):
    for moment in scene.frames:
        estimator.step(moment.time)
    return estimator


def test_what_is_nonlinear_is_where_isam2_is_that_keeps_everything(subtests):
    for seed in range(5):
        with subtests.test(seed=seed):
            scene = sample_traffic(np.random.default_rng(seed), frames=10)
            batch = driven(BatchSolver(providers(scene)), scene)
            isam2 = driven(IncrementalSmoother(providers(scene), None, RelinearisationSettings(threshold=1e-4)), scene)
            handed = BatchSolver(graph=isam2.graph())
            assert apart(batch, isam2) < 1e-3
            assert apart(handed, batch) < 1e-5
            assert batch.solve().converged
            keys = [*(one.key for one in batch.graph().of(OBJECT, 9).values()), key_of(EGO_POSE, 0, 4)]
            joint = batch.joint_covariance(keys)
            assert np.linalg.norm(joint - isam2.joint_covariance(keys)) < 1e-3 * np.linalg.norm(joint)
            assert np.allclose(joint[:4, :4], batch.covariance(keys[0]), rtol=1e-6)


def test_what_goes_in_acts():
    """Without interactions the estimate is another one."""
    scene, alone = (sample_traffic(np.random.default_rng(3), frames=8) for _ in range(2))
    alone.leaders, alone.neighbours = {}, lambda node, present: []
    together = driven(BatchSolver([VehicleProvider(scene), ObjectProvider(scene), DetectionProvider(scene)]), scene)
    by_themselves = driven(
        BatchSolver([VehicleProvider(alone), ObjectProvider(alone), DetectionProvider(alone)]), scene
    )
    assert apart(together, by_themselves) > 0.1


@pytest.mark.parametrize(("seed", "loss"), [*((k, "truncated") for k in range(4)), (1, "geman-mcclure")])
def test_graduated_non_convexity_does_not_care_for_outliers(seed, loss):
    """A fifth, or a tenth, of the detections far off: all is where it is without these."""
    rng = np.random.default_rng(seed)
    clean = sample_traffic(rng, frames=8, cars=3, pedestrians=2)
    spoilt, wrong = copy.deepcopy(clean), 0
    for moment, without in zip(spoilt.frames, clean.frames, strict=True):
        for node in list(without.seen):
            if rng.random() < (0.2 if loss == "truncated" else 0.1):
                moment.seen[node] = moment.seen[node] + [rng.uniform(3, 8), rng.choice([-0.3, 0.3])]
                wrong += 1
                del without.seen[node]
    solved = driven(BatchSolver(providers(spoilt, GraduatedNonConvexity(5.0, loss))), spoilt)
    alone, squares = (driven(BatchSolver(providers(scene)), scene) for scene in (clean, spoilt))
    assert wrong > 1
    assert apart(solved, alone) < (1e-3 if loss == "truncated" else 0.5)
    assert apart(squares, alone) > 5.0


class Half:
    """An object whose velocity nobody tells."""

    name = "half"

    def factors(self, view):
        seen = ResidualFactors([[view.key(OBJECT, 12)]], (4,), lambda x: x[:, :2] - [3.0, 1.0], np.eye(2))
        return Additions([NewVariable(OBJECT, 12, np.ones(4), label="car")], [seen])


class Prior:
    name = "prior"

    def factors(self, view):
        if view.now(OBJECT):
            return Additions(factors=[prior_factor(view.key(OBJECT, 12), np.zeros(4), np.eye(4))])
        raise ValueError("there is nobody")


def test_errors_are_named_and_leave_the_solver_as_it_was():
    solver = BatchSolver([Half()])
    solver.step(3.4)
    with pytest.raises(UndeterminedError, match=r"car 12 at 3\.40 s: not determined .* a prior"):
        solver.state(key_of(OBJECT, 12, 0))
    solver.extend([Prior()])
    np.testing.assert_allclose(solver.state(key_of(OBJECT, 12, 0)), [1.5, 0.5, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(solver.covariance(key_of(OBJECT, 12, 0)), np.diag([0.5, 0.5, 1, 1]), atol=1e-9)
    with pytest.raises(GraphError, match="provider prior: there is nobody"):
        solver.step(4.0, [Prior()])
    assert solver.time == 3.4
    with pytest.raises(GraphError, match="object 12 of epoch 7 is not in the graph"):
        solver.covariance(key_of(OBJECT, 12, 7))
    with pytest.raises(InputError, match="expected SceneFactorGraph, got int"):
        BatchSolver(graph=3)
    assert len(BatchSolver().graph().variables) == 0


class Nobody:
    """Factors on all cars, of which there are none."""

    name = "nobody"

    def factors(self, view):
        rows = [[one.key] for one in view.now(OBJECT).values() if one.label == "car"]
        return Additions(factors=[ResidualFactors(rows, (4,), lambda x: x.max(axis=0), np.eye(1))])


@pytest.mark.parametrize("make", [BatchSolver, IncrementalSmoother])
def test_a_provider_may_find_nobody_to_speak_of(make):
    estimator = make([Nobody()])
    estimator.step(0.0)
    assert list(estimator.graph().factors()) == []


class Curious:
    """Asks how well the pedestrians of the epoch before are known; fails once."""

    name = "curious"

    def __init__(self):
        self.known, self.fails = [], False

    def factors(self, view):
        self.known += [view.covariance(one.key) for one in view.before(OBJECT).values()]
        if self.fails:
            raise ValueError("enough")
        return Additions()


def test_a_provider_sees_what_was_known_before_its_epoch():
    scene, curious = sample_traffic(np.random.default_rng(4), frames=5), Curious()
    estimators = [make([*providers(scene), curious]) for make in (BatchSolver, lambda p: IncrementalSmoother(p, None))]
    for k, moment in enumerate(scene.frames):
        answers = []
        for estimator in estimators:
            curious.known, curious.fails = [], k == 3
            if curious.fails:
                with pytest.raises(GraphError, match="provider curious: enough"):
                    estimator.step(moment.time)
            curious.known, curious.fails = [], False
            estimator.step(moment.time)
            answers.append(curious.known)
        np.testing.assert_allclose(*answers, rtol=1e-3, atol=1e-9)
    assert len(answers[0]) > 2


def test_what_is_marginalised_stays_known():
    """The last states are those of a whole graph, after a pickle too."""
    scene = sample_traffic(np.random.default_rng(1), frames=6)
    whole, shorter = (driven(BatchSolver(providers(scene)), scene) for _ in range(2))
    shorter.marginalise([key for key, one in shorter.graph().variables.items() if one.epoch < 3])
    snapshot = shorter.snapshot()
    assert len(snapshot.variables) < len(whole.graph().variables)
    assert apart(BatchSolver(graph=snapshot), whole) < 1e-4
