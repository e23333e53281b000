"""Laws of the running graph. Law 1: what is linear equals the textbook, whatever comes and goes."""

from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2

from factors import ResidualFactors, Robust, SolverSettings, prior_factor
from saga_fg import ConstantVelocity, NodeType, SceneGraph
from saga_fg.conformance.programs import (
    CAR,
    CONE,
    Predict,
    TextbookEstimator,
    Update,
    new_nodes,
    random_graph,
    random_program,
)
from saga_fg.errors import InputError
from saga_fg.estimators import (
    BatchSolver,
    GraphFilter,
    IncrementalSmoother,
    JointKalmanFilter,
    Measurements,
    Observations,
    RelinearisationSettings,
)
from saga_fg.graph import EGO_POSE, OBJECT, Additions, GraphError, NewVariable, UndeterminedError, key_of
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import Accelerations
from saga_fg.model.scene_graph import NonlinearEdges
from tests.saga_fg.graph_estimator import GraphEstimator
from tests.saga_fg.sampled_traffic import providers, sample_traffic

USUAL = (0.02, 0.1, 0.37, 0.5, 1.2)
MILLISECONDS = (1e-3, 0.05, 1.0)


class Batch(GraphEstimator):
    """ObjectProvider in a `BatchSolver`."""

    def __init__(self):
        self.smoother, self.nodes = BatchSolver(), []
        self.smoother.step(0.0)


KINDS = {"batch": Batch} | {
    name: partial(GraphEstimator, lag) for name, lag in (("filter", 0.0), ("lag", 1.0), ("all", None))
}


def stepped(estimator, scene):
    for moment in scene.frames:
        estimator.step(moment.time)
    return estimator


def largest_errors(program, estimator):
    """Largest errors after every operation: means in posterior sigmas, joint and single covariances relative."""
    textbook = TextbookEstimator()
    errors = np.zeros(3)
    for operation in program:
        operation.run(textbook)
        operation.run(estimator)
        nodes = textbook.nodes.tolist()
        assert sorted(estimator.nodes) == sorted(nodes)
        if not nodes:
            continue
        P = textbook.joint_covariance(nodes)
        mean = (estimator.joint_mean(nodes) - textbook.joint_mean(nodes)) / np.sqrt(np.diag(P))
        joint = np.linalg.norm(estimator.joint_covariance(nodes) - P) / np.linalg.norm(P)
        own = [(estimator.covariance(node), textbook.covariance([node])[0]) for node in nodes]
        single = max(np.linalg.norm(mine - its) / np.linalg.norm(its) for mine, its in own)
        errors = np.maximum(errors, [np.abs(mean).max(), joint, single])
    return errors


# of means, joint and single covariances. Rounding differs from processor to processor; each interval of a filter begins
# from covariances; iSAM2's marginals have one digit less
MOST = {"filter": (2e-9, 1e-8, 3e-8), "lag": (5e-9, 1e-9, 3e-8), "all": (5e-9, 1e-9, 3e-8), "batch": (5e-9, 1e-9, 1e-9)}


@pytest.mark.parametrize("kind", KINDS)
def test_random_programs_agree_with_the_textbook(kind, subtests):
    """New and leaving nodes, misses, several sensors, graphs that change, nodes of four kinds; then milliseconds beside
    seconds, with constant velocity: the noise of constant acceleration falls with the fifth power of the interval."""
    for seed in range(3):
        with subtests.test(seed=seed):
            usual = random_program(np.random.default_rng(seed), moments=6, intervals=USUAL)
            assert (largest_errors(usual, KINDS[kind]()) < MOST[kind]).all()
            fast = random_program(np.random.default_rng(seed), moments=9, intervals=MILLISECONDS, kinds=(CAR, CONE))
            assert max(largest_errors(fast, KINDS[kind]())) < 1e-9


def test_a_long_program_does_not_drift_away():
    program = random_program(np.random.default_rng(100), moments=60, kinds=(CAR, CONE), intervals=USUAL, density=0.15)
    assert max(largest_errors(program, GraphEstimator(0.0))) < 1e-9


@pytest.mark.parametrize(("n", "elimination", "most"), [(25, "qr", 1e-9), (70, "cholesky", 1e-7)])
def test_many_nodes_that_hang_together(n, elimination, most):
    """Very many are eliminated by Cholesky, which keeps half the digits."""
    rng, ids = np.random.default_rng(5), list(range(n))
    program = [new_nodes(rng, ids, CAR)]
    for _ in range(5):
        seen = np.array(ids)[rng.random(n) < 0.6]
        measured = Measurements(seen, 10 * rng.normal(size=(len(seen), 2)), np.eye(2, 4), 0.2 * np.eye(2))
        program += [Predict(discretise(random_graph(rng, (CAR,) * n, ids, 0.2), 0.3)), Update(measured)]
    estimator, textbook = GraphEstimator(0.0), TextbookEstimator()
    for operation in program:
        operation.run(textbook)
        operation.run(estimator)
    assert estimator.smoother.graph().elimination == elimination
    P = textbook.joint_covariance(ids)
    assert np.abs((estimator.joint_mean(ids) - textbook.joint_mean(ids)) / np.sqrt(np.diag(P))).max() < most
    assert np.linalg.norm(estimator.joint_covariance(ids) - P) < most * np.linalg.norm(P)
    assert np.linalg.norm(estimator.covariance(7) - textbook.covariance([7])[0]) < 10 * most


# Law 5 of the running graph: an interaction, a motion and a sensor of one's own act in every back end as they are

BACK_ENDS = {"kalman": JointKalmanFilter, "isam2": GraphFilter, "fixed-lag": lambda: GraphFilter(lag=1.0)}


class Spring:
    """A node is drawn to another, the more the farther it is."""

    time_constant = 1.0
    alone = np.zeros((1, 0))

    needs = ((), ())

    def given(self, nodes, target, source):
        return np.zeros((len(target), 0))

    def accelerations(self, own, other, given):
        d = other[..., :2] - own[..., :2]
        length = np.linalg.norm(d, axis=-1)[..., None, None]
        by_d = 0.2 * (length * np.eye(2) + d[..., :, None] * d[..., None, :] / np.maximum(length, 1e-9))
        by_other = np.concatenate([by_d, np.zeros_like(by_d)], axis=-1)
        return Accelerations(0.2 * length[..., 0] * d, -by_other, by_other)


class Whirl(ConstantVelocity):
    """Round the origin with one radian a second, whatever the velocity says."""

    def flow(self, x, dt):
        return x @ self._turn(dt).T

    def flow_jacobian(self, x, dt):
        return np.broadcast_to(self._turn(dt), (*x.shape, 4))

    def _turn(self, dt):
        return np.kron(np.eye(2), [[np.cos(dt), -np.sin(dt)], [np.sin(dt), np.cos(dt)]])


class SquaredRange:
    """(x^2 + y^2) of the place."""

    name, state_dim, dim, angles, linear = "squared range", 4, 1, (), False

    def predict(self, x):
        return (x[..., :2] ** 2).sum(axis=-1, keepdims=True)

    def jacobian(self, x):
        return np.concatenate([2 * x[..., None, :2], np.zeros_like(x[..., None, :2])], axis=-1)


def driven(estimator, sprung=True, motion=ConstantVelocity, seen=True):
    """The newest states of two nodes."""
    estimator.add([1, 2], [[0.0, 2.0, 1.0, 0.0], [3.0, 2.5, 0.0, 0.0]], 0.04 * np.stack([np.eye(4)] * 2))
    node_type = NodeType("own", motion(0.1))
    edges = (NonlinearEdges(Spring(), [0], [1], [1.0], np.zeros((1, 0))),) if sprung else ()
    for k in range(3):
        estimator.predict(discretise(SceneGraph(np.array([1, 2]), (node_type,) * 2, nonlinear=edges), 0.2))
        if seen and k == 1:
            estimator.update(Observations([1], [[5.0]], SquaredRange(), np.array([[0.2]])))
    return estimator.mean([1, 2])


@pytest.mark.parametrize("name", BACK_ENDS)
def test_what_is_ones_own_acts(name):
    whole = driven(BACK_ENDS[name]())
    assert np.abs(whole - driven(BACK_ENDS[name](), sprung=False)).max() > 0.05
    assert np.abs(whole - driven(BACK_ENDS[name](), motion=Whirl)).max() > 0.5
    assert np.abs(whole - driven(BACK_ENDS[name](), seen=False)).max() > 0.02


# Law 2 of the running graph: nothing marginalised, iSAM2 is Levenberg-Marquardt on everything; with a lag, consistent

EXACT = SolverSettings(tolerance=1e-7)


def off(smoother, values):
    """The largest difference of any variable, in its posterior standard deviations."""
    differences = [0.0]
    for key, variable in smoother.graph().variables.items():
        way = variable.type.local(smoother.state(key), variable.type.read(values, key))
        differences.append(np.abs(way / np.sqrt(np.diag(smoother.covariance(key)))).max())
    return max(differences)


@pytest.mark.parametrize("seed", range(4))
def test_every_frame_equals_levenberg_marquardt_on_everything(seed):
    scene = sample_traffic(np.random.default_rng(seed), frames=7, cars=3, pedestrians=2)
    smoother = IncrementalSmoother(providers(scene), lag=None)
    for moment in scene.frames:
        smoother.step(moment.time)
        whole = smoother.graph().copy()
        whole.moved_to(whole.base)  # where everything was first put
        solution = whole.solve(EXACT)
        assert solution.converged
        assert off(smoother, solution.values) < 1e-3


def test_robust_losses_are_weighted_anew(subtests):
    """A tenth of the detections far off; iteratively reweighted least squares comes nearer by a factor a time."""
    for seed in range(2):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            scene = sample_traffic(rng, frames=5, cars=3, pedestrians=2)
            for moment in scene.frames:
                for node in moment.seen:
                    if rng.random() < 0.1:
                        moment.seen[node] = moment.seen[node] + np.array([4.0, 0.2])
            robust, plain = (
                IncrementalSmoother(providers(scene, loss), lag=None) for loss in (Robust("cauchy", 2.0), None)
            )
            for moment in scene.frames:
                robust.step(moment.time)
                plain.step(moment.time)
                assert off(robust, robust.graph().copy().solve(EXACT).values) < 3e-3
            assert off(robust, plain.graph().values) > 0.1


@pytest.mark.parametrize("lag", [0.0, 1.0])
def test_with_a_lag_errors_are_as_large_as_their_covariance_says(lag):
    """The 99 % band of the NEES, of vehicle and objects together at the end of ten scenes drawn from the model."""
    total, degrees = 0.0, 0
    for seed in range(10):
        scene = sample_traffic(np.random.default_rng(1000 + seed), frames=10, cars=3, pedestrians=2)
        smoother = stepped(IncrementalSmoother(providers(scene), lag=lag), scene)
        last, graph = scene.frames[-1], smoother.graph()
        keys = [variable.key for kind in (EGO_POSE, OBJECT) for variable in graph.of(kind, graph.epoch).values()]
        truth = {OBJECT: last.states, EGO_POSE: {0: last.pose}}
        errors = []
        for key in keys:
            variable = graph.variable(key)
            errors.append(variable.type.local(smoother.state(key), truth[variable.kind][variable.id]))
        error = np.concatenate(errors)
        total += error @ np.linalg.solve(smoother.joint_covariance(keys), error)
        degrees += len(error)
    assert chi2.ppf(0.005, degrees) < total < chi2.ppf(0.995, degrees)


@pytest.mark.parametrize("lag", [0.0, 0.5])
def test_the_graph_stays_as_large_as_the_lag(lag):
    """Factors and variables, those that iSAM2 holds among them, over 70 frames with new and leaving nodes."""
    scene = sample_traffic(np.random.default_rng(7), frames=70, cars=3, pedestrians=3, intervals=(0.1,))
    smoother, sizes = IncrementalSmoother(providers(scene), lag, RelinearisationSettings(threshold=0.1)), []
    for moment in scene.frames:
        smoother.step(moment.time)
        graph = smoother.graph()
        held = smoother._engine.isam.getFactorsUnsafe().size()
        sizes.append([len(graph.variables), sum(1 for _ in graph.factors()), held, len(smoother._engine.slots)])
        assert all(moment.time - one.time <= lag + 0.1 + 1e-9 for one in graph.variables.values())
    early, late = (np.max(sizes[part], axis=0) for part in (slice(20, 45), slice(45, 70)))
    assert (late <= 1.05 * early).all()


# The batch back end of the running graph: the textbook where all is linear, else iSAM2 that keeps everything


def apart(one, other):
    """The largest difference of any variable of two back ends, in its posterior standard deviations."""
    differences = []
    for key, variable in one.graph().variables.items():
        way = variable.type.local(one.state(key), other.state(key))
        differences.append(np.abs(way / np.sqrt(np.diag(one.covariance(key)))).max())
    return max(differences)


def test_what_is_nonlinear_is_where_isam2_is_that_keeps_everything(subtests):
    for seed in range(2):
        with subtests.test(seed=seed):
            scene = sample_traffic(np.random.default_rng(seed), frames=10)
            batch = stepped(BatchSolver(providers(scene)), scene)
            isam2 = stepped(IncrementalSmoother(providers(scene), None, RelinearisationSettings(threshold=1e-4)), scene)
            handed = BatchSolver(graph=isam2.graph())
            assert apart(batch, isam2) < 1e-3
            assert apart(handed, batch) < 1e-5
            assert batch.solve().converged
            keys = [*(one.key for one in batch.graph().of(OBJECT, 9).values()), key_of(EGO_POSE, 0, 4)]
            joint = batch.joint_covariance(keys)
            assert np.linalg.norm(joint - isam2.joint_covariance(keys)) < 1e-3 * np.linalg.norm(joint)
            assert np.allclose(joint[:4, :4], batch.covariance(keys[0]), rtol=1e-6)


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
